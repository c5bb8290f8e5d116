// From the gradient of each splat's color to that of its spherical harmonics, and of its mean, since the direction of
// view depends on it. Where the color was cut off at zero there is no gradient.
#import common/constants
#import common/frame
#import common/index
#import common/sh
#import common/splat

struct Part { first: u32, count: u32 }   // the Gaussians whose harmonics are bound

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> part: Part;
// (count, SH coefficients, 3)
#table 2 colors: f32
#table 3 means: f32
#table 4 d_splats: vec4<f32>
@group(0) @binding(5) var<storage, read_write> d_colors: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_means: array<f32>;   // added to

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
    let d1 = d_splats_at(i * SPLAT_STRIDE + 1u);
    let d2 = d_splats_at(i * SPLAT_STRIDE + 2u);
    if (d2.z == 0.0) {
        for (var at = 3u * k * u32(SH_COUNT); at < 3u * (k + 1u) * u32(SH_COUNT); at++) {
            d_colors[at] = 0.0;
        }
        return;
    }
    let offset = vec3(means_at(3u * i), means_at(3u * i + 1u), means_at(3u * i + 2u)) - frame.position;
    let distance = length(offset);
    let direction = offset / distance;
    let basis = sh_basis(direction);
    // The color again, since in bands the splats hold only that of the last band's.
    var coefficients: array<vec3<f32>, SH_COUNT>;
    var color = vec3(SH_OFFSET);
#unroll c $SH_COUNT
    {
        let at = 3u * (k * u32(SH_COUNT) + $(c)u);
        coefficients[$c] = vec3(colors_at(at), colors_at(at + 1u), colors_at(at + 2u));
        color += basis[$c] * coefficients[$c];
    }
#end
    let d_color = select(vec3(0.0), vec3(d1.zw, d2.x), color > vec3(0.0));
    var weights: array<f32, SH_COUNT>;
#unroll c $SH_COUNT
    {
        let at = 3u * (k * u32(SH_COUNT) + $(c)u);
        weights[$c] = dot(d_color, coefficients[$c]);
        d_colors[at] = basis[$c] * d_color.x;
        d_colors[at + 1u] = basis[$c] * d_color.y;
        d_colors[at + 2u] = basis[$c] * d_color.z;
    }
#end
    let d_direction = sh_basis_gradient(direction, weights);
    let d_mean = (d_direction - direction * dot(direction, d_direction)) / distance;
    d_means[3u * i] += d_mean.x;
    d_means[3u * i + 1u] += d_mean.y;
    d_means[3u * i + 2u] += d_mean.z;
}
