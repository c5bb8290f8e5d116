// Gaussians that a step looks at more closely: one of each stretch of neighboring rows, all different.

struct Samples {
    count: u32,
    gaussians: u32,
    first: u32,      // row at which the first stretch begins
    stretch: u32,    // rows, at most gaussians / count
    seed: u32,       // of the places within stretches, and of offsets
    reach: f32,      // largest offset along each axis, world units
}

// PCG's output function (O'Neill 2014) after one step of its generator.
fn scrambled(value: u32) -> u32 {
    let state = value * 747796405u + 2891336453u;
    let word = ((state >> ((state >> 28u) + 4u)) ^ state) * 277803737u;
    return (word >> 22u) ^ word;
}

fn draw(s: Samples, i: u32, number: u32) -> u32 {
    return scrambled(s.seed ^ scrambled(4u * i + number));
}

fn row_of(s: Samples, i: u32) -> u32 {
    return (s.first + i * s.stretch + draw(s, i, 0u) % s.stretch) % s.gaussians;
}

// Evenly distributed in [-reach, reach)^3.
fn offset_of(s: Samples, i: u32) -> vec3<f32> {
    let high = vec3(draw(s, i, 1u), draw(s, i, 2u), draw(s, i, 3u)) >> vec3(8u);
    return s.reach * (vec3<f32>(high) / 8388608.0 - 1.0);
}
