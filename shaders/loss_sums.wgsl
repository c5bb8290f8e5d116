// Adds up the lanes' partial sums, a workgroup a term, in a fixed order.
struct Parts {   // the first and one past the last of each term
    l1: vec2<u32>,
    squared: vec2<u32>,
    ssim: vec2<u32>,
    pyramid: vec2<u32>,
    ncc: vec2<u32>,
}

@group(0) @binding(0) var<uniform> parts: Parts;
@group(0) @binding(1) var<storage, read> sums: array<f32>;
@group(0) @binding(2) var<storage, read_write> terms: array<f32>;

var<workgroup> of_lanes: array<f32, $LANES>;

@compute @workgroup_size($LANES)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    var all = array<vec2<u32>, 5>(parts.l1, parts.squared, parts.ssim, parts.pyramid, parts.ncc);
    let bounds = all[group.x];
    var sum = 0.0;
    for (var i = bounds.x + lane; i < bounds.y; i += u32($LANES)) {
        sum += sums[i];
    }
    of_lanes[lane] = sum;
    workgroupBarrier();
    if (lane == 0u) {
        for (var k = 1u; k < u32($LANES); k++) {
            sum += of_lanes[k];
        }
        terms[group.x] = sum;
    }
}
