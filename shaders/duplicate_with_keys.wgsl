// Writes, for each visible splat in depth order, the tiles that it touches: a tile key and the splat's number at each of
// its slots, which are contiguous.
#import common/frame
#import common/count
#import common/index
#import common/splat
#import common/tile

@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<uniform> visible: Count;
#table 2 splats: vec4<f32>
#table 3 ids: u32
#table 4 tile_counts: u32
#table 5 offsets: u32
@group(0) @binding(6) var<storage, read_write> tile_keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> slot_ids: array<u32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let rank = workgroup_number(group, groups) * 64u + lane;
    if (rank >= visible.value) {
        return;
    }
    let id = ids_at(rank);
    var slot = offsets_at(rank);
    // Where the buffers are too small the host learns it from the total, enlarges them and draws again.
    let end = min(slot + tile_counts_at(id), frame.capacity);
    let a = splats_at(id * SPLAT_STRIDE);
    let b = splats_at(id * SPLAT_STRIDE + 1u);
    let e = make_ellipse(a.xy, vec3(a.zw, b.x), splats_at(id * SPLAT_STRIDE + 2u).w, b.y);
    let rows = tile_rows(e, frame.band, WRITTEN_PADDING);
    for (var row = rows.x; row < rows.y; row++) {
        let columns = tile_columns(e, row, frame.tiles.x, WRITTEN_PADDING);
        for (var column = columns.x; column < columns.y && slot < end; column++) {
            tile_keys[slot] = (row - frame.band.x) * frame.tiles.x + column;
            slot_ids[slot] = id;
            slot++;
        }
    }
    // Slots of tiles that were counted but not written are pads, which sort behind all tiles.
    for (; slot < end; slot++) {
        tile_keys[slot] = (frame.band.y - frame.band.x) * frame.tiles.x;
        slot_ids[slot] = id;
    }
}
