// Projects each Gaussian: culling, the 2-D covariance and its inverse, and the number of tiles that it may touch.
#import common/finite
#import common/gaussian
#import common/index
#import common/splat
#import common/tile

@group(0) @binding(0) var<uniform> frame: Frame;
#table 1 means: f32
#table 2 quats: vec4<f32>
#table 3 scales: f32
#table 4 opacities: f32
@group(0) @binding(5) var<storage, read_write> splats: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> tile_counts: array<u32>;

struct Projected {
    mean: vec2<f32>,
    conic: vec3<f32>,
    log2_opacity: f32,
    depth: f32,
    radius: f32,
    det: f32,
    tiles: u32,
}

// All zero where the Gaussian cannot be seen.
fn projected(i: u32) -> Projected {
    var p: Projected;
    let mean = vec3(means_at(3u * i), means_at(3u * i + 1u), means_at(3u * i + 2u));
    let camera = (frame.view * vec4(mean, 1.0)).xyz;
    let opacity = opacities_at(i);
    let q = quats_at(i);
    let norm = dot(q, q);
    // Comparisons are written so that NaN fails each, too.
    if (!finite(camera.z) || !finite(opacity) || !finite(norm)) {
        return p;
    }
    let near = max(frame.near, NEAR);
    if (!(camera.z > near) || !(opacity >= ALPHA_MIN) || !(norm > 0.0)) {
        return p;
    }

    let limits = jacobian_limits(frame);
    let xy = clamp(camera.xy / camera.z, limits.low, limits.high);
    let jacobian = frame.focal / camera.z;
    let scale = vec3(scales_at(3u * i), scales_at(3u * i + 1u), scales_at(3u * i + 2u));
    let R = view_rotation(frame) * rotation(q * inverseSqrt(norm));
    let f = footprint(R, scale, jacobian, xy, frame.low_pass);
    if (!finite(f.det) || !(f.det > 0.0) || !(f.det < 1e30)) {
        return p;
    }
    let faded = opacity * select(1.0, sqrt(f.flat / f.det), frame.antialiased == 1u);
    if (!(faded >= ALPHA_MIN)) {
        return p;
    }
    let conic = vec3(f.yy, -f.xy, f.xx) / f.det;
    let mean2d = frame.focal * camera.xy / camera.z + frame.center;
    let e = make_ellipse(mean2d, conic, f.det, log2(faded));
    let size = vec2<f32>(frame.size);
    if (!finite(mean2d.x) || !finite(mean2d.y)) {
        return p;
    }
    if (!all(mean2d + e.extent > vec2(0.0)) || !all(mean2d - e.extent < size)) {
        return p;
    }

    let rows = tile_rows(e, frame.band, COUNTED_PADDING);
    for (var row = rows.x; row < rows.y; row++) {
        let columns = tile_columns(e, row, frame.tiles.x, COUNTED_PADDING);
        p.tiles += columns.y - columns.x;
    }
    p.mean = mean2d;
    p.conic = conic;
    p.log2_opacity = log2(faded);
    p.depth = camera.z;
    p.radius = ceil(max(e.extent.x, e.extent.y));
    p.det = f.det;
    return p;
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = workgroup_number(group, groups) * 64u + lane;
    if (i >= frame.gaussians) {
        return;
    }
    let p = projected(i);
    tile_counts[i] = p.tiles;
    splats[i * SPLAT_STRIDE] = vec4(p.mean, p.conic.xy);
    splats[i * SPLAT_STRIDE + 1u] = vec4(p.conic.z, p.log2_opacity, 0.0, 0.0);
    splats[i * SPLAT_STRIDE + 2u] = vec4(0.0, p.depth, p.radius, p.det);
}
