// Puts the ground truth beside the image pixel by pixel, and sums up absolute and squared differences. A workgroup takes a
// row.
#import common/picture

@group(0) @binding(0) var<uniform> picture: Picture;
#table 1 image: f32
// RGBA, red in the lowest byte; alpha 0: the loss leaves the pixel out
#table 2 rgba: u32
@group(0) @binding(3) var<storage, read_write> pixels: array<vec4<u32>>;
@group(0) @binding(4) var<storage, read_write> sums: array<f32>;

@compute @workgroup_size($LANES)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let row = group.y;
    let count = picture.size.x * picture.size.y;
    var absolute = 0.0;
    var squared = 0.0;
    for (var column = lane; column < picture.size.x; column += u32($LANES)) {
        let i = row * picture.size.x + column;
        let bits = bitcast<vec3<u32>>(vec3(image_at(i), image_at(count + i), image_at(2u * count + i)));
        var pixel = vec4(bits, rgba_at(i) & 0xffffffu);
        if ((rgba_at(i) >> 24u) == 0u) {
            pixel = vec4(bitcast<vec3<u32>>(truth(pixel)), pixel.w | IGNORED);
        }
        pixels[place(column, row, picture)] = pixel;
        let difference = seen(pixel) - truth(pixel);
        absolute += dot(abs(difference), vec3(1.0));
        squared += dot(difference, difference);
    }
    let own = row * u32($LANES) + lane;
    sums[own] = picture.value.x * absolute;
    sums[groups.y * u32($LANES) + own] = picture.value.x * squared;
}
