// Sums of squared differences between the features of two places, a lane a pair.
#import common/index
#import common/smoothness

@group(0) @binding(1) var<storage, read> here: array<f32>;    // (pairs, features)
@group(0) @binding(2) var<storage, read> there: array<f32>;
@group(0) @binding(3) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let pair = workgroup_number(group, groups) * 64u + lane;
    if (pair >= smoothness.pairs) {
        return;
    }
    var sum = 0.0;
    for (var k = 0u; k < smoothness.features; k++) {
        let difference = there[pair * smoothness.features + k] - here[pair * smoothness.features + k];
        sum += difference * difference;
    }
    sums[pair] = sum;
}
