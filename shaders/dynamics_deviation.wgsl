// Sums of the squared differences of distances from the mean distance.
#import common/dynamics

@group(0) @binding(3) var<storage, read> distances: array<f32>;
@group(0) @binding(4) var<storage, read> distance_sums: array<f32>;
@group(0) @binding(5) var<storage, read_write> square_sums: array<f32>;    // (GROUPS,)

var<workgroup> of_lane: array<f32, LANES>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    var total = 0.0;
    for (var g = 0u; g < GROUPS; g++) {
        total += distance_sums[g];
    }
    let mean = total / f32(dynamics.gaussians);
    var sum = 0.0;
    for (var i = part_begin(group.x) + lane; i < part_begin(group.x + 1u); i += LANES) {
        let difference = distances[i] - mean;
        sum += difference * difference;
    }
    of_lane[lane] = sum;
    workgroupBarrier();
    if (lane == 0u) {
        var all = 0.0;
        for (var i = 0u; i < LANES; i++) {
            all += of_lane[i];
        }
        square_sums[group.x] = all;
    }
}
