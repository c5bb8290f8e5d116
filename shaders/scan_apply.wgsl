// Scan, 3 of 3: the exclusive prefix sum of each element.
#import common/index
#import common/block
#import common/scan_input

@group(0) @binding(3) var<storage, read> block_sums: array<u32>;
@group(0) @binding(4) var<storage, read_write> prefix: array<u32>;

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
    var before = workgroup_scan(lane, sum);
    if (first < last) {
        before += block_sums[block];
    }
    for (var i = first; i < last; i++) {
        prefix[i] = before;
        before += element(i);
    }
}
