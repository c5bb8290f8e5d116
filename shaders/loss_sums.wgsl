// Adds up the lanes' partial sums, a workgroup a term, in a fixed order.
struct Ends { l1: u32, squared: u32, ssim: u32, pyramid: u32, ncc: u32 }   // one past the last of each term

@group(0) @binding(0) var<uniform> ends: Ends;
@group(0) @binding(1) var<storage, read> sums: array<f32>;
@group(0) @binding(2) var<storage, read_write> terms: array<f32>;

var<workgroup> of_lanes: array<f32, $LANES>;

@compute @workgroup_size($LANES)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    var bounds = array<u32, 6>(0u, ends.l1, ends.squared, ends.ssim, ends.pyramid, ends.ncc);
    let end = bounds[group.x + 1u];
    var sum = 0.0;
    for (var i = bounds[group.x] + lane; i < end; i += u32($LANES)) {
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
