// The gradient of the image for each intersection, front to back, summed over the tile's pixels in a fixed order and
// written where the intersection stands in the sorted lists, so that no atomics are needed and every run gives the same
// bits. Neighbours in a list are written one after the other, which caches like better than a record at each slot;
// `gather_gradients` finds a slot's record by its place.
//
// Per pixel: T, and `rest`, what the splats not yet passed (and the background) add to sum(image * d_image). Then
//   d_loss / d_alpha = T (color . d_color) - rest_after / (1 - alpha).
// A record holds the moments of v = alpha d_loss/d_alpha over the pixels (1, x, y, x^2, x y, y^2, relative to the mean),
// since the gradients of opacity, mean and conic are linear in them; red, green, blue; depth.
@group(0) @binding(0) var<uniform> frame: Frame;
#ifdef SUBGROUPS
@group(0) @binding(1) var<storage, read_write> ranges: array<vec4<u32>>;   // a tile's; the last: common/raster
#else
@group(0) @binding(1) var<storage, read> ranges: array<vec4<u32>>;
#endif
#table 2 slots: u32
#table 3 slot_ids: u32
#table 4 splats: vec4<f32>
// image as the forward pass left it; d_image: planes red, green, blue, alpha (, depth)
#table 5 image: f32
#table 6 d_image: f32
@group(0) @binding(7) var<storage, read_write> records: array<f32>;        // 8 a record: the moments, red, green
// Of each slot the place of its record, from 1, or 0, as before, where nobody saw it; then of each record blue (, then
// depth), as bits.
@group(0) @binding(8) var<storage, read_write> record_tails: array<u32>;
#ifdef ROUNDS
// Of a list that is drawn in rounds, each round takes ROUND_SPLATS splats, and leaves transmittance and rest of its pixels
// behind all tails.
struct Piece { number: u32, state: u32 }   // the place of the state among the tails
@group(0) @binding(9) var<uniform> piece: Piece;
#endif
#import common/index
#import common/raster
#import common/lane_sums

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
        ranges[arrayLength(&ranges) - 1u].w = 1u;
    }
#endif
    let tile = workgroup_number(group, groups);
    if (tile >= (frame.band.y - frame.band.x) * frame.tiles.x) {
        return;
    }
    let range = ranges[tile];
#ifdef ROUNDS
    let begin = range.x + piece.number * u32($ROUND_SPLATS);
    let end = min(range.z, begin + u32($ROUND_SPLATS));
#else
    let begin = range.x;
    let end = range.z;
#endif
    if (begin >= end) {
        return;   // before a pixel is read: most tiles of many images are empty
    }
    let my = place(lane);
    let corner = vec2(tile % frame.tiles.x * u32($TILE_W), (tile / frame.tiles.x + frame.band.x) * u32($TILE_H));
    let origin = vec2<f32>(corner) + 0.5;
    let x = f32(my.column);
    let y = f32(my.row);
    let pixels = frame.size.x * frame.size.y;

    var T: array<f32, ROWS>;
    var rest: array<f32, ROWS>;
    var d_red: array<f32, ROWS>;
    var d_green: array<f32, ROWS>;
    var d_blue: array<f32, ROWS>;
#ifdef DEPTH
    var d_depth: array<f32, ROWS>;
#endif
#unroll r $ROWS
    T[$r] = -1.0;
    if (corner.x + my.column < frame.size.x && corner.y + my.row + $(r)u < frame.size.y) {
        let pixel = (corner.y + my.row + $(r)u) * frame.size.x + corner.x + my.column;
        T[$r] = 1.0;
        d_red[$r] = d_image_at(pixel);
        d_green[$r] = d_image_at(pixels + pixel);
        d_blue[$r] = d_image_at(2u * pixels + pixel);
        // alpha = 1 - transmittance
        rest[$r] = image_at(pixel) * d_red[$r] + image_at(pixels + pixel) * d_green[$r] + image_at(2u * pixels + pixel) * d_blue[$r]
            - image_at(3u * pixels + pixel) * d_image_at(3u * pixels + pixel);
#ifdef DEPTH
        d_depth[$r] = d_image_at(4u * pixels + pixel);
        rest[$r] += image_at(4u * pixels + pixel) * d_depth[$r];
#endif
    }
#end

