// Arranges a field's weights as the decoder's products take them; BACK: adds the gradients of those to the weights'.
#import common/index

struct Packing { count: u32 }

@group(0) @binding(0) var<uniform> packing: Packing;
@group(0) @binding(1) var<storage, read> sources: array<u32>;   // of each packed number its place among the weights, or NONE
@group(0) @binding(2) var<storage, read> factors: array<f32>;
#ifdef BACK
@group(0) @binding(3) var<storage, read_write> weights: array<f32>;
@group(0) @binding(4) var<storage, read> packed: array<f32>;
#else
@group(0) @binding(3) var<storage, read> weights: array<f32>;
@group(0) @binding(4) var<storage, read_write> packed: array<f32>;
#endif

const NONE = 0xffffffffu;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = workgroup_number(group, groups) * 64u + lane;
    if (i >= packing.count) {
        return;
    }
    let at = sources[i];
#ifdef BACK
    if (at != NONE) {
        weights[at] += factors[i] * packed[i];
    }
#else
    packed[i] = select(0.0, factors[i] * weights[min(at, arrayLength(&weights) - 1u)], at != NONE);
#endif
}
