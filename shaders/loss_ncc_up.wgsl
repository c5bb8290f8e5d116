// Local cross-correlation, carried back: the gradient by the luminance of each pixel, summed over the windows that hold
// it. A lane takes a run of one column of pixels.
#import common/picture

@group(0) @binding(0) var<uniform> picture: Picture;
#table 1 pixels: vec4<u32>
#table 2 moments: vec4<f32>
#table 3 slopes: vec4<f32>
@group(0) @binding(4) var<storage, read_write> d_luminance: array<f32>;

@compute @workgroup_size($LANES)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if (id.x >= picture.size.x) {
        return;
    }
    let run = run_of(id.y, picture.size.y, picture);
    let last = i32(picture.size.y) - 1;
    let top = place(id.x, 0u, picture);
    var column: array<vec2<f32>, 11>;   // luminances from the window's first row on
    var back: array<f32, 12>;           // and their gradients; the last stays zero
    for (var begin = run.x - 10; begin < run.y; begin++) {
        let pixel = pixels_at(top + 8u * u32(min(begin + 10, last)));
#unroll k 10
        column[$k] = column[$k + 1];
#end
        column[10] = vec2(dot(LUMINANCE, seen(pixel)), dot(LUMINANCE, truth(pixel)));
        let i = top + 8u * u32(clamp(begin, 0, last));
        let valid = begin >= 0 && begin + 10 <= last;
        let slope = select(vec3(0.0), slopes_at(i).xyz, valid);
        let mean = select(vec2(0.0), moments_at(i).xy, valid);
#unroll k 11
        back[$k] = back[$k + 1] + (dot(slope.xy, column[$k].yx - mean.yx) - slope.z);
#end
        if (begin >= run.x) {
            d_luminance[i] = back[0];
        }
    }
}
