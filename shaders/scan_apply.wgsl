// Scan, 2 of 2: the exclusive prefix sum of each element, and the total.
#import common/index
#import common/block
#import common/scan_input

@group(0) @binding(3) var<storage, read> block_sums: array<u32>;
@group(0) @binding(4) var<storage, read_write> prefix: array<u32>;
@group(0) @binding(5) var<storage, read_write> total: array<u32>;

@compute @workgroup_size($SCAN_LANES)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let block = workgroup_number(group, groups);
    let last_block = (max(length.value, 1u) - 1u) / BLOCK_ITEMS;
    if (block > last_block) {
        return;
    }
    var blocks_before = 0u;
    for (var i = lane; i < block; i += BLOCK_LANES) {
        blocks_before = plus(blocks_before, block_sums[i]);
    }
    _ = workgroup_scan(lane, blocks_before);
    blocks_before = lane_sums[BLOCK_LANES - 1u];
    workgroupBarrier();

    let first = block * BLOCK_ITEMS + lane * LANE_ITEMS;
    let last = min(first + LANE_ITEMS, length.value);
    var sum = 0u;
    for (var i = first; i < last; i++) {
        sum += element(i);
    }
    var before = plus(blocks_before, workgroup_scan(lane, sum));
    for (var i = first; i < last; i++) {
        prefix[i] = before;
        before += element(i);
    }
    if (block == last_block && lane == BLOCK_LANES - 1u) {
        total[0] = plus(blocks_before, lane_sums[lane]);
    }
}
