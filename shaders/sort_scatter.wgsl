// Radix sort, per digit 2 of 2: moves each element to its place. Stable: owners and their elements keep their order.
#import common/index
#import common/sort

// counters [digit][owner]: exclusive prefix sums, or, for few owners (UNSUMMED), counts that each lane, or each workgroup,
// adds up for itself
@group(0) @binding(4) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> payload_out: array<u32>;

#ifdef LANE_RUNS
#ifdef UNSUMMED
#table 3 counters: vec4<u32>
#else
#table 3 counters: u32
#endif
#ifndef IOTA
#table 6 payload: vec4<u32>
#endif

@compute @workgroup_size(8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let lane = id.x;
#ifdef UNSUMMED
    var before = 0u;
    for (var d = 0u; d < sort.digits; d++) {
        var place = before;
        for (var q = 0u; q < sort.owners / 4u; q++) {
            let four = counters_at(d * (sort.owners / 4u) + q);
            place += dot(four, vec4<u32>(4u * q + vec4(0u, 1u, 2u, 3u) < vec4(lane)));
            before += dot(four, vec4(1u));
        }
        my_counters[d] = place;
    }
#else
    for (var d = 0u; d < sort.digits; d++) {
        my_counters[d] = counters_at(d * sort.owners + lane);
    }
#endif
    let count = elements();
    let items = run(lane);
    for (var i = items.x; i < items.y; i++) {
        let four = keys_at(i);
#ifdef IOTA
        let carried = 4u * i + vec4(0u, 1u, 2u, 3u);
#else
        let carried = payload_at(i);
#endif
#unroll k 4
        if (4u * i + $(k)u < count) {
            let d = digit(four[$k]);
            let place = my_counters[d];
            my_counters[d] = place + 1u;
            keys_out[place] = four[$k];
            payload_out[place] = carried[$k];
        }
#end
    }
}
#else
#table 3 counters: u32
#ifndef IOTA
#table 6 payload: u32
#endif

const SEGMENTS = LANES / DIGITS;            // each lane adds up one digit over one segment of the lanes
const SEGMENT_LANES = LANES / SEGMENTS;

var<workgroup> ranks: array<u32, DIGITS * LANES>;
var<workgroup> segment_sums: array<u32, LANES>;
#ifdef UNSUMMED
var<workgroup> of_owners: array<vec2<u32>, LANES>;   // what a lane has counted in the owners before this one, and in all
#endif

@compute @workgroup_size(128)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let block = workgroup_number(group, groups);
    for (var d = 0u; d < DIGITS; d++) {
        ranks[d * LANES + lane] = 0u;
    }
    workgroupBarrier();
    let first = (block * LANES + lane) * LANE_ITEMS;
    let last = min(first + LANE_ITEMS, elements());
    for (var i = first; i < last; i++) {
        ranks[digit(keys_at(i)) * LANES + lane] += 1u;
    }
    workgroupBarrier();
    let my_digit = lane / SEGMENTS;
    let my_segment = lane % SEGMENTS;
    let start = my_digit * LANES + my_segment * SEGMENT_LANES;
    var sum = 0u;
    for (var k = start; k < start + SEGMENT_LANES; k++) {
        let count = ranks[k];
        ranks[k] = sum;
        sum += count;
    }
    segment_sums[lane] = sum;
#ifdef UNSUMMED
    var counted = vec2(0u);
    for (var owner = my_segment; owner < sort.owners; owner += SEGMENTS) {
        counted += counters_at(my_digit * sort.owners + owner) * vec2(u32(owner < block), 1u);
    }
    of_owners[lane] = counted;
#endif
    workgroupBarrier();
    var before = 0u;
#ifdef UNSUMMED
    for (var k = 0u; k < my_digit * SEGMENTS; k++) {
        before += of_owners[k].y;
    }
    for (var k = my_digit * SEGMENTS; k < (my_digit + 1u) * SEGMENTS; k++) {
        before += of_owners[k].x;
    }
#else
    if (block < sort.owners) {
        before = counters_at(my_digit * sort.owners + block);
    }
#endif
    for (var k = my_digit * SEGMENTS; k < lane; k++) {
        before += segment_sums[k];
    }
    for (var k = start; k < start + SEGMENT_LANES; k++) {
        ranks[k] += before;
    }
    workgroupBarrier();
    for (var i = first; i < last; i++) {
        let key = keys_at(i);
        let rank = digit(key) * LANES + lane;
        let place = ranks[rank];
        ranks[rank] = place + 1u;
        keys_out[place] = key;
#ifdef IOTA
        payload_out[place] = i;
#else
        payload_out[place] = payload_at(i);
#endif
    }
}
#endif
