// A block of the scan: a workgroup of SCAN_LANES lanes, each with its share of 2048 elements.
const BLOCK_LANES = u32($SCAN_LANES);
const BLOCK_ITEMS = 2048u;
const LANE_ITEMS = BLOCK_ITEMS / BLOCK_LANES;

var<workgroup> lane_sums: array<u32, BLOCK_LANES>;

// Stops at the largest word: a number of intersections beyond it must not wrap around to a small one.
fn plus(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, a + b < a);
}

// Exclusive prefix sum of one value a lane; the total of the workgroup goes to lane_sums[BLOCK_LANES - 1].
fn workgroup_scan(lane: u32, value: u32) -> u32 {
    lane_sums[lane] = value;
    workgroupBarrier();
    for (var step = 1u; step < BLOCK_LANES; step *= 2u) {
        var sum = lane_sums[lane];
        if (lane >= step) {
            sum = plus(sum, lane_sums[lane - step]);
        }
        workgroupBarrier();
        lane_sums[lane] = sum;
        workgroupBarrier();
    }
    return lane_sums[lane] - value;
}
