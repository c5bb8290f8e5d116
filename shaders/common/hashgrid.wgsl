// One level of a multi-resolution hash grid with two features an entry, and where a point lies in it.
// SLICED: the grid was cut at the time of the step, so that a level is a dense table over its two spatial axes.

struct Level {
    scale: vec3<f32>,        // cells along each axis, not rounded
    dense: u32,              // 1 where every entry has a place of its own (on the device their number may overflow)
    resolution: vec3<u32>,   // entries along each axis
    entries: u32,            // of the level in its table
    axes: vec3<u32>,         // which of x, y, z, t (0 to 3) each axis is
    number: u32,             // of the level in a row of the encoding
    first: u32,              // entry of the level in its table
    first_sliced: u32,       // entry of the level in the slices
}

struct Grid {
    points: u32,             // of a dispatch
    all_points: u32,         // of all dispatches that add to the same sums
    all_levels: u32,         // in a row of the encoding, which has two features for each
    time: f32,               // in [0, 1]
    bound: f32,              // half side of the box that the grid covers
}

#ifdef SLICED
const CORNERS = 4;
#else
const CORNERS = 8;
#endif

struct Cell {
    index: array<u32, CORNERS>,    // entries of the corners
    weight: array<f32, CORNERS>,   // all zero for a point outside the box
}

// Entry of the corner at whole-numbered coordinates: dense where the level fits into its table, else a hash; the number
// of entries is then a power of two.
fn entry(level: Level, at: vec3<u32>) -> u32 {
    let dense = at.x + level.resolution.x * (at.y + level.resolution.y * at.z);
    let hash = (at.x ^ (at.y * 2654435761u) ^ (at.z * 805459861u)) & (level.entries - 1u);
    return select(hash, dense, level.dense != 0u);
}

fn smooth_weight(f: vec3<f32>) -> vec3<f32> {
    return f * f * (3.0 - 2.0 * f);
}

fn axis_value(point: vec3<f32>, axis: u32, grid: Grid) -> f32 {
    return select((point[min(axis, 2u)] + grid.bound) / (2.0 * grid.bound), grid.time, axis == 3u);
}

// The point in the level's unit cube.
fn unit_point(point: vec3<f32>, level: Level, grid: Grid) -> vec3<f32> {
    let axes = level.axes;
    return vec3(axis_value(point, axes.x, grid), axis_value(point, axes.y, grid), axis_value(point, axes.z, grid));
}

fn find_cell(unit: vec3<f32>, level: Level) -> Cell {
    let inside = all(unit >= vec3(0.0)) && all(unit <= vec3(1.0));
    let p = select(vec3(0.0), unit * level.scale, inside);
    let low = vec3<u32>(floor(p));
    let high = min(low + 1u, level.resolution - 1u);
    let up = smooth_weight(p - floor(p));
    let down = 1.0 - up;
    var cell: Cell;
#ifdef SLICED
    let row = level.resolution.x;
    cell.index = array(low.x + row * low.y, high.x + row * low.y, low.x + row * high.y, high.x + row * high.y);
    let visible = select(0.0, 1.0, inside);
    cell.weight = array(visible * down.x * down.y, visible * up.x * down.y, visible * down.x * up.y, visible * up.x * up.y);
#else
#unroll k 8
    {
        let corner = vec3<bool>(($k & 1) != 0, ($k & 2) != 0, ($k & 4) != 0);
        let w = select(down, up, corner);
        cell.index[$k] = entry(level, select(low, high, corner));
        cell.weight[$k] = select(0.0, w.x * w.y * w.z, inside);
    }
#end
#endif
    return cell;
}
