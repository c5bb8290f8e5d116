// Sets the lowest bit where a value is not finite, or so large that its square is not.
#import common/finite
#import common/index

struct Check {
    count: u32,
}

const LANES = 64u;
const LANE_VALUES = 16u;
const LARGEST = 1e19;

@group(0) @binding(0) var<uniform> check: Check;
@group(0) @binding(1) var<storage, read> values: array<f32>;
@group(0) @binding(2) var<storage, read_write> bad: atomic<u32>;

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let first = workgroup_number(group, groups) * LANES * LANE_VALUES + lane;
    var found = false;
    for (var k = 0u; k < LANE_VALUES; k++) {
        let i = first + k * LANES;
        if (i < check.count) {
            let value = values[i];
            found = found || !finite(value) || abs(value) > LARGEST;
        }
    }
    if (found) {
        atomicOr(&bad, 1u);
    }
}
