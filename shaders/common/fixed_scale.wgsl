// By what gradients are multiplied in fixed point, from the bits of the largest one's absolute value and the number of
// points: a power of two, with which the largest sum that can occur, all of them in one entry, stays below 2^61.
fn fixed_scale(largest: u32, points: u32) -> f32 {
    let above = i32(largest >> 23u) - 126;   // the largest value is below 2^above
    if (above > 128) {
        return 1.0;   // it is not finite, and neither will the sums be (hashgrid_unfix)
    }
    let most = 32 - i32(countLeadingZeros(points));
    return bitcast<f32>(u32(min(61 - above - most, 120) + 127) << 23u);
}
