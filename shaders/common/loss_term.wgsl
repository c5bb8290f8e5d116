// What a loss term of one's own gets, and how it leaves its result (docs/api.md). The entry point has
// @workgroup_size(8, 8), an invocation a pixel; those beyond term.size return at once.
#import common/on_background

struct Term {
    size: vec2<u32>,         // of the image, pixels
    share: f32,              // weight of the term / number of pixels
    padding: f32,
    background: vec3<f32>,   // under both images
}

@group(0) @binding(0) var<uniform> term: Term;
// planes red, green, blue, transmittance
#table 1 image: f32
// straight RGBA, red in the lowest byte
#table 2 rgba: u32
@group(0) @binding(3) var<storage, read_write> d_image: array<f32>;
@group(0) @binding(4) var<storage, read_write> values: array<f32>;

// The color of the rendered image at a pixel.
fn rendered(pixel: vec2<u32>) -> vec3<f32> {
    let count = term.size.x * term.size.y;
    let i = pixel.y * term.size.x + pixel.x;
    return vec3(image_at(i), image_at(count + i), image_at(2u * count + i));
}

// The color of the ground truth at a pixel, in [0, 1]; of a pixel that the loss leaves out, that of the rendered image.
fn truth(pixel: vec2<u32>) -> vec3<f32> {
    let texel = rgba_at(pixel.y * term.size.x + pixel.x);
    if (is_ignored(texel)) {
        return rendered(pixel);
    }
    return vec3<f32>(composite(texel, term.background)) / 255.0;
}

// The pixel's value, whose mean over the image is the loss; and the derivatives, by the pixel's rendered color, of the sum
// of the values of all pixels.
fn leave(pixel: vec2<u32>, value: f32, derivatives: vec3<f32>) {
    let count = term.size.x * term.size.y;
    let i = pixel.y * term.size.x + pixel.x;
    values[i] = value;
    if (is_ignored(rgba_at(i))) {
        return;
    }
    d_image[i] += term.share * derivatives.x;
    d_image[count + i] += term.share * derivatives.y;
    d_image[2u * count + i] += term.share * derivatives.z;
}
