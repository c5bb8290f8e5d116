// The geometry of a Gaussian as it is trained: rows of three vec4,
//   0: mean, opacity logit    1: quaternion wxyz, of any length    2: logarithms of the scales, 0
// and how a field moves it.
#import common/constants

const ROW = 3u;
const IDENTITY = vec4(1.0, 0.0, 0.0, 0.0);
// Columns of the heads' outputs.
const SHIFT = 4u;
const QUATERNION = 7u;
const SCALES = 11u;
const LOOK = 14u;

fn unit(v: vec4<f32>) -> vec4<f32> {
    return v / max(length(v), 1e-12);
}

// The gradient by v, from that by unit(v).
fn unit_bwd(v: vec4<f32>, d: vec4<f32>) -> vec4<f32> {
    let size = max(length(v), 1e-12);
    let u = v / size;
    return (d - dot(u, d) * u) / size;
}

fn rotated(q: vec4<f32>, v: vec3<f32>) -> vec3<f32> {
    let twice = 2.0 * cross(q.yzw, v);
    return v + q.x * twice + cross(q.yzw, twice);
}

// The gradient by q, from that by rotated(q, v).
fn rotated_bwd(q: vec4<f32>, v: vec3<f32>, d: vec3<f32>) -> vec4<f32> {
    let u = q.yzw;
    let real = 2.0 * dot(cross(u, v), d);
    let imaginary = 2.0 * (q.x * cross(v, d) + dot(u, v) * d + dot(d, u) * v - 2.0 * dot(d, v) * u);
    return vec4(real, imaginary);
}

fn conjugate(q: vec4<f32>) -> vec4<f32> {
    return vec4(q.x, -q.yzw);
}

fn resting_scales(logs: vec3<f32>) -> vec3<f32> {
    return max(exp(logs), vec3(MIN_SCALE));
}

// mirror: 1 where negative scales count as their magnitude, else 0.
fn moved_scales(changed: vec3<f32>, mirror: f32) -> vec3<f32> {
    return max(max(changed, -mirror * changed), vec3(MIN_SCALE));
}

// The derivative of `moved_scales` by `changed`.
fn moved_scales_slope(changed: vec3<f32>, mirror: f32) -> vec3<f32> {
    let turned = select(vec3(1.0), vec3(-1.0), (mirror * changed) < vec3(0.0));
    return select(vec3(0.0), turned, turned * changed >= vec3(MIN_SCALE));
}
