// Adds gradients in 64-bit fixed point to those in floats, and leaves zeros for the next ones.
#import common/fixed_scale
#import common/hashgrid
#import common/index

@group(0) @binding(0) var<uniform> grid: Grid;
@group(0) @binding(1) var<storage, read_write> d_fixed: array<vec2<u32>>;
@group(0) @binding(2) var<storage, read_write> d_features: array<f32>;
@group(0) @binding(3) var<storage, read> largest: u32;   // as hashgrid_bwd has it

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = workgroup_number(group, groups) * 64u + lane;
    if (i >= arrayLength(&d_features) || i >= arrayLength(&d_fixed)) {
        return;
    }
    var word = d_fixed[i];
    d_fixed[i] = vec2(0u);
    let negative = (word.y & 0x80000000u) != 0u;
    if (negative) {
        word = vec2(~word.x + 1u, ~word.y + select(0u, 1u, word.x == 0u));
    }
    let magnitude = (f32(word.y) * 4294967296.0 + f32(word.x)) / fixed_scale(largest, grid.all_points);
    let sum = select(magnitude, -magnitude, negative);
    // Fixed point has no infinity and no NaN, which the training must see.
    let lost = bitcast<f32>(largest);
    d_features[i] += select(sum, lost, (largest >> 23u) == 255u);
}
