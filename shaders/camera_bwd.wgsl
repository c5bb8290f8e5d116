// Sums over a workgroup's Gaussians what moves all of them alike, which is what moves the camera the other way round.
// Before color_bwd: the gradient of a rotation of all Gaussians about the camera's centre (the colors do not change with
// it). With FORCE, after color_bwd: of a shift of all Gaussians.
#import common/frame
#import common/index
#import common/splat

@group(0) @binding(0) var<uniform> frame: Frame;
#table 1 d_means: f32
#ifndef FORCE
#table 2 means: f32
#table 3 quats: vec4<f32>
#table 4 d_splats: vec4<f32>
#table 5 d_quats: vec4<f32>
#endif
// (workgroups,): rotation about the world's axes, 0; with FORCE shift, 0
@group(0) @binding(6) var<storage, read_write> d_camera: array<vec4<f32>>;

var<workgroup> sums: array<vec4<f32>, 64>;

fn gradient(i: u32) -> vec4<f32> {
    let d_mean = vec3(d_means_at(3u * i), d_means_at(3u * i + 1u), d_means_at(3u * i + 2u));
#ifdef FORCE
    return vec4(d_mean, 0.0);
#else
    if (d_splats_at(i * SPLAT_STRIDE + 2u).z == 0.0) {
        return vec4(0.0);   // not drawn
    }
    let mean = vec3(means_at(3u * i), means_at(3u * i + 1u), means_at(3u * i + 2u));
    let arm = mean - frame.position;
    // A rotation by the small vector v turns a quaternion (w, u) by the product of (0, v / 2) and it.
    let q = quats_at(i);
    let d_q = d_quats_at(i);
    let turn = 0.5 * (q.x * d_q.yzw - q.yzw * d_q.x + cross(q.yzw, d_q.yzw));
    return vec4(cross(arm, d_mean) + turn, 0.0);
#endif
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let number = workgroup_number(group, groups);
    let i = number * 64u + lane;
    var sum = vec4(0.0);
    if (i < frame.gaussians) {
        sum = gradient(i);
    }
    sums[lane] = sum;
    for (var half = 32u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if (lane < half) {
            sums[lane] += sums[lane + half];
        }
    }
    if (lane == 0u && number * 64u < frame.gaussians) {
        d_camera[number] = sums[0];
    }
}
