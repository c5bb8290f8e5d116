// Copies a table: the bytes that a device moves in a second. Each lane takes one vec4, neighbours lie side by side.
#import common/index

#table 0 source: vec4<f32>
@group(0) @binding(1) var<storage, read_write> copied: array<vec4<f32>>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = workgroup_number(group, groups) * 64u + lane;
    copied[i] = source_at(i);
}
