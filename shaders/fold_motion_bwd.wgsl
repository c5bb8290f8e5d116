// The gradients of the weights from those of what `fold_motion` leaves, a channel a workgroup. MOTION: also of the motion's
// second layer and of the spectrum's channels.
#import common/spectrum

@group(0) @binding(0) var<uniform> spectrum: Spectrum;
@group(0) @binding(1) var<storage, read> d_heads: array<f32>;            // (outputs, columns)
@group(0) @binding(2) var<storage, read> d_biases: array<f32>;           // (outputs,)
@group(0) @binding(3) var<storage, read_write> d_weights: array<f32>;    // added to
const LANES = 64u;
#ifdef MOTION
@group(0) @binding(4) var<storage, read> weights: array<f32>;
@group(0) @binding(5) var<storage, read> series: array<f32>;
@group(0) @binding(6) var<storage, read_write> d_series: array<f32>;     // (width,)
var<workgroup> of_lane: array<f32, LANES * MOVED>;
#endif

@compute @workgroup_size(64)
fn main(@builtin(workgroup_id) group: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    let w = group.x;
    if (lane < spectrum.outputs) {
        let factor = head_factor(spectrum, lane);
        d_weights[spectrum.heads + lane * spectrum.width + w] += factor * d_heads[lane * spectrum.columns + w];
        if (w == 0u) {
            d_weights[spectrum.head_biases + lane] += factor * d_biases[lane];
        }
    }
#ifdef MOTION
    let size = spectrum.width;
    let channel = series[w];
    var head: array<f32, MOVED>;
    var sums: array<f32, MOVED>;
#unroll h 14
    head[$h] = head_factor(spectrum, $(h)u) * weights[spectrum.heads + $(h)u * size + w];
    sums[$h] = 0.0;
#end
    for (var j = lane; j <= size; j += LANES) {   // the last one is the bias
        let at = select(spectrum.second_bias + w, spectrum.second + w * size + j, j < size);
        let value = weights[at];
        var along = 0.0;
#unroll h 14
        {
            var d = d_biases[$(h)u];
            if (j < size) {
                d = d_heads[$(h)u * spectrum.columns + size + j];
            }
            sums[$h] += d * value;
            along += head[$h] * d;
        }
#end
        d_weights[at] += channel * along;
    }
#unroll h 14
    of_lane[$(h)u * LANES + lane] = sums[$h];
#end
    workgroupBarrier();
    if (lane < MOVED) {
        var sum = 0.0;
        for (var i = 0u; i < LANES; i++) {
            sum += of_lane[lane * LANES + i];
        }
        d_weights[spectrum.heads + lane * size + w] += head_factor(spectrum, lane) * channel * sum;
        of_lane[lane * LANES] = sum;
    }
    workgroupBarrier();
    if (lane == 0u) {
        var sum = 0.0;
#unroll h 14
        sum += head[$h] * of_lane[$(h)u * LANES];
#end
        d_series[w] = sum;
    }
#endif
}
