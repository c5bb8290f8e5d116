// The gradient of the dynamics loss, added to that of the rows, and the loss's sums.
#import common/dynamics
#import common/dynamics_rows

@group(0) @binding(3) var<storage, read> distances: array<f32>;
@group(0) @binding(4) var<storage, read> distance_sums: array<f32>;
@group(0) @binding(5) var<storage, read> square_sums: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_rows: array<f32>;        // (N, stride)
@group(0) @binding(7) var<storage, read_write> losses: array<f32>;        // (GROUPS,), times the weight

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    load_mean_row(lane);
    var total = 0.0;
    var squares = 0.0;
    for (var g = 0u; g < GROUPS; g++) {
        total += distance_sums[g];
        squares += square_sums[g];
    }
    let count = f32(dynamics.gaussians);
    let limit = (1.0 + ROUNDING) * (total / count) + sqrt(squares / count);
    let scale = dynamics.weight / count;
    var sum = 0.0;
    for (var i = part_begin(group.x) + lane; i < part_begin(group.x + 1u); i += LANES) {
        let distance = distances[i];
        if (distance > limit) {
            sum += scale * distance * distance;
            for (var column = 0u; column < dynamics.columns; column++) {
                let at = i * dynamics.stride + column;
                d_rows[at] += 2.0 * scale * (rows[at] - mean_row[column]);
            }
        }
    }
    let all = lanes_sum(lane, sum);
    if (lane == 0u) {
        losses[group.x] = all;
    }
}
