// From the gradient of each splat to that of its Gaussian: through the inverse of the 2-D covariance, the projection's
// Jacobian and the rotation.
#import common/gaussian
#import common/index
#import common/splat

@group(0) @binding(0) var<uniform> frame: Frame;
#table 1 means: f32
#table 2 quats: vec4<f32>
#table 3 scales: f32
#table 4 d_splats: vec4<f32>
@group(0) @binding(5) var<storage, read_write> d_means: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_quats: array<vec4<f32>>;
@group(0) @binding(7) var<storage, read_write> d_scales: array<f32>;

fn write_gradient(i: u32, d_mean: vec3<f32>, d_quat: vec4<f32>, d_scale: vec3<f32>) {
    for (var k = 0u; k < 3u; k++) {
        d_means[3u * i + k] = d_mean[k];
        d_scales[3u * i + k] = d_scale[k];
    }
    d_quats[i] = d_quat;
}

// The gradient by a unit quaternion (w, x, y, z) of a loss whose gradient by its rotation matrix is G.
fn rotation_bwd(q: vec4<f32>, G: mat3x3<f32>) -> vec4<f32> {
    let w = q.x; let x = q.y; let y = q.z; let z = q.w;
    let skew = vec3(G[1].z - G[2].y, G[2].x - G[0].z, G[0].y - G[1].x);
    let symmetric = vec3(G[1].z + G[2].y, G[2].x + G[0].z, G[0].y + G[1].x);
    return 2.0 * vec4(
        dot(vec3(x, y, z), skew),
        w * skew.x + y * symmetric.z + z * symmetric.y - 2.0 * x * (G[1].y + G[2].z),
        w * skew.y + x * symmetric.z + z * symmetric.x - 2.0 * y * (G[0].x + G[2].z),
        w * skew.z + x * symmetric.y + y * symmetric.x - 2.0 * z * (G[0].x + G[1].y));
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
    let d2 = d_splats_at(i * SPLAT_STRIDE + 2u);
    if (d2.z == 0.0) {
        write_gradient(i, vec3(0.0), vec4(0.0), vec3(0.0));
        return;
    }
    let d0 = d_splats_at(i * SPLAT_STRIDE);
    let d1 = d_splats_at(i * SPLAT_STRIDE + 1u);

    // The forward pass again.
    let camera = (frame.view * vec4(means_at(3u * i), means_at(3u * i + 1u), means_at(3u * i + 2u), 1.0)).xyz;
    let limits = jacobian_limits(frame);
    let ratio = camera.xy / camera.z;
    let xy = clamp(ratio, limits.low, limits.high);
    let jacobian = frame.focal / camera.z;
    let scale = vec3(scales_at(3u * i), scales_at(3u * i + 1u), scales_at(3u * i + 2u));
    let norm = inverseSqrt(dot(quats_at(i), quats_at(i)));
    let q = quats_at(i) * norm;
    let view = view_rotation(frame);
    let R = view * rotation(q);
    let f = footprint(R, scale, jacobian, xy, frame.low_pass);
    let a = f.yy / f.det;
    let b = -f.xy / f.det;
    let c = f.xx / f.det;

    // d(covariance) = -conic d(conic) conic, with the off-diagonal element counted twice.
    let g = vec3(d0.z, 0.5 * d0.w, d1.x);
    var d_xx = -(a * a * g.x + 2.0 * a * b * g.y + b * b * g.z);
    var d_xy = -2.0 * (a * b * g.x + (a * c + b * b) * g.y + b * c * g.z);
    var d_yy = -(b * b * g.x + 2.0 * b * c * g.y + c * c * g.z);
    // The splat's log opacity is the Gaussian's plus log(flat / det) / 2. No branch: with one, Mesa's software driver
    // loses some memory at each run.
    let half = 0.5 * d1.y;
    let antialiased = frame.antialiased == 1u;
    d_xx += select(0.0, half * ((f.yy - frame.low_pass) / f.flat - a), antialiased);
    d_xy += select(0.0, 2.0 * half * (-f.xy / f.flat - b), antialiased);
    d_yy += select(0.0, half * ((f.xx - frame.low_pass) / f.flat - c), antialiased);
    let d_axes_x = 2.0 * d_xx * f.axes_x + d_xy * f.axes_y;
    let d_axes_y = 2.0 * d_yy * f.axes_y + d_xy * f.axes_x;

    let forward = scale * vec3(R[0].z, R[1].z, R[2].z);
    let d_clamped = -jacobian * vec2(dot(d_axes_x, forward), dot(d_axes_y, forward));
    let inside = ratio == xy;
    let d_ratio = frame.focal * d0.xy + select(vec2(0.0), d_clamped, inside);
    let d_z = d2.y - (dot(d_axes_x, f.axes_x) + dot(d_axes_y, f.axes_y) + dot(d_ratio, ratio)) / camera.z;
    let d_mean = vec3(d_ratio / camera.z, d_z) * view;   // the transpose of `view` times the vector

    let along_x = jacobian.x * d_axes_x;
    let along_y = jacobian.y * d_axes_y;
    let along_z = -(xy.x * along_x + xy.y * along_y);
    let d_M = transpose(mat3x3<f32>(along_x, along_y, along_z));
    let d_scale = vec3(dot(d_M[0], R[0]), dot(d_M[1], R[1]), dot(d_M[2], R[2]));
    let d_R = transpose(view) * mat3x3<f32>(scale.x * d_M[0], scale.y * d_M[1], scale.z * d_M[2]);
    let d_unit = rotation_bwd(q, d_R);
    let d_quat = norm * (d_unit - q * dot(q, d_unit));
    write_gradient(i, d_mean, d_quat, d_scale);
}
