// Scan, 2 of 3: one workgroup turns the blocks' sums into their exclusive prefix sums and writes the total.
#import common/block

struct Blocks { count: u32 }

@group(0) @binding(0) var<uniform> blocks: Blocks;
@group(0) @binding(1) var<storage, read_write> block_sums: array<u32>;
@group(0) @binding(2) var<storage, read_write> total: array<u32>;

@compute @workgroup_size($SCAN_LANES)
fn main(@builtin(local_invocation_index) lane: u32) {
    var before = 0u;
    for (var start = 0u; start < blocks.count; start += BLOCK_LANES) {
        let i = start + lane;
        var sum = 0u;
        if (i < blocks.count) {
            sum = block_sums[i];
        }
        let prefix = workgroup_scan(lane, sum);
        if (i < blocks.count) {
            block_sums[i] = plus(before, prefix);
        }
        before = plus(before, lane_sums[BLOCK_LANES - 1u]);
        workgroupBarrier();
    }
    if (lane == 0u) {
        total[0] = before;
    }
}
