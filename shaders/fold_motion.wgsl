// The heads at a time, a number a lane, times their factors. MOTION: the motion's second layer, whose channels the spectrum
// multiplies, is folded into them: into the columns that read the inner channels, and into the biases.
#import common/index
#import common/spectrum

@group(0) @binding(0) var<uniform> spectrum: Spectrum;
@group(0) @binding(1) var<storage, read> weights: array<f32>;
#ifdef MOTION
@group(0) @binding(2) var<storage, read> series: array<f32>;
#endif
@group(0) @binding(3) var<storage, read_write> heads: array<f32>;    // (outputs, columns)
@group(0) @binding(4) var<storage, read_write> biases: array<f32>;   // (outputs,)

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let number = workgroup_number(group, groups) * 64u + lane;
    let head = number / (spectrum.columns + 1u);
    let column = number % (spectrum.columns + 1u);   // the last one is the bias
    if (head >= spectrum.outputs) {
        return;
    }
    let own = spectrum.heads + head * spectrum.width;
    var value = 0.0;
    if (column < spectrum.width) {
        value = weights[own + column];
    } else if (column == spectrum.columns) {
        value = weights[spectrum.head_biases + head];
    }
#ifdef MOTION
    if (column >= spectrum.width && head < MOVED) {
        let inner = column - spectrum.width;
        for (var w = 0u; w < spectrum.width; w++) {
            let of_layer = select(spectrum.second_bias + w, spectrum.second + w * spectrum.width + inner, inner < spectrum.width);
            value += weights[own + w] * series[w] * weights[of_layer];
        }
    }
#endif
    value *= head_factor(spectrum, head);
    if (column < spectrum.columns) {
        heads[head * spectrum.columns + column] = value;
    } else {
        biases[head] = value;
    }
}
