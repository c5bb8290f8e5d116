// Places at which the hash grids are looked up: the means of all Gaussians; SAMPLED: of some of them; OFFSET: moved a little.
#import common/geometry
#import common/index
#import common/samples

@group(0) @binding(0) var<uniform> samples: Samples;
@group(0) @binding(1) var<storage, read> geometry: array<vec4<f32>>;
@group(0) @binding(2) var<storage, read_write> points: array<vec4<f32>>;   // x, y, z, 0

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let i = workgroup_number(group, groups) * 64u + lane;
    if (i >= samples.count) {
        return;
    }
#ifdef SAMPLED
    let row = row_of(samples, i);
#else
    let row = i;
#endif
    var place = geometry[ROW * row].xyz;
#ifdef OFFSET
    place += offset_of(samples, i);
#endif
    points[i] = vec4(place, 0.0);
}
