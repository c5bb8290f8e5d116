// Adds the parts of a product whose inner dimension was split, in their order; with ADD, to what is there.
#import common/index

struct Sum {
    count: u32,     // elements of the product
    parts: u32,
    columns: u32,   // of the product
    stride: u32,    // from one of its rows to the next
    first: u32,     // elements before it
}

@group(0) @binding(0) var<uniform> sum: Sum;
@group(0) @binding(1) var<storage, read> parts: array<f32>;   // (parts, count)
@group(0) @binding(2) var<storage, read_write> total: array<f32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = workgroup_number(group, groups) * 64u + lane;
    if (i >= sum.count) {
        return;
    }
    let at = sum.first + i / sum.columns * sum.stride + i % sum.columns;
#ifdef ADD
    var value = total[at];
#else
    var value = 0.0;
#endif
    for (var part = 0u; part < sum.parts; part++) {
        value += parts[part * sum.count + i];
    }
    total[at] = value;
}
