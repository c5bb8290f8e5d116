// Gaussians that a step looks at more closely, drawn at random, all different.

struct Samples {
    count: u32,
    gaussians: u32,
    half_bits: u32,  // 2 * half_bits number the rows
    seed: u32,       // of the rows, and of offsets
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

// The i-th row of a random permutation: a Feistel network of four rounds over all numbers of so many bits, walked on
// until it gives a row. Source: Black and Rogaway, Ciphers with arbitrary finite domains (2002).
fn row_of(s: Samples, i: u32) -> u32 {
    let low = (1u << s.half_bits) - 1u;
    var row = i;
    loop {
        for (var round = 0u; round < 4u; round++) {
            let right = row & low;
            row = (right << s.half_bits) | ((row >> s.half_bits) ^ (draw(s, right, round) & low));
        }
        if (row < s.gaussians) {
            break;
        }
    }
    return row;
}

// Evenly distributed in [-reach, reach)^3.
fn offset_of(s: Samples, i: u32) -> vec3<f32> {
    let high = vec3(draw(s, i, 1u), draw(s, i, 2u), draw(s, i, 3u)) >> vec3(8u);
    return s.reach * (vec3<f32>(high) / 8388608.0 - 1.0);
}
