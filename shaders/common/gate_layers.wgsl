// The decoder's layers and what its heads read: temporal channels, gated by the spatial ones; MOTION: and the inner
// channels of the Laplacian motion.
#import common/gate
#import common/index

struct Gate {
    gaussians: u32,
    width: u32,    // channels of each layer
    biases: u32,   // the first among the weights
}

#ifdef MOTION
const LAYERS = 3u;     // gate, inner, temporal, side by side
const FEATURES = 2u;   // gated, inner
#else
const LAYERS = 2u;
const FEATURES = 1u;
#endif

@group(0) @binding(0) var<uniform> gate: Gate;
@group(0) @binding(3) var<storage, read> weights: array<f32>;

// The bias of a channel of a layer.
fn bias(layer: u32, channel: u32) -> f32 {
    return weights[gate.biases + layer * gate.width + channel];
}
