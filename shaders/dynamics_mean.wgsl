// Sums of the rows of the dynamics attributes, a column a lane.
#import common/dynamics

@group(0) @binding(1) var<storage, read> rows: array<f32>;   // (N, stride)
@group(0) @binding(2) var<storage, read_write> sums: array<f32>;   // (GROUPS, MOST_COLUMNS)

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    for (var column = lane; column < dynamics.columns; column += LANES) {
        var sum = 0.0;
        for (var i = part_begin(group.x); i < part_begin(group.x + 1u); i++) {
            sum += rows[i * dynamics.stride + column];
        }
        sums[group.x * MOST_COLUMNS + column] = sum;
    }
}
