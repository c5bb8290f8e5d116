// Features of Gaussians, and of places near them, which the smoothness loss compares.

struct Smoothness {
    pairs: u32,
    features: u32,   // of a place
    scale: f32,      // of the gradient
}

@group(0) @binding(0) var<uniform> smoothness: Smoothness;
