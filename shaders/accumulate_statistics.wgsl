// What density control wants to know of a view, added to what is known, unless the guard is closed.
#import common/index
#import common/splat

struct Seen {
    half_size: vec2<f32>,    // of the image, pixels
    gaussians: u32,
}

@group(0) @binding(0) var<uniform> seen: Seen;
@group(0) @binding(1) var<storage, read> guard: u32;
@group(0) @binding(2) var<storage, read> splats: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read> d_splats: array<vec4<f32>>;
// (N,): sum of the lengths of the gradients by the center, image 2 units wide; views
@group(0) @binding(4) var<storage, read_write> statistics: array<vec2<f32>>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = workgroup_number(group, groups) * 64u + lane;
    if (guard != 0u || i >= seen.gaussians) {
        return;
    }
    if (splats[SPLAT_STRIDE * i + 2u].z <= 0.0) {  // its radius
        return;
    }
    let slope = length(d_splats[SPLAT_STRIDE * i].xy * seen.half_size);
    statistics[i] += vec2(slope, 1.0);
}
