// The gradient of a grid's table, or of the slices of all grids. Each of its entries is a sum over many points, and the same to the
// last bit on every run:
// LANE_LEVELS, for devices of few wide cores: a lane owns a level and adds the points in their order.
// Otherwise: a lane owns a point and adds in 64-bit fixed point, whose sum does not depend on the order.
#import common/fixed_scale
#import common/hashgrid
#import common/index

@group(0) @binding(0) var<uniform> grid: Grid;
@group(0) @binding(1) var<storage, read> levels: array<Level>;
// (N, 4): x, y, z, -
#table 2 points: vec4<f32>
// (N, all levels): the gradient of two features of a point
#table 3 d_encoding: vec2<f32>

fn first_entry(level: Level) -> u32 {
#ifdef SLICED
    return level.first_sliced;
#else
    return level.first;
#endif
}

#ifdef LANE_LEVELS
@group(0) @binding(4) var<storage, read_write> d_features: array<vec2<f32>>;   // zero before

@compute @workgroup_size(8)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let share = (arrayLength(&levels) + groups.x - 1u) / groups.x;   // of a workgroup, at most 8
    let number = group.x * share + lane;
    if (lane >= share || number >= arrayLength(&levels)) {
        return;
    }
    let level = levels[number];
    let first = first_entry(level);
    for (var i = 0u; i < grid.points; i++) {
        let cell = find_cell(unit_point(points_at(i).xyz, level, grid), level);
        let gradient = d_encoding_at(i * grid.all_levels + level.number);
#unroll c $CORNERS
        d_features[first + cell.index[$c]] += cell.weight[$c] * gradient;
#end
    }
}
#else
@group(0) @binding(4) var<storage, read_write> d_fixed: array<atomic<u32>>;   // low and high word of each feature; zero before
@group(0) @binding(5) var<storage, read> largest: u32;   // gradient's absolute value, of all points

fn add_fixed(at: u32, value: f32, scale: f32) {
    // |value| x scale < 2^62: two words by splitting the float, which loses nothing below its own last bit.
    let magnitude = abs(value) * scale;
    let upper = floor(magnitude / 4294967296.0);
    var low = u32(magnitude - upper * 4294967296.0);
    var high = u32(upper);
    if (value < 0.0) {   // two's complement
        low = ~low + 1u;
        high = ~high + select(0u, 1u, low == 0u);
    }
    let before = atomicAdd(&d_fixed[at], low);
    atomicAdd(&d_fixed[at + 1u], high + select(0u, 1u, before + low < before));
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let number = workgroup_number(group, groups);
    let blocks = (grid.points + 63u) / 64u;
    let i = number % blocks * 64u + lane;
    if (number >= blocks * arrayLength(&levels) || i >= grid.points) {
        return;
    }
    let level = levels[number / blocks];
    let first = first_entry(level);
    let cell = find_cell(unit_point(points_at(i).xyz, level, grid), level);
    let gradient = d_encoding_at(i * grid.all_levels + level.number);
    let scale = fixed_scale(largest, grid.all_points);
#unroll c $CORNERS
    add_fixed(4u * (first + cell.index[$c]), cell.weight[$c] * gradient.x, scale);
    add_fixed(4u * (first + cell.index[$c]) + 2u, cell.weight[$c] * gradient.y, scale);
#end
}
#endif
