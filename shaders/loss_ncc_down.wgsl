// Local cross-correlation of the luminances, down the columns: means and second moments of 11 pixels below each other,
// around their own means (E[x^2] - E[x]^2 would lose what a flat bright window has of variance).
#import common/picture

@group(0) @binding(0) var<uniform> picture: Picture;
#table 1 pixels: vec4<u32>
// of the 11 pixels from here downwards: mean of the image and of the ground truth, variance of the image, covariance
@group(0) @binding(2) var<storage, read_write> moments: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> truth_variances: array<f32>;

@compute @workgroup_size($LANES)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= picture.size.x) {
        return;
    }
    let run = run_of(id.y, picture.size.y - 10u, picture);
    let top = place(id.x, 0u, picture);
    var column: array<vec2<f32>, 11>;
    for (var row = run.x; row < run.y + 10; row++) {
        let pixel = pixels_at(top + 8u * u32(row));
#unroll k 10
        column[$k] = column[$k + 1];
#end
        column[10] = vec2(dot(LUMINANCE, seen(pixel)), dot(LUMINANCE, truth(pixel)));
        if (row - 10 >= run.x) {
            var mean = vec2(0.0);
#unroll k 11
            mean += column[$k] - column[5];   // so that of equal values the mean is exactly that value
#end
            mean = column[5] + mean / 11.0;
            var variances = vec2(0.0);
            var covariance = 0.0;
#unroll k 11
            {
                let d = column[$k] - mean;
                variances = fma(d, d, variances);
                covariance = fma(d.x, d.y, covariance);
            }
#end
            let at = top + 8u * u32(row - 10);
            moments[at] = vec4(mean, variances.x / 11.0, covariance / 11.0);
            truth_variances[at] = variances.y / 11.0;
        }
    }
}
