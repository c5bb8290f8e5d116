// What all passes of one image share.
struct Frame {
    view: mat4x4<f32>,      // world to camera
    focal: vec2<f32>,       // pixels
    center: vec2<f32>,      // principal point, pixels
    position: vec3<f32>,    // the camera's centre in the world
    gaussians: u32,         // N
    background: vec3<f32>,
    capacity: u32,          // intersections that the buffers hold
    size: vec2<u32>,        // image, pixels
    tiles: vec2<u32>,       // columns and rows of tiles
    band: vec2<u32>,        // first and one past the last row of tiles that this submission draws
    low_pass: f32,          // px^2, added to both variances of a splat: none falls between pixels
    antialiased: u32,       // 1: a splat is as much fainter as low_pass makes it larger
    near: f32,              // world units; a Gaussian at or before this camera depth, or NEAR, is culled
}
