// Writes the color of each splat that touches a tile: given, or spherical harmonics seen from the camera.
#import common/constants
#import common/frame
#import common/index
#ifdef SH
#import common/sh
#endif

struct Part { first: u32, count: u32 }   // the Gaussians whose colors are bound

@group(0) @binding(1) var<uniform> part: Part;
// (count, 3), or (count, SH coefficients, 3)
#table 2 colors: f32
#table 3 tile_counts: u32
@group(0) @binding(4) var<storage, read_write> splats: array<f32>;
#ifdef SH
@group(0) @binding(0) var<uniform> frame: Frame;
#table 5 means: f32
#endif

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let k = workgroup_number(group, groups) * 64u + lane;
    if (k >= part.count) {
        return;
    }
    let i = part.first + k;
    if (tile_counts_at(i) == 0u) {
        return;
    }
#ifdef SH
    let direction = normalize(vec3(means_at(3u * i), means_at(3u * i + 1u), means_at(3u * i + 2u)) - frame.position);
    let basis = sh_basis(direction);
    var color = vec3(SH_OFFSET);
#unroll c $SH_COUNT
    {
        let at = 3u * (k * u32(SH_COUNT) + $(c)u);
        color += basis[$c] * vec3(colors_at(at), colors_at(at + 1u), colors_at(at + 2u));
    }
#end
    color = max(color, vec3(0.0));
#else
    let color = vec3(colors_at(3u * k), colors_at(3u * k + 1u), colors_at(3u * k + 2u));
#endif
    splats[12u * i + 6u] = color.r;   // the places that common/splat gives them
    splats[12u * i + 7u] = color.g;
    splats[12u * i + 8u] = color.b;
}
