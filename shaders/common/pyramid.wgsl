// Neighbouring levels of a pyramid: how much a pixel of one takes from a pixel of the other, along one axis.
// The passes and their transposes both take their weights from here.
struct Level {
    fine: vec2<u32>,       // width, height
    coarse: vec2<u32>,     // half of that, rounded up
    run: u32,              // rows of the coarse level that a lane takes
    first: u32,            // where the partial sums of the level begin
    value: f32,            // a pixel's share in the loss of the pyramid
    slope: f32,            // the same, times the pyramid's weight in the loss
    coarse_value: f32,     // those of the coarse level
    coarse_slope: f32,
}

// Where a pixel of the fine level lies: the finest in strips, as common/picture has it, the others row by row.
fn fine_place(x: u32, y: u32, level: Level) -> u32 {
#ifdef FINEST
    return ((x >> 3u) * level.fine.y + y) * 8u + (x & 7u);
#else
    return y * level.fine.x + x;
#endif
}

fn tap(distance: i32) -> f32 {   // the binomial kernel, times 16
    let d = abs(distance);
    return select(select(select(0.0, 1.0, d == 2), 4.0, d == 1), 6.0, d == 0);
}

// Weight of a pixel in the kernel around `center` where n pixels lie in a row and their reflections beyond both ends.
fn reflected_tap(center: i32, pixel: i32, n: i32) -> f32 {
    let low = select(0.0, tap(-pixel - center), pixel != 0);
    let high = select(0.0, tap(2 * (n - 1) - pixel - center), pixel != n - 1);
    return select(0.0, tap(pixel - center) + low + high, pixel >= 0 && pixel < n);
}

// Of the fine pixel in the coarse one.
fn reduce_weight(fine: i32, coarse: i32, fine_size: i32) -> f32 {
    return select(0.0, reflected_tap(2 * coarse, fine, fine_size) / 16.0, coarse >= 0 && 2 * coarse < fine_size);
}

// Of the coarse pixel in the fine one: coarse pixels lie on the even places of the fine level, zeros between them.
fn enlarge_weight(coarse: i32, fine: i32, fine_size: i32) -> f32 {
    return select(0.0, reflected_tap(fine, 2 * coarse, fine_size) / 8.0, fine >= 0 && fine < fine_size);
}

// The signs of three channels in one word.
fn pack_signs(v: vec3<f32>) -> u32 {
    let s = vec3<u32>(sign(v) + 1.0);
    return s.x | (s.y << 2u) | (s.z << 4u);
}

fn unpack_signs(bits: u32) -> vec3<f32> {
    return vec3<f32>((vec3(bits) >> vec3(0u, 2u, 4u)) & vec3(3u)) - 1.0;
}
