// The gradients of the spectrum's amplitudes and frequencies, a component a workgroup.
#import common/spectrum

@group(0) @binding(0) var<uniform> spectrum: Spectrum;
@group(0) @binding(1) var<storage, read> weights: array<f32>;
@group(0) @binding(2) var<storage, read> d_series: array<f32>;           // (width,)
@group(0) @binding(3) var<storage, read_write> d_weights: array<f32>;    // added to

const LANES = 64u;
var<workgroup> of_lane: array<f32, LANES>;

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let k = group.x;
    let wave = phase(weights[spectrum.frequencies + k], spectrum.time);
    var slope = 0.0;
    for (var w = lane; w < spectrum.width; w += LANES) {
        let at = k * spectrum.width + w;
        let d = d_series[w];
        d_weights[spectrum.alpha + at] += wave.x * d;
        d_weights[spectrum.beta + at] += wave.y * d;
        slope += d * (wave.x * weights[spectrum.beta + at] - wave.y * weights[spectrum.alpha + at]);
    }
    of_lane[lane] = slope;
    workgroupBarrier();
    if (lane == 0u) {
        var sum = 0.0;
        for (var i = 0u; i < LANES; i++) {
            sum += of_lane[i];
        }
        d_weights[spectrum.frequencies + k] += TURN * spectrum.time * sum;
    }
}
