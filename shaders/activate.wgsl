// Activates the Gaussians' geometry, moved by the heads' outputs: MOVING; OPACITY: one of these changes the opacity.
#import common/activate

@group(0) @binding(2) var<storage, read> geometry: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> means: array<f32>;
@group(0) @binding(5) var<storage, read_write> quats: array<vec4<f32>>;
@group(0) @binding(6) var<storage, read_write> scales: array<f32>;
@group(0) @binding(7) var<storage, read_write> opacities: array<f32>;
#ifdef MOVING
@group(0) @binding(3) var<storage, read> outputs: array<f32>;       // (N, outputs), without their biases
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
    let first = geometry[ROW * i];
    var mean = first.xyz;
    var logit = first.w;
    var quat = unit(geometry[ROW * i + 1u]);
    var scale = resting_scales(geometry[ROW * i + 2u].xyz);
#ifdef MOVING
    mean = rotated(unit(vec4_at(i, 0u) + IDENTITY), mean) + vec3_at(i, SHIFT);
    quat = unit(quat + vec4_at(i, QUATERNION));
    scale = moved_scales(scale + vec3_at(i, SCALES), activation.mirror);
#ifdef OPACITY
    logit += outputs[i * activation.outputs + LOOK + 3u] + bias_at(LOOK + 3u);
#endif
#endif
#unroll a 3
    means[3u * i + $(a)u] = mean[$a];
    scales[3u * i + $(a)u] = scale[$a];
#end
    quats[i] = quat;
    opacities[i] = 1.0 / (1.0 + exp(-logit));
}
