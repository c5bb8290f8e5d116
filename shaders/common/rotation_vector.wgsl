// Rotations by a vector's length, radians, about its direction, as quaternions (w, x, y, z). By series: drivers may be off
// by 2^-11 in a sine.
fn turn_of(vector: vec3<f32>) -> vec4<f32> {
    let half = 0.5 * vector;
    let s = dot(half, half);
    let sinc = 1.0 - s / 6.0 * (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0)));
    let cosine = 1.0 - s / 2.0 * (1.0 - s / 12.0 * (1.0 - s / 30.0 * (1.0 - s / 56.0 * (1.0 - s / 90.0))));
    return vec4(cosine, sinc * half);
}

// The vector of a rotation by less than a right angle.
fn vector_of(turn: vec4<f32>) -> vec3<f32> {
    let s = dot(turn.yzw, turn.yzw);
    return 2.0 * turn.yzw
        * (1.0 + s / 6.0 + s * s * (3.0 / 40.0 + s * (5.0 / 112.0 + s * (35.0 / 1152.0 + s * (63.0 / 2816.0)))));
}

// First b, then a.
fn turned(a: vec4<f32>, b: vec4<f32>) -> vec4<f32> {
    return vec4(a.x * b.x - dot(a.yzw, b.yzw), a.x * b.yzw + b.x * a.yzw + cross(a.yzw, b.yzw));
}