#ifdef ROUNDS
    if (piece.number > 0u) {
#unroll r $ROWS
        if (corner.x + my.column < frame.size.x && corner.y + my.row + $(r)u < frame.size.y) {
            let at = piece.state + 2u * ((corner.y + my.row + $(r)u) * frame.size.x + corner.x + my.column);
            T[$r] = bitcast<f32>(record_tails[at]);
            rest[$r] = bitcast<f32>(record_tails[at + 1u]);
        }
#end
    }
#endif
    for (var first = begin; first < end; first += u32(LANES)) {
        var mine = empty();
        var slot = 0u;
        var my_blue = 0.0;
        var my_depth = 0.0;
        if (first + lane < range.y) {
            slot = slots_at(first + lane);
            mine = load(slot_ids_at(slot), origin);
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
            var m0 = 0.0;   // moments of v over the lane's rows: 1, y, y^2
            var m1 = 0.0;
            var m2 = 0.0;
            var g_red = 0.0;
            var g_green = 0.0;
            var g_blue = 0.0;
            var g_depth = 0.0;
#unroll r $ROWS
            {
                let v = dy + $r.0;
                let t = T[$r];
                let b = blend(fma(v, fma(s.c, v, slope), base), t);
                T[$r] = b.transmittance;
                var value = fma(s.color.x, d_red[$r], fma(s.color.y, d_green[$r], s.color.z * d_blue[$r]));
#ifdef DEPTH
                value = fma(s.depth, d_depth[$r], value);
                g_depth = fma(b.weight, d_depth[$r], g_depth);
#endif
                rest[$r] = fma(-b.weight, value, rest[$r]);
                let d_alpha = t * value - rest[$r] / (1.0 - b.alpha);
                let moment = select(b.alpha * d_alpha, 0.0, b.stop || b.unclamped > ALPHA_MAX);
                m0 += moment;
                m1 = fma(moment, v, m1);
                m2 = fma(moment * v, v, m2);
                g_red = fma(b.weight, d_red[$r], g_red);
                g_green = fma(b.weight, d_green[$r], g_green);
                g_blue = fma(b.weight, d_blue[$r], g_blue);
            }
#end
            let mx = m0 * dx;
#ifdef SUBGROUPS
            let value = eight_sums(lane, vec4(m0, mx, m1, mx * dx), vec4(m1 * dx, m2, g_red, g_green));
            my_blue = select(my_blue, subgroup_sum(g_blue), lane == j);
#ifdef DEPTH
            my_depth = select(my_depth, subgroup_sum(g_depth), lane == j);
#endif
            if (lane < 8u) {
                records[(first + j) * 8u + lane] = value;
            }
#else
            partials[0][lane] = m0;
            partials[1][lane] = mx;
            partials[2][lane] = m1;
            partials[3][lane] = mx * dx;
            partials[4][lane] = m1 * dx;
            partials[5][lane] = m2;
            partials[6][lane] = g_red;
            partials[7][lane] = g_green;
            partials[8][lane] = g_blue;
#ifdef DEPTH
            partials[9][lane] = g_depth;
#endif
            workgroupBarrier();
            for (var k = lane; k < VALUES; k += u32(LANES)) {
                var sum = 0.0;
                for (var other = 0u; other < u32(LANES); other++) {
                    sum += partials[k][other];
                }
                if (k < 8u) {
                    records[(first + j) * 8u + k] = sum;
                } else {
                    record_tails[(k - 7u) * frame.capacity + first + j] = bitcast<u32>(sum);
                }
            }
            workgroupBarrier();
#endif
        }
        if (lane < count) {   // each lane keeps the last values of its own splat, to write them for all at once
            record_tails[slot] = first + lane + 1u;
#ifdef SUBGROUPS
            record_tails[frame.capacity + first + lane] = bitcast<u32>(my_blue);
#ifdef DEPTH
            record_tails[2u * frame.capacity + first + lane] = bitcast<u32>(my_depth);
#endif
#endif
        }
    }
#ifdef ROUNDS
#unroll r $ROWS
    if (corner.x + my.column < frame.size.x && corner.y + my.row + $(r)u < frame.size.y) {
        let at = piece.state + 2u * ((corner.y + my.row + $(r)u) * frame.size.x + corner.x + my.column);
        record_tails[at] = bitcast<u32>(T[$r]);
        record_tails[at + 1u] = bitcast<u32>(rest[$r]);
    }
#end
#endif
}
