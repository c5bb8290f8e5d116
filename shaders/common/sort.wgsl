// What the two passes of a radix sort digit share. Both leave `counters` laid out digit by digit, so that its exclusive
// prefix sum is the place of each counter's first element.
//
// LANE_RUNS, for devices of few wide cores: each lane owns a contiguous run of elements and counters of its own.
// Otherwise: a workgroup owns a block of 128 lanes x 16 elements and one counter a digit.
#import common/count

struct Sort {
    shift: u32,      // of the digit
    digits: u32,     // how many values it has, a power of two
    owners: u32,     // lanes (LANE_RUNS) or blocks
    capacity: u32,   // elements that the buffers hold
}

@group(0) @binding(0) var<uniform> sort: Sort;
@group(0) @binding(1) var<uniform> length: Count;   // number of elements

fn digit(key: u32) -> u32 {
    return (key >> sort.shift) & (sort.digits - 1u);
}

fn elements() -> u32 {
    return min(length.value, sort.capacity);
}

#ifdef LANE_RUNS
#table 2 keys: vec4<u32>

// First and one past the last four elements of a lane's run.
fn run(lane: u32) -> vec2<u32> {
    let count = (elements() + 3u) / 4u;
    let size = (count + sort.owners - 1u) / sort.owners;
    return vec2(min(lane * size, count), min((lane + 1u) * size, count));
}

var<private> my_counters: array<u32, 256>;   // for digits of up to 8 bits
#else
const DIGITS = 16u;
const LANES = 128u;
const LANE_ITEMS = 16u;

#table 2 keys: u32
#endif
