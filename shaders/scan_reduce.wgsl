// Scan, 1 of 2: the sum of each block.
#import common/index
#import common/block
#import common/scan_input

@group(0) @binding(3) var<storage, read_write> block_sums: array<u32>;

@compute @workgroup_size($SCAN_LANES)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let block = workgroup_number(group, groups);
    let first = block * BLOCK_ITEMS + lane * LANE_ITEMS;
    let last = min(first + LANE_ITEMS, length.value);
    var sum = 0u;
    for (var i = first; i < last; i++) {
        sum += element(i);
    }
    _ = workgroup_scan(lane, sum);
    if (lane == BLOCK_LANES - 1u && block < arrayLength(&block_sums)) {
        block_sums[block] = lane_sums[lane];
    }
}
