// Marks where each tile's list begins and ends among the sorted intersections. Each lane looks at four of them.
#import common/count
#import common/frame
#import common/index

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> needed: Count;   // intersections
// sorted; the same buffer twice
#table 2 tile_keys: vec4<u32>
#table 3 tile_keys_singly: u32
@group(0) @binding(4) var<storage, read_write> ranges: array<vec4<u32>>;   // first, one past the last, drawn, -

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let quad = workgroup_number(group, groups) * 64u + lane;
    let count = min(needed.value, frame.capacity);
    if (4u * quad >= count) {
        return;
    }
    let keys = tile_keys_at(quad);
    // No key is so large: before the first and after the last element a range ends in any case.
    var before = select(tile_keys_singly_at(max(4u * quad, 1u) - 1u), 0xffffffffu, quad == 0u);
    let after = tile_keys_singly_at(min(4u * quad + 4u, count - 1u));
#unroll k 4
    {
        let i = 4u * quad + $(k)u;
        let tile = keys[$k];
        let next = select(after, keys[min($k + 1, 3)], $k < 3);
        if (i < count && tile < arrayLength(&ranges)) {   // a pad has no tile
            if (tile != before) {
                ranges[tile].x = i;
            }
            if (i + 1u == count || tile != next) {
                ranges[tile].y = i + 1u;
            }
        }
        before = tile;
    }
#end
}
