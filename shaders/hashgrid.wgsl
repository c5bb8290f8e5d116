// Encodes points: two features a level, interpolated between the corners of the cell in which a point lies.
// LONG_LANES, for devices of few wide cores: a lane takes more points.
#import common/hashgrid
#import common/index

@group(0) @binding(0) var<uniform> grid: Grid;
@group(0) @binding(1) var<storage, read> levels: array<Level>;
// (N, 4): x, y, z, -
#table 2 points: vec4<f32>
// a grid's table, or the slices of all grids
#table 3 features: vec2<f32>
@group(0) @binding(4) var<storage, read_write> encoding: array<f32>;   // (N, 2 x all levels)

const LANES = 64u;
// so that a level's description is loaded once for several points
#ifdef LONG_LANES
const LANE_POINTS = 32u;
#else
const LANE_POINTS = 8u;
#endif

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let number = workgroup_number(group, groups);
    let blocks = (grid.points + LANES * LANE_POINTS - 1u) / (LANES * LANE_POINTS);
    if (number >= blocks * arrayLength(&levels)) {
        return;
    }
#ifdef SLICED
    // All slices fit into a cache: level after level of the same points, whose rows of the encoding then stay there, too.
    let level = levels[number % arrayLength(&levels)];
    let block = number / arrayLength(&levels);
    let first = level.first_sliced;
#else
    let level = levels[number / blocks];
    let block = number % blocks;
    let first = level.first;
#endif
    for (var k = 0u; k < LANE_POINTS; k++) {
        let i = (block * LANE_POINTS + k) * LANES + lane;
        if (i < grid.points) {
            let cell = find_cell(unit_point(points_at(i).xyz, level, grid), level);
            var sum = vec2(0.0);
#unroll c $CORNERS
            sum += cell.weight[$c] * features_at(first + cell.index[$c]);
#end
            let at = i * grid.all_levels + level.number;
            encoding[2u * at] = sum.x;
            encoding[2u * at + 1u] = sum.y;
        }
    }
}
