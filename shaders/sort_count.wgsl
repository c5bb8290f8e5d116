// Radix sort, per digit 1 of 2: how often each digit occurs in each owner's elements.
#import common/index
#import common/sort

@group(0) @binding(3) var<storage, read_write> counters: array<u32>;   // [digit][owner]

#ifdef LANE_RUNS
@compute @workgroup_size(8)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let lane = id.x;
    let count = elements();
    let items = run(lane);
    for (var i = items.x; i < items.y; i++) {
        let four = keys_at(i);
#unroll k 4
        if (4u * i + $(k)u < count) {
            my_counters[digit(four[$k])] += 1u;
        }
#end
    }
    for (var d = 0u; d < sort.digits; d++) {
        counters[d * sort.owners + lane] = my_counters[d];
    }
}
#else
var<workgroup> histogram: array<atomic<u32>, DIGITS>;

@compute @workgroup_size(128)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let block = workgroup_number(group, groups);
    if (lane < DIGITS) {
        atomicStore(&histogram[lane], 0u);
    }
    workgroupBarrier();
    let first = (block * LANES + lane) * LANE_ITEMS;
    let last = min(first + LANE_ITEMS, elements());
    for (var i = first; i < last; i++) {
        atomicAdd(&histogram[digit(keys_at(i))], 1u);
    }
    workgroupBarrier();
    if (lane < DIGITS && block < sort.owners) {
        counters[lane * sort.owners + block] = atomicLoad(&histogram[lane]);
    }
}
#endif
