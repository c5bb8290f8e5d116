// Structural similarity, second half: along the rows, then at each pixel the similarity and its derivatives, and of these
// the first half of the blur that carries them back. A lane takes a run of one row in one channel.
#import common/picture
#import common/ssim_window

@group(0) @binding(0) var<uniform> picture: Picture;
#table 1 moments: vec4<f32>
// of each channel: d loss / d mean, / d sum of squares, / d product, blurred along the rows; -
@group(0) @binding(2) var<storage, read_write> slopes: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size($LANES)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    if (id.x >= picture.size.y) {
        return;
    }
    let runs = groups.y / 3u;
    let channel = id.y / runs;
    let run = run_of(id.y % runs, picture.size.x, picture);
    let width = i32(picture.size.x);
    let start = channel * places_across(picture) + place_across(0u, id.x, picture);
    let first = channel * places(picture);
    var row: array<vec2<f32>, 11>;        // means of pixel columns
    var within: array<vec2<f32>, 12>;     // windows under way; the last stays zero, here and below
    var back: array<vec3<f32>, 12>;
    var sum = 0.0;
    for (var column = run.x - 10; column < run.y + 10; column++) {
        let inside = column >= 0 && column < width;
        let here = select(vec4(0.0), moments_at(start + 8u * u32(clamp(column, 0, width - 1))), inside);
#unroll k 10
        row[$k] = row[$k + 1];
#end
        row[10] = here.xy;
#unroll k 11
        within[$k] = fma(vec2(WINDOW[$k]), here.zw, within[$k + 1]);
#end
        var mean = vec2(0.0);
#unroll k 11
        mean = fma(vec2(WINDOW[$k]), row[$k], mean);
#end
        // The variance of all is the mean of the columns' variances and the variance of their means.
        var variances = within[0].x;
        var covariance = within[0].y;
#unroll k 11
        {
            let d = row[$k] - mean;
            let weighted = WINDOW[$k] * d;
            variances = fma(weighted.x, d.x, fma(weighted.y, d.y, variances));
            covariance = fma(weighted.x, d.y, covariance);
        }
#end
        let center = column - 5;
        let a = mean.x;
        let b = mean.y;
        let light = 2.0 * a * b + SSIM_C1;
        let light_norm = 1.0 / (a * a + b * b + SSIM_C1);
        let structure = 2.0 * covariance + SSIM_C2;
        let structure_norm = 1.0 / (variances + SSIM_C2);
        let norm = light_norm * structure_norm;
        let similarity = light * structure * norm;
        sum += select(0.0, 1.0 - similarity, center >= run.x && center < run.y);
        let d_mean = 2.0 * (b * (structure - light) * norm + a * similarity * (structure_norm - light_norm));
        let d = -picture.slope.y * vec3(d_mean, -similarity * structure_norm, 2.0 * light * norm);
        let d_center = select(vec3(0.0), d, center >= max(run.x - 5, 0) && center < width);
#unroll k 11
        back[$k] = fma(vec3(WINDOW[$k]), d_center, back[$k + 1]);
#end
        if (column - 10 >= run.x) {
            slopes[first + place(u32(column - 10), id.x, picture)] = vec4(back[0], 0.0);
        }
    }
    sums[picture.ssim_first + id.y * picture.size.y + id.x] = picture.value.y * sum;
}
