// A step of the motion spectrum's frequencies along eq. 5's gradient, unless the guard is closed: Adam with one second moment
// for all. The frequencies are among a field's weights; a component a lane.
struct Frequencies {
    width: u32,
    components: u32,
    alpha: u32,
    beta: u32,
    frequencies: u32,
    rate: f32,           // / (1 - 0.9^steps)
    square_factor: f32,  // 1 / sqrt(1 - 0.999^steps)
    limit: f32,          // the Nyquist frequency, cycles over the clip
    largest: f32,        // step, cycles over the clip
    floor: f32,          // of a variance
    spread: f32,         // of variances around their geometric mean
}

const MOST = 256u;
const TURN = 6.283185307179586;
const EPSILON = 1e-15;

@group(0) @binding(0) var<uniform> spectrum: Frequencies;
@group(0) @binding(1) var<storage, read> guard: u32;
@group(0) @binding(2) var<storage, read_write> d_weights: array<f32>;
@group(0) @binding(3) var<storage, read_write> weights: array<f32>;
@group(0) @binding(4) var<storage, read_write> state: array<f32>;   // (components + 1,): means; the second moment

var<workgroup> of_component: array<f32, MOST>;

fn total(lane: u32, value: f32) -> f32 {
    workgroupBarrier();
    of_component[lane] = value;
    workgroupBarrier();
    var sum = 0.0;
    for (var k = 0u; k < spectrum.components; k++) {
        sum += of_component[k];
    }
    return sum;
}

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) lane: u32) {
    let k = min(lane, spectrum.components - 1u);
    var power = 0.0;
    for (var w = 0u; w < spectrum.width; w++) {
        let at = k * spectrum.width + w;
        let alpha = weights[spectrum.alpha + at];
        let beta = weights[spectrum.beta + at];
        power += alpha * alpha + beta * beta;
    }
    let variance = 0.5 * power / f32(spectrum.width) + spectrum.floor;
    let middle = exp(total(lane, log(variance)) / f32(spectrum.components));
    let held = clamp(variance, middle / spectrum.spread, middle * spectrum.spread);
    let gradient = d_weights[spectrum.frequencies + k] / (TURN * held);
    let mean_square = total(lane, gradient * gradient) / f32(spectrum.components);
    let square = 0.999 * state[spectrum.components] + 0.001 * mean_square;
    let mean = 0.9 * state[k] + 0.1 * gradient;
    workgroupBarrier();
    if (lane < spectrum.components) {
        d_weights[spectrum.frequencies + k] = 0.0;
    }
    if (guard != 0u || lane >= spectrum.components) {
        return;
    }
    let change = clamp(
        spectrum.rate * mean / (sqrt(square) * spectrum.square_factor + EPSILON), -spectrum.largest, spectrum.largest);
    let at = spectrum.frequencies + k;
    weights[at] = clamp(weights[at] - change, 0.0, spectrum.limit);
    state[k] = mean;
    if (lane == 0u) {
        state[spectrum.components] = square;
    }
}
