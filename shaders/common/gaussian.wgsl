// The geometry of one Gaussian under one camera. `project` and `project_bwd` share it.
#import common/constants
#import common/frame

fn rotation(q: vec4<f32>) -> mat3x3<f32> {   // q = (w, x, y, z), of unit length
    let w = q.x; let x = q.y; let y = q.z; let z = q.w;
    return mat3x3<f32>(   // columns
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
        2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
        2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

fn view_rotation(frame: Frame) -> mat3x3<f32> {
    return mat3x3<f32>(frame.view[0].xyz, frame.view[1].xyz, frame.view[2].xyz);
}

// x/z and y/z are held within the image and a margin before they enter the Jacobian (gsplat's rule), because the linear
// approximation of the projection has no meaning far outside.
struct JacobianLimits { low: vec2<f32>, high: vec2<f32> }

fn jacobian_limits(frame: Frame) -> JacobianLimits {
    let size = vec2<f32>(frame.size);
    let margin = FRUSTUM_MARGIN * 0.5 * size / frame.focal;
    return JacobianLimits(-frame.center / frame.focal - margin, (size - frame.center) / frame.focal + margin);
}

// A Gaussian's footprint on the image: the rows of J R S, whose products are its covariance; pixels.
struct Footprint {
    axes_x: vec3<f32>,
    axes_y: vec3<f32>,
    xx: f32,     // the covariance behind the low-pass filter
    xy: f32,
    yy: f32,
    flat: f32,   // the determinant before the filter
    det: f32,
}

// R: from the Gaussian's axes to the camera's. jacobian: focal lengths / depth. xy: x/z and y/z, within the limits.
// low_pass: px^2.
fn footprint(R: mat3x3<f32>, scale: vec3<f32>, jacobian: vec2<f32>, xy: vec2<f32>, low_pass: f32) -> Footprint {
    let u = jacobian.x * scale * vec3(R[0].x - xy.x * R[0].z, R[1].x - xy.x * R[1].z, R[2].x - xy.x * R[2].z);
    let v = jacobian.y * scale * vec3(R[0].y - xy.y * R[0].z, R[1].y - xy.y * R[1].z, R[2].y - xy.y * R[2].z);
    let xx = dot(u, u) + low_pass;
    let yy = dot(v, v) + low_pass;
    // The determinant without cancellation: |u x v|^2 is never negative.
    let normal = cross(u, v);
    let flat = dot(normal, normal);
    return Footprint(u, v, xx, dot(u, v), yy, flat, flat + low_pass * (xx + yy - low_pass));
}
