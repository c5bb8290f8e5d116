// A step of Adam (Kingma and Ba 2015), unless the guard is closed. Gradients become zeros in any case. Values of a row may have rates of their own.
#import common/index

struct Adam {
    count: u32,
    columns: u32,    // of a row
    first: u32,      // the first column's rate
}

const LANES = 64u;
const LANE_VALUES = 4u;
const MEAN_DECAY = 0.9;
const SQUARE_DECAY = 0.999;
const EPSILON = 1e-15;

@group(0) @binding(0) var<uniform> adam: Adam;
@group(0) @binding(1) var<storage, read> guard: u32;
@group(0) @binding(2) var<storage, read> rates: array<vec2<f32>>;   // rate / (1 - 0.9^steps), 1 / sqrt(1 - 0.999^steps)
@group(0) @binding(3) var<storage, read_write> gradients: array<f32>;
@group(0) @binding(4) var<storage, read_write> values: array<f32>;
@group(0) @binding(5) var<storage, read_write> means: array<f32>;
@group(0) @binding(6) var<storage, read_write> squares: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let first = workgroup_number(group, groups) * LANES * LANE_VALUES + lane;
    for (var k = 0u; k < LANE_VALUES; k++) {
        let i = first + k * LANES;
        if (i < adam.count) {
            let gradient = gradients[i];
            gradients[i] = 0.0;
            if (guard != 0u) {
                continue;
            }
            let rate = rates[adam.first + i % adam.columns];
            let mean = means[i] + (1.0 - MEAN_DECAY) * (gradient - means[i]);
            let square = SQUARE_DECAY * squares[i] + (1.0 - SQUARE_DECAY) * gradient * gradient;
            means[i] = mean;
            squares[i] = square;
            values[i] -= rate.x * mean / (sqrt(square) * rate.y + EPSILON);
        }
    }
}
