// From the layers' outputs to what the heads read.
#import common/gate_layers

@group(0) @binding(1) var<storage, read> layers: array<f32>;            // (N, LAYERS, width), without biases
@group(0) @binding(2) var<storage, read_write> features: array<f32>;    // (N, FEATURES, width)

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
    let temporal = layers[layer + (LAYERS - 1u) * gate.width] + bias(LAYERS - 1u, channel);
    features[feature] = gated(temporal, 0.5 * (layers[layer] + bias(0u, channel)));
#ifdef MOTION
    features[feature + gate.width] = max(layers[layer + gate.width] + bias(1u, channel), 0.0);
#endif
}
