// The loss of the dynamics attributes: GROUPS workgroups take a part of the rows each, and leave partial sums that all of the
// next pass add up in their order.
struct Dynamics {
    gaussians: u32,
    columns: u32,    // of the attribute
    stride: u32,     // of a row
    weight: f32,     // of the loss
}

const GROUPS = $GROUPS;
const LANES = 64u;
const MOST_COLUMNS = 256u;
const ROUNDING = 1e-6;   // tolerance: distances that are equal except for rounding are no outliers

@group(0) @binding(0) var<uniform> dynamics: Dynamics;

fn part_begin(group: u32) -> u32 {
    return min(group * ((dynamics.gaussians + GROUPS - 1u) / GROUPS), dynamics.gaussians);
}
