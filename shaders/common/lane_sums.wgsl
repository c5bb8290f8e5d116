// Sums over the lanes of a workgroup, as rasterize_bwd needs them for each splat; always in the same order, which
// subgroupAdd does not promise.
#ifdef SUBGROUPS
// One step of a transposed reduction: of two values each lane keeps one and gives the other to its partner.
fn exchange(keep_second: bool, first: f32, second: f32, distance: u32) -> f32 {
    let given = select(second, first, keep_second);
    return select(first, second, keep_second) + subgroupShuffleXor(given, distance);
}

// Eight values over eight lanes, then over the other lanes: lane k below 8 has the sum of the k-th.
fn eight_sums(lane: u32, a: vec4<f32>, b: vec4<f32>) -> f32 {
    let bit0 = (lane & 1u) != 0u;
    let bit1 = (lane & 2u) != 0u;
    let bit2 = (lane & 4u) != 0u;
    let v01 = exchange(bit0, a.x, a.y, 1u);
    let v23 = exchange(bit0, a.z, a.w, 1u);
    let v45 = exchange(bit0, b.x, b.y, 1u);
    let v67 = exchange(bit0, b.z, b.w, 1u);
    return over_eights(exchange(bit2, exchange(bit1, v01, v23, 2u), exchange(bit1, v45, v67, 2u), 4u));
}

fn subgroup_sum(value: f32) -> f32 {
    var sum = value + subgroupShuffleXor(value, 1u);
    sum += subgroupShuffleXor(sum, 2u);
    return over_eights(sum + subgroupShuffleXor(sum, 4u));
}

fn over_eights(value: f32) -> f32 {
    var sum = value;
#ifdef LANES_16
    sum += subgroupShuffleXor(sum, 8u);
#endif
#ifdef LANES_32
    sum += subgroupShuffleXor(sum, 16u);
#endif
    return sum;
}
#else
#ifdef DEPTH
const VALUES = 10u;
#else
const VALUES = 9u;
#endif
var<workgroup> partials: array<array<f32, LANES>, VALUES>;
#endif
