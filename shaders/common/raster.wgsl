// What the rasterizer's two passes share: a workgroup draws one tile, each lane ROWS pixels of one column, and a batch of
// as many splats as lanes is loaded at once, one a lane, then handed round. With SUBGROUPS the workgroup lies in one
// subgroup and splats are handed round by shuffles, otherwise through workgroup memory. A driver may choose narrower
// subgroups for one pipeline than for another: then the pass says so behind the ranges of all tiles (z: rasterize, w:
// rasterize_bwd), and its output is invalid.
#import common/constants
#import common/frame
#import common/splat

const LANES = $LANES;
const ROWS = $ROWS;
const LOG2_E: f32 = 1.4426950408889634;

// The splat that a lane holds, in the tile's own coordinates (pixel centres at whole numbers):
// log2 alpha at (x, y) = log2_opacity + a x^2 + y (b x + c y), with x and y relative to the mean.
struct Loaded {
    mean: vec2<f32>,
    a: f32, b: f32, c: f32,
    log2_opacity: f32,
    color: vec3<f32>,
#ifdef DEPTH
    depth: f32,
#endif
}

// 2^x for x <= 0. Software drivers spend most of the raster's time in exp2, so theirs is a polynomial of degree 5 on the
// fraction, of relative error 8e-8 there; below -126 the result is meaningless, and nobody looks at it.
fn power_of_two(x: f32) -> f32 {
#ifdef POLYNOMIAL_EXP2
    let n = round(x);
    let f = x - n;
    let shifted = n + 12582912.0;   // 1.5 * 2^23: n as a whole number in the lowest bits
    let p = fma(f, fma(f, fma(f, fma(f, fma(f, 0.0013276469, 0.0096755413), 0.055507133), 0.2402212), 0.69314697), 1.0);
    return bitcast<f32>(bitcast<u32>(p) + (bitcast<u32>(shifted) << 23u));
#else
    return exp2(x);
#endif
}

// What a splat does to a pixel. Both passes blend by this function, so that they agree to the bit.
struct Blend {
    unclamped: f32,
    alpha: f32,
    weight: f32,          // of the splat's color; 0 where the pixel stops
    transmittance: f32,   // behind the splat; its sign turns negative where the pixel stops
    stop: bool,
}

fn blend(log2_alpha: f32, transmittance: f32) -> Blend {
    let unclamped = power_of_two(log2_alpha);
    let alpha = select(0.0, min(ALPHA_MAX, unclamped), log2_alpha >= LOG2_ALPHA_MIN);
    let weight = transmittance * alpha;
    let next = transmittance - weight;
    let stop = next <= TRANSMITTANCE_MIN;
    return Blend(unclamped, alpha, select(weight, 0.0, stop), select(next, -abs(transmittance), stop), stop);
}

struct Place { column: u32, row: u32 }   // a lane's pixels within the tile: its column and its first row

fn place(lane: u32) -> Place {
    return Place(lane % u32($TILE_W), lane / u32($TILE_W) * u32(ROWS));
}

fn load(id: u32, origin: vec2<f32>) -> Loaded {
    let s0 = splats_at(id * SPLAT_STRIDE);
    let s1 = splats_at(id * SPLAT_STRIDE + 1u);
    let s2 = splats_at(id * SPLAT_STRIDE + 2u);
    var s: Loaded;
    s.mean = s0.xy - origin;
    s.a = -0.5 * LOG2_E * s0.z;
    s.b = -LOG2_E * s0.w;
    s.c = -0.5 * LOG2_E * s1.x;
    s.log2_opacity = s1.y;
    s.color = vec3(s1.zw, s2.x);
#ifdef DEPTH
    s.depth = s2.y;
#endif
    return s;
}

fn empty() -> Loaded {
    var s: Loaded;
    s.log2_opacity = -1e4;
    return s;
}

#ifdef SUBGROUPS
fn broadcast(s: Loaded, from_lane: u32) -> Loaded {
    var r: Loaded;
    r.mean = vec2(subgroupShuffle(s.mean.x, from_lane), subgroupShuffle(s.mean.y, from_lane));
    r.a = subgroupShuffle(s.a, from_lane);
    r.b = subgroupShuffle(s.b, from_lane);
    r.c = subgroupShuffle(s.c, from_lane);
    r.log2_opacity = subgroupShuffle(s.log2_opacity, from_lane);
    r.color = vec3(
        subgroupShuffle(s.color.x, from_lane), subgroupShuffle(s.color.y, from_lane), subgroupShuffle(s.color.z, from_lane));
#ifdef DEPTH
    r.depth = subgroupShuffle(s.depth, from_lane);
#endif
    return r;
}
#else
var<workgroup> batch: array<Loaded, LANES>;
#endif
