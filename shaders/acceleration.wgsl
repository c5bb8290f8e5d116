// The acceleration loss of each sample.
#import common/acceleration

@group(0) @binding(7) var<storage, read> before: array<f32>;    // (samples, outputs) of the heads, without their biases
@group(0) @binding(8) var<storage, read> after: array<f32>;
@group(0) @binding(9) var<storage, read_write> values: array<f32>;
#import common/acceleration_sampled

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = workgroup_number(group, groups) * 64u + lane;
    if (i >= samples.count) {
        return;
    }
    let row = row_of(samples, i);
    let first = sampled_before(i, row);
    let last = sampled_after(i, row);
    values[i] = robust_length(mean_apart(first, last, row)) + robust_length(scale_apart(first, last, row));
}
