// What `activate` and its gradient share.
#import common/geometry
#import common/index

struct Activate {
    gaussians: u32,
    outputs: u32,    // of the heads
    mirror: f32,     // 1 where negative scales count as their magnitude, else 0
}

@group(0) @binding(0) var<uniform> activation: Activate;
#ifdef MOVING
@group(0) @binding(1) var<uniform> biases: array<vec4<f32>, 5>;   // of the heads

fn bias_at(i: u32) -> f32 {
    return biases[i / 4u][i % 4u];
}

fn vec3_bias(i: u32) -> vec3<f32> {
    return vec3(bias_at(i), bias_at(i + 1u), bias_at(i + 2u));
}

fn vec4_bias(i: u32) -> vec4<f32> {
    return vec4(vec3_bias(i), bias_at(i + 3u));
}
#endif
