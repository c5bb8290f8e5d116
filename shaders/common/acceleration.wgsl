// The acceleration loss: how far the sampled Gaussians are from where, and how large, they would be if they moved evenly from
// the time before to the time after.
#import common/geometry
#import common/index
#import common/samples

struct Acceleration {
    outputs: u32,    // of the heads
    mirror: f32,     // as in `activate`
    share: f32,      // of the way from the time before to the time after
    scale: f32,      // of the gradient: the loss's weight, divided by the number of samples
}

const WOBBLE = 1e-2;     // world units: distances far below it count as they are, those far above it all as much as it
const EPSILON = 1e-12;   // keeps the gradient of a distance of 0 finite

@group(0) @binding(0) var<uniform> samples: Samples;
@group(0) @binding(1) var<uniform> acceleration: Acceleration;
@group(0) @binding(2) var<uniform> biases_before: array<vec4<f32>, 5>;
@group(0) @binding(3) var<uniform> biases_after: array<vec4<f32>, 5>;
@group(0) @binding(4) var<storage, read> geometry: array<vec4<f32>>;
@group(0) @binding(5) var<storage, read> means: array<f32>;     // (N, 3), at the time of the step
@group(0) @binding(6) var<storage, read> scales: array<f32>;

fn robust_length(v: vec3<f32>) -> f32 {
    let size = sqrt(dot(v, v) + EPSILON);
    return WOBBLE * size / (size + WOBBLE);
}

fn robust_length_bwd(v: vec3<f32>) -> vec3<f32> {
    let size = sqrt(dot(v, v) + EPSILON);
    let slope = WOBBLE / (size + WOBBLE);
    return slope * slope / size * v;
}

// A Gaussian at one of the two times.
struct Sampled {
    turned: vec4<f32>,     // not of unit length
    changed: vec3<f32>,    // scales before the floor
    mean: vec3<f32>,
    scale: vec3<f32>,
}
