// The gradient of `activate`. The heads' outputs become their gradients, those of the colors excepted.
#import common/activate
#import common/splat

@group(0) @binding(2) var<storage, read> geometry: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read> opacities: array<f32>;
@group(0) @binding(5) var<storage, read> d_splats: array<vec4<f32>>;     // (N, 3): that of the opacity's logarithm is in it
@group(0) @binding(6) var<storage, read> d_means: array<f32>;
@group(0) @binding(7) var<storage, read> d_quats: array<vec4<f32>>;
@group(0) @binding(8) var<storage, read> d_scales: array<f32>;
@group(0) @binding(9) var<storage, read_write> d_geometry: array<vec4<f32>>;   // added to
#ifdef MOVING
@group(0) @binding(3) var<storage, read_write> outputs: array<f32>;
#import common/activate_outputs
#endif

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = workgroup_number(group, groups) * 64u + lane;
    if (i >= activation.gaussians) {
        return;
    }
    let mean = geometry[ROW * i].xyz;
    let quat = geometry[ROW * i + 1u];
    let logs = geometry[ROW * i + 2u].xyz;
    let d_logit = d_splats[SPLAT_STRIDE * i + 1u].y * (1.0 - opacities[i]);
    var d_mean = vec3(d_means[3u * i], d_means[3u * i + 1u], d_means[3u * i + 2u]);
    var d_quat = d_quats[i];
    var d_scale = vec3(d_scales[3u * i], d_scales[3u * i + 1u], d_scales[3u * i + 2u]);
#ifdef MOVING
    let at = i * activation.outputs;
    let turned = vec4_at(i, 0u) + IDENTITY;
    let rotation = unit(turned);
    let d_turn = unit_bwd(turned, rotated_bwd(rotation, mean, d_mean));
    d_quat = unit_bwd(unit(quat) + vec4_at(i, QUATERNION), d_quat);
    d_scale *= moved_scales_slope(resting_scales(logs) + vec3_at(i, SCALES), activation.mirror);
#unroll a 4
    outputs[at + $(a)u] = d_turn[$a];
    outputs[at + QUATERNION + $(a)u] = d_quat[$a];
#end
#unroll a 3
    outputs[at + SHIFT + $(a)u] = d_mean[$a];
    outputs[at + SCALES + $(a)u] = d_scale[$a];
#end
#ifdef OPACITY
    outputs[at + LOOK + 3u] = d_logit;
#endif
    d_mean = rotated(conjugate(rotation), d_mean);
#endif
    let size = exp(logs);
    d_geometry[ROW * i] += vec4(d_mean, d_logit);
    d_geometry[ROW * i + 1u] += unit_bwd(quat, d_quat);
    d_geometry[ROW * i + 2u] += vec4(select(vec3(0.0), size * d_scale, size >= vec3(MIN_SCALE)), 0.0);
}
