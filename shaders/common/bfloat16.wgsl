// Two bfloat16 numbers in a word, the first in its lower half.

// Rounded to the nearest, ties to even.
fn pack_bfloat16(value: vec2<f32>) -> u32 {
    let bits = bitcast<vec2<u32>>(value);
    let rounded = bits + 0x7fffu + ((bits >> vec2(16u)) & vec2(1u));
    return (rounded.x >> 16u) | (rounded.y & 0xffff0000u);
}

fn unpack_bfloat16(word: u32) -> vec2<f32> {
    return bitcast<vec2<f32>>(vec2(word << 16u, word & 0xffff0000u));
}
