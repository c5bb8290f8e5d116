// The sums of columns of values, times a factor, by a workgroup each.
struct Values {
    rows: u32,
    columns: u32,
    place: u32,     // of the first sum in `totals`
    factor: f32,
}

const LANES = 256u;

@group(0) @binding(0) var<uniform> sum: Values;
@group(0) @binding(1) var<storage, read> values: array<f32>;
@group(0) @binding(2) var<storage, read_write> totals: array<f32>;

var<workgroup> of_lane: array<f32, LANES>;

@compute @workgroup_size(256)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    var mine = 0.0;
    for (var i = lane; i < sum.rows; i += LANES) {
        mine += values[sum.columns * i + group.x];
    }
    of_lane[lane] = mine;
    workgroupBarrier();
    if (lane == 0u) {
        var total = 0.0;
        for (var i = 0u; i < LANES; i++) {
            total += of_lane[i];
        }
        totals[sum.place + group.x] = sum.factor * total;
    }
}
