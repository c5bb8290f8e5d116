// Moves the camera of a frame by its correction: a rotation about its centre along the world's axes, and a shift.
#import common/frame
#import common/geometry
#import common/rotation_vector

struct Moved {
    row: u32,     // of the camera among `cameras`
    unit: f32,    // of a shift, world units
}

const CAMERA = 16u;

@group(0) @binding(0) var<uniform> moved: Moved;
@group(0) @binding(1) var<uniform> placed: Frame;
@group(0) @binding(2) var<storage, read> cameras: array<f32>;   // (C + 1, CAMERA), see camera_step
@group(0) @binding(3) var<storage, read_write> frame: Frame;

@compute @workgroup_size(1)
fn main() {
    let at = CAMERA * moved.row;
    let turn = turn_of(vec3(cameras[at], cameras[at + 1u], cameras[at + 2u]));
    let shift = moved.unit * vec3(cameras[at + 3u], cameras[at + 4u], cameras[at + 5u]);
    let rows = transpose(mat3x3(placed.view[0].xyz, placed.view[1].xyz, placed.view[2].xyz));
    let R = transpose(mat3x3(rotated(turn, rows[0]), rotated(turn, rows[1]), rotated(turn, rows[2])));
    let position = placed.position + shift;
    frame = placed;
    frame.position = position;
    frame.view = mat4x4(vec4(R[0], 0.0), vec4(R[1], 0.0), vec4(R[2], 0.0), vec4(-(R * position), 1.0));
}
