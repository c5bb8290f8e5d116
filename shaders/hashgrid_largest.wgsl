// The largest absolute value of the gradient of an encoding: the bits of a float that is not negative grow as it does.
#import common/hashgrid
#import common/index

@group(0) @binding(0) var<uniform> grid: Grid;
@group(0) @binding(1) var<storage, read_write> largest: atomic<u32>;   // zero before
// (N, all levels): the gradient of two features of a point
#table 3 d_encoding: vec2<f32>

const LANES = 64u;
const LANE_PAIRS = 32u;

var<workgroup> of_lane: array<u32, 64>;   // not one atomic word, which not every driver has set to zero

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let first = workgroup_number(group, groups) * LANES * LANE_PAIRS + lane;
    var most = vec2(0u);
    for (var k = 0u; k < LANE_PAIRS; k++) {
        let i = first + k * LANES;
        if (i < grid.points * grid.all_levels) {
            most = max(most, bitcast<vec2<u32>>(abs(d_encoding_at(i))));
        }
    }
    of_lane[lane] = max(most.x, most.y);
    workgroupBarrier();
    if (lane == 0u) {
        var of_group = 0u;
        for (var k = 0u; k < LANES; k++) {
            of_group = max(of_group, of_lane[k]);
        }
        atomicMax(&largest, of_group);
    }
}
