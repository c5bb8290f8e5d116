// The gradient of `smoothness`, a lane a feature.
#import common/index
#import common/smoothness

@group(0) @binding(1) var<storage, read_write> here: array<f32>;    // (pairs, features), which become their gradients
@group(0) @binding(2) var<storage, read_write> there: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = workgroup_number(group, groups) * 64u + lane;
    if (i >= smoothness.pairs * smoothness.features) {
        return;
    }
    let gradient = smoothness.scale * (there[i] - here[i]);
    there[i] = gradient;
    here[i] = -gradient;
}
