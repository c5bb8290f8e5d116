// Whether the loss leaves out a texel: a transparent one has no color, so that its red, 1, can say so.
fn is_ignored(rgba: u32) -> bool {
    return (rgba >> 24u) == 0u && (rgba & 255u) == 1u;
}

// A texel of straight RGBA, red in the lowest byte, on a background in [0, 1]: red, green, blue, rounded to 8 bits.
fn composite(rgba: u32, background: vec3<f32>) -> vec3<u32> {
    let texel = vec4<f32>((vec4(rgba) >> vec4(0u, 8u, 16u, 24u)) & vec4(255u));
    let mixed = texel.xyz * texel.w + (255.0 - texel.w) * (255.0 * background);
    return vec3<u32>(floor(mixed / 255.0 + 0.5));
}
