// The harmonics that are drawn: those of the degree in use; COLOR: the first of them changed by the heads' outputs.
// BACK: their gradients; the heads' outputs become theirs.
#import common/index

struct Harmonics {
    gaussians: u32,
    floats: u32,     // of a Gaussian that are drawn, of STORED
    outputs: u32,    // of the heads
}

const STORED = 48u;
const LOOK = 14u;

@group(0) @binding(0) var<uniform> harmonics: Harmonics;
#ifdef BACK
@group(0) @binding(2) var<storage, read_write> sh: array<f32>;       // (N, STORED): the gradient
@group(0) @binding(3) var<storage, read> colors: array<f32>;         // (N, floats): the gradient
#ifdef COLOR
@group(0) @binding(4) var<storage, read_write> outputs: array<f32>;
#endif
#else
@group(0) @binding(2) var<storage, read> sh: array<f32>;
@group(0) @binding(3) var<storage, read_write> colors: array<f32>;
#ifdef COLOR
@group(0) @binding(1) var<uniform> biases: array<vec4<f32>, 5>;      // of the heads
@group(0) @binding(4) var<storage, read> outputs: array<f32>;        // (N, outputs), without their biases
#endif
#endif

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let number = workgroup_number(group, groups) * 64u + lane;
    let i = number / STORED;
    let k = number % STORED;
    if (i >= harmonics.gaussians) {
        return;
    }
    let output = i * harmonics.outputs + LOOK + k;
#ifdef BACK
    var d = 0.0;
    if (k < harmonics.floats) {
        d = colors[i * harmonics.floats + k];
    }
    sh[number] = d;
#ifdef COLOR
    if (k < 3u) {
        outputs[output] = d;
    }
#endif
#else
    if (k >= harmonics.floats) {
        return;
    }
    var value = sh[number];
#ifdef COLOR
    if (k < 3u) {
        value += outputs[output] + biases[(LOOK + k) / 4u][(LOOK + k) % 4u];
    }
#endif
    colors[i * harmonics.floats + k] = value;
#endif
}
