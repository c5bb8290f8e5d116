// Copies the rows of the sampled Gaussians; BACK: adds the samples' rows to those of their Gaussians.
#import common/index
#import common/samples

struct Row { columns: u32 }

@group(0) @binding(0) var<uniform> samples: Samples;
@group(0) @binding(1) var<uniform> row: Row;
#ifdef BACK
@group(0) @binding(2) var<storage, read> chosen: array<f32>;          // (samples, columns)
@group(0) @binding(3) var<storage, read_write> all: array<f32>;       // (gaussians, columns)
#else
@group(0) @binding(2) var<storage, read_write> chosen: array<f32>;
@group(0) @binding(3) var<storage, read> all: array<f32>;
#endif

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let number = workgroup_number(group, groups) * 64u + lane;
    if (number >= samples.count * row.columns) {
        return;
    }
    let at = row_of(samples, number / row.columns) * row.columns + number % row.columns;
#ifdef BACK
    all[at] += chosen[number];
#else
    chosen[number] = all[at];
#endif
}
