// Folds the motion's second layer, whose channels the spectrum multiplies, into the heads, a number a lane: the columns of
// the packed heads that read the inner channels, and what the layer's bias adds to the heads' biases.
#import common/index
#import common/spectrum

@group(0) @binding(0) var<uniform> spectrum: Spectrum;
@group(0) @binding(1) var<storage, read> weights: array<f32>;
@group(0) @binding(2) var<storage, read> series: array<f32>;
@group(0) @binding(3) var<storage, read_write> heads: array<f32>;    // (outputs, columns)
@group(0) @binding(4) var<storage, read_write> biases: array<f32>;   // (outputs,), added to

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let number = workgroup_number(group, groups) * 64u + lane;
    if (number >= MOVED * (spectrum.width + 1u)) {
        return;
    }
    let head = number / (spectrum.width + 1u);
    let column = number % (spectrum.width + 1u);   // the last one is the bias
    var sum = 0.0;
    for (var w = 0u; w < spectrum.width; w++) {
        let of_layer = select(spectrum.second_bias + w, spectrum.second + w * spectrum.width + column, column < spectrum.width);
        sum += weights[spectrum.heads + head * spectrum.width + w] * series[w] * weights[of_layer];
    }
    sum *= head_factor(spectrum, head);
    if (column < spectrum.width) {
        heads[head * spectrum.columns + spectrum.width + column] = sum;
    } else {
        biases[head] += sum;
    }
}
