// Cuts the levels of a temporal grid at one time: each entry of a slice is blended from the two planes around that time.
#import common/slice

@group(0) @binding(0) var<uniform> grid: Grid;
@group(0) @binding(1) var<storage, read> levels: array<Level>;
#table 2 features: vec2<f32>
@group(0) @binding(3) var<storage, read_write> slices: array<vec2<f32>>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let level = levels[group.y];
    let slice = slice_of(level, grid.time);
    for (var k = 0u; k < LANE_CELLS; k++) {
        let cell = (group.x * LANE_CELLS + k) * LANES + lane;
        if (cell < slice.cells) {
            let below = features_at(slice.below + cell);
            let above = features_at(slice.above + cell);
            slices[level.first_sliced + cell] = (1.0 - slice.up) * below + slice.up * above;
        }
    }
}
