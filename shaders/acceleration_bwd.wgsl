// The gradient of `acceleration`: added to those of the Gaussians; the heads' outputs become theirs.
#import common/acceleration

@group(0) @binding(7) var<storage, read_write> before: array<f32>;    // (samples, outputs)
@group(0) @binding(8) var<storage, read_write> after: array<f32>;
@group(0) @binding(9) var<storage, read_write> d_means: array<f32>;
@group(0) @binding(10) var<storage, read_write> d_scales: array<f32>;
@group(0) @binding(11) var<storage, read_write> d_geometry: array<vec4<f32>>;
#import common/acceleration_sampled

// What the gradients by a sampled mean and scales leave: those of the turn and of the changes of scale, and of the geometry.
struct Carried {
    d_turn: vec4<f32>,
    d_change: vec3<f32>,
    d_mean: vec3<f32>,
}

fn carried(at: Sampled, row: u32, d_mean: vec3<f32>, d_scale: vec3<f32>) -> Carried {
    let rotation = unit(at.turned);
    let d_turn = unit_bwd(at.turned, rotated_bwd(rotation, geometry[ROW * row].xyz, d_mean));
    let d_change = d_scale * moved_scales_slope(at.changed, acceleration.mirror);
    return Carried(d_turn, d_change, rotated(conjugate(rotation), d_mean));
}

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
    let row = row_of(samples, i);
    let first = sampled_before(i, row);
    let last = sampled_after(i, row);
    let d_mean = acceleration.scale * robust_length_bwd(mean_apart(first, last, row));
    let d_scale = acceleration.scale * robust_length_bwd(scale_apart(first, last, row));
    let early = acceleration.share - 1.0;
    let late = -acceleration.share;
    let of_first = carried(first, row, early * d_mean, early * d_scale);
    let of_last = carried(last, row, late * d_mean, late * d_scale);
    let size = exp(geometry[ROW * row + 2u].xyz);
    let of_logs = select(vec3(0.0), size * (of_first.d_change + of_last.d_change), size >= vec3(MIN_SCALE));
    d_geometry[ROW * row] += vec4(of_first.d_mean + of_last.d_mean, 0.0);
    d_geometry[ROW * row + 2u] += vec4(of_logs, 0.0);
    let at = i * acceleration.outputs;
    for (var k = QUATERNION; k < acceleration.outputs; k++) {
        before[at + k] = 0.0;
        after[at + k] = 0.0;
    }
#unroll a 4
    before[at + $(a)u] = of_first.d_turn[$a];
    after[at + $(a)u] = of_last.d_turn[$a];
#end
#unroll a 3
    d_means[3u * row + $(a)u] += d_mean[$a];
    d_scales[3u * row + $(a)u] += d_scale[$a];
    before[at + SHIFT + $(a)u] = early * d_mean[$a];
    after[at + SHIFT + $(a)u] = late * d_mean[$a];
    before[at + SCALES + $(a)u] = of_first.d_change[$a];
    after[at + SCALES + $(a)u] = of_last.d_change[$a];
#end
}
