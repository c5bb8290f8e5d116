// The gradient of the layers' outputs, from that of what the heads read.
#import common/gate_layers

@group(0) @binding(1) var<storage, read> d_features: array<f32>;       // (N, FEATURES, width)
@group(0) @binding(2) var<storage, read_write> layers: array<f32>;     // (N, LAYERS, width), which becomes its gradient

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let number = workgroup_number(group, groups) * 64u + lane;
    if (number >= gate.gaussians * gate.width) {
        return;
    }
    let channel = number % gate.width;
    let layer = number / gate.width * LAYERS * gate.width + channel;
    let feature = number / gate.width * FEATURES * gate.width + channel;
    let temporal = layer + (LAYERS - 1u) * gate.width;
    let open = opening(0.5 * (layers[layer] + bias(0u, channel)));
    let passed = layers[temporal] + bias(LAYERS - 1u, channel);
    let d_gated = d_features[feature];
    layers[layer] = 0.5 * d_gated * max(passed, 0.0) * (1.0 - open * open);
    layers[temporal] = select(0.0, d_gated * open, passed > 0.0);
#ifdef MOTION
    let inner = layers[layer + gate.width] + bias(1u, channel);
    layers[layer + gate.width] = select(0.0, d_features[feature + gate.width], inner > 0.0);
#endif
}
