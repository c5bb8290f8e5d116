// The distances of the dynamics attributes from their mean row, and their sums.
#import common/dynamics
#import common/dynamics_rows

@group(0) @binding(3) var<storage, read_write> distances: array<f32>;      // (N,)
@group(0) @binding(4) var<storage, read_write> distance_sums: array<f32>;  // (GROUPS,)

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    load_mean_row(lane);
    var sum = 0.0;
    for (var i = part_begin(group.x) + lane; i < part_begin(group.x + 1u); i += LANES) {
        let distance = sqrt(squared_distance(i));
        distances[i] = distance;
        sum += distance;
    }
    let all = lanes_sum(lane, sum);
    if (lane == 0u) {
        distance_sums[group.x] = all;
    }
}
