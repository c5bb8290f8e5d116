// Structural similarity, first half of the blur, down the columns: means and second moments of the 11 pixels around each,
// the moments around the means, since E[x^2] - E[x]^2 would lose what a flat bright window has of variance.
// A lane takes a run of one column in one channel.
#import common/picture
#import common/ssim_window

@group(0) @binding(0) var<uniform> picture: Picture;
#table 1 pixels: vec4<u32>
// of each channel: mean of the image and of the ground truth, sum of their variances, covariance
@group(0) @binding(2) var<storage, read_write> moments: array<vec4<f32>>;

@compute @workgroup_size($LANES)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    if (id.x >= picture.size.x) {
        return;
    }
    let runs = groups.y / 3u;
    let channel = id.y / runs;
    let run = run_of(id.y % runs, picture.size.y, picture);
    let height = i32(picture.size.y);
    let top = place(id.x, 0u, picture);
    let first = channel * places_across(picture);
    var column: array<vec2<f32>, 11>;
    for (var row = run.x - 5; row < run.y + 5; row++) {
        let inside = row >= 0 && row < height;   // beyond the border lies zero
        let both = channel_of(pixels_at(top + 8u * u32(clamp(row, 0, height - 1))), channel);
#unroll k 10
        column[$k] = column[$k + 1];
#end
        column[10] = select(vec2(0.0), both, inside);
        if (row - 5 >= run.x) {
            var mean = vec2(0.0);
#unroll k 11
            mean = fma(vec2(WINDOW[$k]), column[$k], mean);
#end
            var variances = 0.0;
            var covariance = 0.0;
#unroll k 11
            {
                let d = column[$k] - mean;
                let weighted = WINDOW[$k] * d;
                variances = fma(weighted.x, d.x, fma(weighted.y, d.y, variances));
                covariance = fma(weighted.x, d.y, covariance);
            }
#end
            moments[first + place_across(id.x, u32(row - 5), picture)] = vec4(mean, variances, covariance);
        }
    }
}
