// What the passes of the image losses share: an image that was drawn, its ground truth, and how lanes walk over them.
struct Picture {
    size: vec2<u32>,         // width, height
    run: u32,                // pixels that a lane takes one after another, down a column or along a row
    ssim_first: u32,         // where the partial sums of these terms begin
    ncc_first: u32,
    value: vec4<f32>,        // a pixel's share in each term: L1 and squared error, SSIM, a window's in NCC, -
    slope: vec4<f32>,        // the same, times the term's weight in the loss
}

// Where a pixel lies in the buffers of these passes. What is read by lanes that walk down lies in strips of 8 columns, so
// that the next row is nearby (in an image row by row, each step down would be a new page of memory) ...
fn place(x: u32, y: u32, picture: Picture) -> u32 {
    return ((x >> 3u) * picture.size.y + y) * 8u + (x & 7u);
}

// ... and what is read by lanes that walk along the rows, in strips of 8 rows.
fn place_across(x: u32, y: u32, picture: Picture) -> u32 {
    return ((y >> 3u) * picture.size.x + x) * 8u + (y & 7u);
}

// The pixels of a channel, with those that fill up the last strip, in either.
fn places(picture: Picture) -> u32 {
    return ((picture.size.x + 7u) & ~7u) * picture.size.y;
}

fn places_across(picture: Picture) -> u32 {
    return ((picture.size.y + 7u) & ~7u) * picture.size.x;
}

const IGNORED = 1u << 24u;   // in the ground truth of a pixel that the loss leaves out, whose image is the ground truth

// pixels: red, green, blue of the image, as bits; ground truth, 8 bits a channel, and perhaps IGNORED.
fn seen(pixel: vec4<u32>) -> vec3<f32> {
    return bitcast<vec3<f32>>(pixel.xyz);
}

// Bytes / 255, rounded correctly: WGSL lets drivers divide with an error of 2.5 ulp, which L1 and the pyramid, that look at
// signs, would take for a difference between equal images. 2^16 / 255 is 257 + 1 / 255, and the first product is exact; it is
// taken in integers, so that no driver puts the two together again.
fn share(byte: vec3<u32>) -> vec3<f32> {
    return (vec3<f32>(257u * byte) + vec3<f32>(byte) * (1.0 / 255.0)) * (1.0 / 65536.0);
}

fn truth(pixel: vec4<u32>) -> vec3<f32> {
    return share((vec3(pixel.w) >> vec3(0u, 8u, 16u)) & vec3(255u));
}

// Both in one channel.
fn channel_of(pixel: vec4<u32>, channel: u32) -> vec2<f32> {
    let bits = select(select(pixel.z, pixel.y, channel == 1u), pixel.x, channel == 0u);
    return vec2(bitcast<f32>(bits), share(vec3((pixel.w >> (8u * channel)) & 255u)).x);
}

const LUMINANCE = vec3<f32>(0.299, 0.587, 0.114);   // Rec. 601

// The first and one past the last pixel of a lane's run.
fn run_of(number: u32, length: u32, picture: Picture) -> vec2<i32> {
    return vec2<i32>(vec2(number * picture.run, min((number + 1u) * picture.run, length)));
}
