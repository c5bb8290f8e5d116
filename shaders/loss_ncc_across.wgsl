// Local cross-correlation, along the rows: each window's value and derivatives, and the sums of these over the windows
// that hold a pixel column. A lane takes a run of one row of windows.
#import common/constants
#import common/picture

@group(0) @binding(0) var<uniform> picture: Picture;
#table 1 moments: vec4<f32>
#table 2 truth_variances: f32
// Sums over the windows: a = d loss / d covariance, b = 2 d loss / d variance, each by a pixel, and a mean(truth) +
// b mean(image), where the means are told from those of the pixel column, so that flat regions leave exactly 0; -
@group(0) @binding(3) var<storage, read_write> slopes: array<vec4<f32>>;
@group(0) @binding(4) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size($LANES)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= picture.size.y - 10u) {
        return;
    }
    let run = run_of(id.y, picture.size.x, picture);
    let width = i32(picture.size.x);
    var row: array<vec2<f32>, 11>;          // means of pixel columns
    var moments_within: array<vec3<f32>, 12>;   // windows under way; the last stays zero, here and below
    var back: array<vec3<f32>, 12>;
    var sum = 0.0;
    for (var column = run.x - 10; column < run.y + 10; column++) {
        let i = place(u32(clamp(column, 0, width - 1)), id.x, picture);
        let here = moments_at(i);
#unroll k 10
        row[$k] = row[$k + 1];
#end
        row[10] = here.xy;
        let within = vec3(here.z, truth_variances_at(i), here.w);
#unroll k 11
        moments_within[$k] = moments_within[$k + 1] + within;
#end
        var mean = vec2(0.0);
#unroll k 11
        mean += row[$k] - row[5];   // so that of equal values the mean is exactly that value
#end
        mean = row[5] + mean / 11.0;
        // The variance of all is the mean of the columns' variances and the variance of their means.
        var moments_of_all = moments_within[0];
#unroll k 11
        {
            let d = row[$k] - mean;
            moments_of_all = fma(d.xyx, d.xyy, moments_of_all);
        }
#end
        moments_of_all /= 11.0;
        let deviation = sqrt(moments_of_all.x * moments_of_all.y + NCC_TINY);
        let norm = 1.0 / (deviation + NCC_E);
        let correlation = (moments_of_all.z + NCC_E) * norm;
        let begin = column - 10;   // of the window
        let valid = column >= run.x && begin >= 0 && column < width;
        sum += select(0.0, 1.0 - correlation, valid && begin >= run.x && begin < run.y);
        let a = -picture.slope.z * norm;
        let b = picture.slope.z * correlation * norm * moments_of_all.y / deviation;
        let d = select(vec2(0.0), vec2(a, b), valid);
#unroll k 11
        back[$k] = back[$k + 1] + vec3(d, dot(d, mean.yx - row[$k].yx));
#end
        if (begin >= run.x) {
            slopes[place(u32(begin), id.x, picture)] = vec4(back[0], 0.0);
        }
    }
    sums[picture.ncc_first + id.y * (picture.size.y - 10u) + id.x] = picture.value.z * sum;
}
