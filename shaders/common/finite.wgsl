// Whether a number is neither infinite nor NaN, by its bits: a compiler may assume that there is no NaN, and drop comparisons
// that only a NaN fails.
fn finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}
