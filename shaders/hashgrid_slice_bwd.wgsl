// Spreads the gradient of a slice over the two planes of the table from which it was blended.
#import common/slice

@group(0) @binding(0) var<uniform> grid: Grid;
@group(0) @binding(1) var<storage, read> levels: array<Level>;
#table 2 d_slices: vec2<f32>
@group(0) @binding(3) var<storage, read_write> d_features: array<vec2<f32>>;   // zero before

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let level = levels[group.y];
    let slice = slice_of(level, grid.time);
    for (var k = 0u; k < LANE_CELLS; k++) {
        let cell = (group.x * LANE_CELLS + k) * LANES + lane;
        if (cell < slice.cells) {
            let gradient = d_slices_at(level.first_sliced + cell);
            d_features[slice.below + cell] += (1.0 - slice.up) * gradient;
            d_features[slice.above + cell] += slice.up * gradient;
        }
    }
}
