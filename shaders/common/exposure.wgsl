// The affine color correction of a picture, which is applied to the rendered image before the losses.
struct Exposure {
    red: vec4<f32>,     // a row of the matrix each, its offset last
    green: vec4<f32>,
    blue: vec4<f32>,
    size: vec2<u32>,    // width, height
}
