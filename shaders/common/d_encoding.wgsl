// The gradient of an encoding: two features of point i / (all levels).
#import common/bfloat16

// (N, all levels)
#ifdef BFLOAT16
#table 3 d_encoding: u32

fn gradient_at(i: u32) -> vec2<f32> {
    return unpack_bfloat16(d_encoding_at(i));
}
#else
#table 3 d_encoding: vec2<f32>

fn gradient_at(i: u32) -> vec2<f32> {
    return d_encoding_at(i);
}
#endif
