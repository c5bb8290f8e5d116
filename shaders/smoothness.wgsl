// Sums of squared differences between the features of two places, a lane a pair.
#import common/smoothness

@group(0) @binding(1) var<storage, read> here: array<f32>;    // (pairs, features)
@group(0) @binding(2) var<storage, read> there: array<f32>;
@group(0) @binding(3) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= smoothness.pairs) {
        return;
    }
    var sum = 0.0;
    for (var k = 0u; k < smoothness.features; k++) {
        let apart = there[id.x * smoothness.features + k] - here[id.x * smoothness.features + k];
        sum += apart * apart;
    }
    sums[id.x] = sum;
}
