// A level of a temporal grid at one time, which lies between two of its planes; and how its cells are shared among lanes.
// LONG_LANES, for devices of few wide cores: a lane takes several cells, so that a level's description is loaded once for all.
#import common/hashgrid

const LANES = 64u;
#ifdef LONG_LANES
const LANE_CELLS = 16u;
#else
const LANE_CELLS = 1u;
#endif

struct Slice {
    cells: u32,   // of a plane
    below: u32,   // entries of the first cells of both planes
    above: u32,
    up: f32,      // weight of the plane above
}

fn slice_of(level: Level, time: f32) -> Slice {
    let cells = level.resolution.x * level.resolution.y;
    let p = time * level.scale.z;
    let low = u32(floor(p));
    let high = min(low + 1u, level.resolution.z - 1u);
    let up = smooth_weight(vec3(p - floor(p))).x;
    return Slice(cells, level.first + low * cells, level.first + high * cells, up);
}
