// The loss's gradient by the image: all terms together, and the second half of the blur that carries SSIM back.
// A lane takes a run of one column in one channel. Planes red, green, blue, and zeros for alpha.
#import common/picture
#import common/ssim_window

@group(0) @binding(0) var<uniform> picture: Picture;
#table 1 pixels: vec4<u32>
#ifdef SSIM
#table 2 ssim: vec4<f32>
#endif
#ifdef NCC
// by the luminance
#table 3 ncc: f32
#endif
#ifdef PYRAMID
#table 4 pyramid: vec4<f32>
#endif
@group(0) @binding(5) var<storage, read_write> d_image: array<f32>;

#ifdef SSIM
const REACH = 5;   // of a window, rows
#else
const REACH = 0;
#endif

@compute @workgroup_size($LANES)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    if (id.x >= picture.size.x) {
        return;
    }
    let runs = groups.y / 3u;
    let channel = id.y / runs;
    let run = run_of(id.y % runs, picture.size.y, picture);
    let width = picture.size.x;
    let height = i32(picture.size.y);
    let count = width * picture.size.y;
    let top = place(id.x, 0u, picture);
#ifdef SSIM
    var similar: array<vec3<f32>, 12>;      // the last stays zero
#endif
#ifdef NCC
    let luminance = select(select(LUMINANCE.z, LUMINANCE.y, channel == 1u), LUMINANCE.x, channel == 0u);
#endif
    for (var ahead = run.x - REACH; ahead < run.y + REACH; ahead++) {
        let row = ahead - REACH;
#ifdef SSIM
        let blurred = ssim_at(channel * places(picture) + top + 8u * u32(clamp(ahead, 0, height - 1))).xyz;
        let inside = select(vec3(0.0), blurred, ahead >= 0 && ahead < height);
#unroll k 11
        similar[$k] = fma(vec3(WINDOW[$k]), inside, similar[$k + 1]);
#end
#endif
        if (row >= run.x) {
            let i = top + 8u * u32(row);
            let pixel = pixels_at(i);
            let both = channel_of(pixel, channel);
            var d = picture.slope.x * sign(both.x - both.y);
#ifdef SSIM
            d += similar[0].x + 2.0 * both.x * similar[0].y + both.y * similar[0].z;
#endif
#ifdef NCC
            d += luminance * ncc_at(i);
#endif
#ifdef PYRAMID
            let band = pyramid_at(i);
            d += select(select(band.z, band.y, channel == 1u), band.x, channel == 0u);
#endif
            let at = u32(row) * width + id.x;
            d_image[channel * count + at] = select(d, 0.0, (pixel.w & IGNORED) != 0u);
            if (channel == 0u) {
                d_image[3u * count + at] = 0.0;
            }
        }
    }
}
