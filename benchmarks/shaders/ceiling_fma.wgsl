// Multiplies and adds: chains that do not wait for each other. The factors come from outside, so that nothing can be
// computed beforehand, and all chains end in what is written, so that nothing can be left out.
struct Factors { multiply: f32, add: f32, turns: u32 }

@group(0) @binding(0) var<uniform> factors: Factors;
@group(0) @binding(1) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
#unroll c $CHAINS
    var x$c = f32(id.x) + $c.0;
#end
    for (var turn = 0u; turn < factors.turns; turn++) {
#unroll k $STEPS
#unroll c $CHAINS
        x$c = fma(x$c, factors.multiply, factors.add);
#end
#end
    }
    var sum = 0.0;
#unroll c $CHAINS
    sum += x$c;
#end
    sums[id.x] = sum;
}
