// The activations between the decoder's layers and its heads: temporal channels, gated by those of place; MOTION: and
// beside them the inner channels of the Laplacian motion.
#import common/index

struct Gate {
    gaussians: u32,
    width: u32,   // channels of each layer
}

#ifdef MOTION
const LAYERS = 3u;     // gate, inner, temporal, side by side
const FEATURES = 2u;   // gated, inner
#else
const LAYERS = 2u;
const FEATURES = 1u;
#endif

@group(0) @binding(0) var<uniform> gate: Gate;

// Not the built-in function, which some drivers compute as a quotient that overflows.
fn safe_tanh(x: f32) -> f32 {
    return 2.0 / (1.0 + exp(-2.0 * x)) - 1.0;
}
