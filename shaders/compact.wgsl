// Lists the splats that touch a tile, in order, with their depth as a sortable key.
#import common/frame
#import common/index
#import common/splat

@group(0) @binding(0) var<uniform> frame: Frame;
#table 1 splats: vec4<f32>
#table 2 tile_counts: u32
#table 3 prefix: u32
@group(0) @binding(4) var<storage, read_write> keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> ids: array<u32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = workgroup_number(group, groups) * 64u + lane;
    if (i >= frame.gaussians || tile_counts_at(i) == 0u) {
        return;
    }
    keys[prefix_at(i)] = bitcast<u32>(splats_at(i * SPLAT_STRIDE + 2u).y);   // positive floats sort as integers
    ids[prefix_at(i)] = i;
}
