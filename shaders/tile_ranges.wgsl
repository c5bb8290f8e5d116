// Marks where each tile's list begins and ends among the sorted intersections. Each lane looks at four of them.
// The lanes that find the two write single words: a write to a component of a vector may write the whole vector.
#import common/count
#import common/frame
#import common/index

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> needed: Count;   // intersections
// sorted
#table 2 tile_keys: vec4<u32>
@group(0) @binding(3) var<storage, read_write> ranges: array<u32>;   // 4 a tile: first, one past the last; rasterize: drawn, unfinished

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
    let tiles = arrayLength(&ranges) / 4u - 1u;   // the key of a pad
    let keys = tile_keys_at(quad);
    // No key is so large: a list begins at the first element in any case.
    var before = select(tile_keys_at(max(quad, 1u) - 1u).w, 0xffffffffu, quad == 0u);
#unroll k 4
    {
        let i = 4u * quad + $(k)u;
        let tile = keys[$k];
        if (i < count && tile != before) {
            if (tile < tiles) {
                ranges[4u * tile] = i;
            }
            if (before < tiles) {
                ranges[4u * before + 1u] = i;
            }
        }
        before = tile;
    }
#end
    let last = keys[(count - 1u) % 4u];
    if (4u * quad + 4u >= count && last < tiles) {
        ranges[4u * last + 1u] = count;
    }
}
