// The rasterizer's own power of two, in chains as in ceiling_fma: x = -2^x.
struct Factors { multiply: f32, add: f32, turns: u32 }

@group(0) @binding(0) var<uniform> factors: Factors;
@group(0) @binding(1) var<storage, read_write> sums: array<f32>;
#import common/raster

fn splats_at(i: u32) -> vec4<f32> { return vec4(0.0); }   // which common/raster expects, and nothing calls here

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
#unroll c $CHAINS
    var x$c = -f32(id.x % 64u) - $c.0;
#end
    for (var turn = 0u; turn < factors.turns; turn++) {
#unroll k $STEPS
#unroll c $CHAINS
        x$c = -power_of_two(x$c);
#end
#end
    }
    var sum = factors.add;
#unroll c $CHAINS
    sum += x$c;
#end
    sums[id.x] = sum;
}
