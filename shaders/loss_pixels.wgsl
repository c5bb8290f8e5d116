// Lays the ground truth on its background, puts it beside the image pixel by pixel, and sums up absolute and squared
// differences: a lane takes a run of a column.
#import common/picture

@group(0) @binding(0) var<uniform> picture: Picture;
#table 1 image: f32
// straight RGBA, red in the lowest byte
#table 2 rgba: u32
@group(0) @binding(3) var<storage, read_write> pixels: array<vec4<u32>>;
@group(0) @binding(4) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size($LANES)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    if (id.x >= picture.size.x) {
        return;
    }
    let run = run_of(id.y, picture.size.y, picture);
    let count = picture.size.x * picture.size.y;
    var absolute = 0.0;
    var squared = 0.0;
    for (var row = run.x; row < run.y; row++) {
        let i = u32(row) * picture.size.x + id.x;
        let texel = vec4<f32>((vec4(rgba_at(i)) >> vec4(0u, 8u, 16u, 24u)) & vec4(255u));
        let mixed = texel.xyz * texel.w + (255.0 - texel.w) * (255.0 * picture.background);
        let laid = vec3<u32>(floor(mixed / 255.0 + 0.5));
        let bits = bitcast<vec3<u32>>(vec3(image_at(i), image_at(count + i), image_at(2u * count + i)));
        let pixel = vec4(bits, laid.x | (laid.y << 8u) | (laid.z << 16u));
        pixels[i] = pixel;
        let difference = seen(pixel) - truth(pixel);
        absolute += dot(abs(difference), vec3(1.0));
        squared += dot(difference, difference);
    }
    let lane = id.y * picture.size.x + id.x;
    sums[lane] = picture.value.x * absolute;
    sums[groups.y * picture.size.x + lane] = picture.value.x * squared;
}
