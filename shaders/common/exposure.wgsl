// The affine color correction of a picture, which is applied to the rendered image before the losses.
struct Exposure {
    size: vec2<u32>,    // width, height
    first: u32,         // of the correction's three rows among `corrections`: a row of the matrix each, its offset last
}
