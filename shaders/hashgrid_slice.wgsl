// Cuts the levels of a temporal grid at one time: each entry of a slice is blended from the two planes around that time.
#import common/hashgrid
#import common/slice_lanes

@group(0) @binding(0) var<uniform> grid: Grid;
@group(0) @binding(1) var<storage, read> levels: array<Level>;
#table 2 features: vec2<f32>
@group(0) @binding(3) var<storage, read_write> slices: array<vec2<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let level = levels[group.y];
    let plane = level.resolution.x * level.resolution.y;
    let p = grid.time * level.scale.z;
    let up = smooth_weight(vec3(p - floor(p))).x;
    let low = u32(floor(p));
    let high = min(low + 1u, level.resolution.z - 1u);
    for (var k = 0u; k < LANE_CELLS; k++) {
        let cell = (group.x * LANE_CELLS + k) * LANES + lane;
        if (cell < plane) {
            let below = features_at(level.first + low * plane + cell);
            let above = features_at(level.first + high * plane + cell);
            slices[level.first_sliced + cell] = (1.0 - up) * below + up * above;
        }
    }
}
