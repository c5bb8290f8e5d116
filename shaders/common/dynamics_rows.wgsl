// The mean row, and the distances of rows from it.
@group(0) @binding(1) var<storage, read> rows: array<f32>;   // (N, stride)
@group(0) @binding(2) var<storage, read> sums: array<f32>;   // (GROUPS, MOST_COLUMNS), as `dynamics_mean` leaves them

var<workgroup> mean_row: array<f32, MOST_COLUMNS>;
var<workgroup> of_lane: array<f32, LANES>;

fn load_mean_row(lane: u32) {
    for (var column = lane; column < dynamics.columns; column += LANES) {
        var sum = 0.0;
        for (var g = 0u; g < GROUPS; g++) {
            sum += sums[g * MOST_COLUMNS + column];
        }
        mean_row[column] = sum / f32(dynamics.gaussians);
    }
    workgroupBarrier();
}

fn squared_distance(i: u32) -> f32 {
    var sum = 0.0;
    for (var column = 0u; column < dynamics.columns; column++) {
        let offset = rows[i * dynamics.stride + column] - mean_row[column];
        sum += offset * offset;
    }
    return sum;
}

// The sum over the lanes, for lane 0.
fn lanes_sum(lane: u32, value: f32) -> f32 {
    of_lane[lane] = value;
    workgroupBarrier();
    var sum = 0.0;
    if (lane == 0u) {
        for (var i = 0u; i < LANES; i++) {
            sum += of_lane[i];
        }
    }
    return sum;
}
