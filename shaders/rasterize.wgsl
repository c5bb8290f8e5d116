// Draws the image: each tile's splats front to back, until no pixel of the tile sees any further.
@group(0) @binding(0) var<uniform> frame: Frame;
@group(0) @binding(1) var<storage, read_write> ranges: array<vec4<u32>>;   // a tile's; the last: common/raster
#table 2 slots: u32
#table 3 slot_ids: u32
#table 4 splats: vec4<f32>
@group(0) @binding(5) var<storage, read_write> image: array<f32>;   // planes red, green, blue, transmittance (, depth)
#ifdef ROUND_SPLATS
// [2]: whether a list of this image asks for more rounds. A round ends after ROUND_SPLATS splats; what a tile has by then
// lies in the image, the background not yet under it, and the sign of the transmittance says whether a pixel has stopped.
#ifdef LAST_ROUND
@group(0) @binding(6) var<storage, read_write> needed: array<u32>;
#endif
#endif
#import common/index
#import common/raster

#ifndef SUBGROUPS
// Barriers need control flow that is uniform to the compiler: what decides on them is read by workgroupUniformLoad.
var<workgroup> seeing: array<u32, LANES>;
var<workgroup> list: vec4<u32>;
#endif

@compute @workgroup_size($LANES)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
#ifdef SUBGROUPS
    @builtin(subgroup_size) subgroup: u32,
#endif
) {
#ifdef SUBGROUPS
    if (subgroup < u32(LANES)) {
        ranges[arrayLength(&ranges) - 1u].z = 1u;
    }
#endif
    let tile = workgroup_number(group, groups);
    if (tile >= (frame.band.y - frame.band.x) * frame.tiles.x) {
        return;
    }
    let my = place(lane);
    let corner = vec2(tile % frame.tiles.x * u32($TILE_W), (tile / frame.tiles.x + frame.band.x) * u32($TILE_H));
    let origin = vec2<f32>(corner) + 0.5;
    let x = f32(my.column);
    let y = f32(my.row);

    // Transmittance; its sign turns negative where the pixel has stopped.
    var T: array<f32, ROWS>;
    var red: array<f32, ROWS>;
    var green: array<f32, ROWS>;
    var blue: array<f32, ROWS>;
#ifdef DEPTH
    var depth: array<f32, ROWS>;
#endif
#unroll r $ROWS
    T[$r] = select(-1.0, 1.0, corner.x + my.column < frame.size.x && corner.y + my.row + $(r)u < frame.size.y);
#end

#ifdef SUBGROUPS
    let range = ranges[tile];
#else
    if (lane == 0u) {
        list = ranges[tile];
    }
    let range = workgroupUniformLoad(&list);
#endif
#ifdef ROUND_SPLATS
#ifdef CONTINUED
    if (range.w == 0u) {
        return;
    }
    let all = frame.size.x * frame.size.y;
#unroll r $ROWS
    if (corner.x + my.column < frame.size.x && corner.y + my.row + $(r)u < frame.size.y) {
        let pixel = (corner.y + my.row + $(r)u) * frame.size.x + corner.x + my.column;
        red[$r] = image[pixel];
        green[$r] = image[all + pixel];
        blue[$r] = image[2u * all + pixel];
        T[$r] = image[3u * all + pixel];
#ifdef DEPTH
        depth[$r] = image[4u * all + pixel];
#endif
    }
#end
    var first = range.z;
#else
    var first = range.x;
#endif
    let end = min(range.y, first + u32($ROUND_SPLATS));
    var closed = false;
#else
    var first = range.x;
    let end = range.y;
#endif
    while (first < end) {
        var mine = empty();
        if (first + lane < range.y) {
            mine = load(slot_ids_at(slots_at(first + lane)), origin);
        }
        let count = min(range.y - first, u32(LANES));
#ifndef SUBGROUPS
        batch[lane] = mine;
        workgroupBarrier();
#endif
        for (var j = 0u; j < count; j++) {
#ifdef SUBGROUPS
            let s = broadcast(mine, j);
#else
            let s = batch[j];
#endif
            let dx = x - s.mean.x;
            let dy = y - s.mean.y;
            let base = fma(s.a * dx, dx, s.log2_opacity);
            let slope = s.b * dx;
#unroll r $ROWS
            {
                let v = dy + $r.0;
                let b = blend(fma(v, fma(s.c, v, slope), base), T[$r]);
                T[$r] = b.transmittance;
                red[$r] = fma(b.weight, s.color.x, red[$r]);
                green[$r] = fma(b.weight, s.color.y, green[$r]);
                blue[$r] = fma(b.weight, s.color.z, blue[$r]);
#ifdef DEPTH
                depth[$r] = fma(b.weight, s.depth, depth[$r]);
#endif
            }
#end
        }
        first += count;
        var open = T[0] > 0.0;
#unroll r $ROWS
        open = open || T[$r] > 0.0;
#end
#ifdef SUBGROUPS
        if (!subgroupAny(open)) {
#ifdef ROUND_SPLATS
            closed = true;
#endif
            break;
        }
#else
        seeing[lane] = select(0u, 1u, open);
        let votes = workgroupUniformLoad(&seeing);
        var any_open = 0u;
#unroll k $LANES
        any_open |= votes[$k];
#end
        if (any_open == 0u) {
#ifdef ROUND_SPLATS
            closed = true;
#endif
            break;
        }
#endif
    }
#ifdef ROUND_SPLATS
    let unfinished = !closed && first < range.y;
    if (lane == 0u) {
        ranges[tile].w = select(0u, 1u, unfinished);
#ifdef LAST_ROUND
        if (unfinished) {
            needed[2] = 1u;
        }
#endif
    }
#endif
    if (lane == 0u) {
        ranges[tile].z = first;   // the backward pass stops here, too
    }

    let pixels = frame.size.x * frame.size.y;
#unroll r $ROWS
    if (corner.x + my.column < frame.size.x && corner.y + my.row + $(r)u < frame.size.y) {
        let pixel = (corner.y + my.row + $(r)u) * frame.size.x + corner.x + my.column;
#ifdef ROUND_SPLATS
        let t = select(abs(T[$r]), 0.0, unfinished);
#else
        let t = abs(T[$r]);
#endif
        image[pixel] = red[$r] + t * frame.background.x;
        image[pixels + pixel] = green[$r] + t * frame.background.y;
        image[2u * pixels + pixel] = blue[$r] + t * frame.background.z;
#ifdef ROUND_SPLATS
        image[3u * pixels + pixel] = select(t, T[$r], unfinished);
#else
        image[3u * pixels + pixel] = t;
#endif
#ifdef DEPTH
        image[4u * pixels + pixel] = depth[$r];
#endif
    }
#end
}
