// L(t), a channel a lane.
#import common/spectrum

@group(0) @binding(0) var<uniform> spectrum: Spectrum;
@group(0) @binding(1) var<storage, read> weights: array<f32>;
@group(0) @binding(2) var<storage, read_write> series: array<f32>;   // (width,)

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= spectrum.width) {
        return;
    }
    var sum = 0.0;
    for (var k = 0u; k < spectrum.components; k++) {
        let wave = phase(weights[spectrum.frequencies + k], spectrum.time);
        let at = k * spectrum.width + id.x;
        sum += wave.x * weights[spectrum.alpha + at] + wave.y * weights[spectrum.beta + at];
    }
    series[id.x] = sum;
}
