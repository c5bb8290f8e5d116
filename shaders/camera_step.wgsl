// A step of a camera's correction down its whitened gradient, unless the guard is closed: train/camera_refinement.py in
// float32, by one workgroup. A camera without a gradient stays as it is.
#import common/rotation_vector

struct CameraStep {
    number: u32,       // of the camera
    cameras: u32,
    rate: f32,         // radians of image motion
    damping: f32,
    kept: f32,         // share of a correction that is not pulled back
}

const LANES = 128u;
const CAMERA = 16u;             // of `cameras`
const MOST_COMMON = 8u;
const ITERATIONS = 24u;      // of the inverse root, for eigenvalues down to 1e-5 of the largest
const MEAN_DECAY = 0.5;
const SQUARE_DECAY = 0.98;
const LOG2_SQUARE_DECAY = -0.029146345659516508;

@group(0) @binding(0) var<uniform> descent: CameraStep;
@group(0) @binding(1) var<storage, read> guard: u32;
@group(0) @binding(2) var<storage, read> motion: array<f32>;     // as image_motion leaves it
@group(0) @binding(3) var<storage, read> d_camera: array<f32>;   // (8,): by rotation, 0, by shift, 0
// (6 C, MOST_COMMON), orthonormal columns, then zeros: what moves all cameras and no image
@group(0) @binding(4) var<storage, read> common_motions: array<f32>;
// (C + 1, CAMERA): rotation vector, shift, momentum (6), number of steps, 0; last the second moment of all, number of steps, 0
@group(0) @binding(5) var<storage, read_write> cameras: array<f32>;

var<workgroup> of_lane: array<f32, 1024>;   // LANES * MOST_COMMON
var<workgroup> root: array<f32, 36>;
var<workgroup> inverse: array<f32, 36>;    // inverse root
var<workgroup> product: array<f32, 36>;
var<workgroup> sums: array<f32, MOST_COMMON>;
var<workgroup> fresh: array<f32, 12>;      // correction and momentum
var<workgroup> square: f32;

// Into `inverse`: the inverse root of the image motion with damping, by Newton and Schulz (Higham 2008, 6.35).
fn whiten(lane: u32) {
    let row = lane / 6u;
    let column = lane % 6u;
    let trace = motion[0] + motion[2] + motion[5] + motion[9] + motion[14] + motion[20];
    let weight = select(0.0, 1.0 / motion[21], motion[21] > 0.0);
    let size = weight * trace * (1.0 + descent.damping);   // no eigenvalue is larger
    let one = select(0.0, 1.0, row == column);
    if (lane < 36u) {
        let high = max(row, column);
        let entry = weight * (motion[high * (high + 1u) / 2u + min(row, column)] + descent.damping * trace / 6.0 * one);
        root[lane] = select(one, entry / size, size > 0.0);
        inverse[lane] = one;
    }
    for (var k = 0u; k < ITERATIONS; k++) {
        workgroupBarrier();
        if (lane < 36u) {
            var sum = 1.5 * one;
            for (var j = 0u; j < 6u; j++) {
                sum -= 0.5 * inverse[6u * row + j] * root[6u * j + column];
            }
            product[lane] = sum;
        }
        workgroupBarrier();
        var next = vec2(0.0);
        if (lane < 36u) {
            for (var j = 0u; j < 6u; j++) {
                next += vec2(root[6u * row + j] * product[6u * j + column], product[6u * row + j] * inverse[6u * j + column]);
            }
        }
        workgroupBarrier();
        if (lane < 36u) {
            root[lane] = next.x;
            inverse[lane] = next.y;
        }
    }
    workgroupBarrier();
    if (lane < 36u) {
        inverse[lane] *= select(0.0, inverseSqrt(size), size > 0.0);
    }
    workgroupBarrier();
}

// By one lane: the correction and its momentum into `fresh`, the second moment into `square`.
fn change(gradient: array<f32, 6>) {
    let at = CAMERA * descent.number;
    let all = CAMERA * descent.cameras;
    let steps = cameras[at + 12u] + 1.0;
    let every = cameras[all + 1u] + 1.0;
    var sum = 0.0;
    var momentum: array<f32, 6>;
    for (var i = 0u; i < 6u; i++) {
        var white = 0.0;
        for (var j = 0u; j < 6u; j++) {
            white += inverse[6u * i + j] * gradient[j];
        }
        sum += white * white;
        momentum[i] = MEAN_DECAY * cameras[at + 6u + i] + (1.0 - MEAN_DECAY) * white;
        fresh[6u + i] = momentum[i];
    }
    square = SQUARE_DECAY * cameras[all] + (1.0 - SQUARE_DECAY) * sum;
    let size = sqrt(square / (1.0 - exp2(every * LOG2_SQUARE_DECAY))) * (1.0 - exp2(-steps));
    let factor = select(0.0, -descent.rate / size, size > 0.0);
    var moves: array<f32, 6>;
    for (var i = 0u; i < 6u; i++) {
        for (var j = 0u; j < 6u; j++) {
            moves[i] += factor * inverse[6u * i + j] * momentum[j];
        }
    }
    let before = turn_of(vec3(cameras[at], cameras[at + 1u], cameras[at + 2u]));
    let turn = descent.kept * vector_of(turned(turn_of(vec3(moves[0], moves[1], moves[2])), before));
    for (var i = 0u; i < 3u; i++) {
        fresh[i] = turn[i];
        fresh[3u + i] = descent.kept * (cameras[at + 3u + i] + moves[3u + i]);
    }
}

// A number of all corrections (C, 6), the one of this step fresh.
fn correction(i: u32) -> f32 {
    if (i / 6u == descent.number) {
        return fresh[i % 6u];
    }
    return cameras[CAMERA * (i / 6u) + i % 6u];
}

@compute @workgroup_size(128)
fn main(@builtin(local_invocation_index) lane: u32) {
    let gradient = array<f32, 6>(d_camera[0], d_camera[1], d_camera[2], d_camera[4], d_camera[5], d_camera[6]);
    let any_gradient = any(vec3(gradient[0], gradient[1], gradient[2]) != vec3(0.0))
        || any(vec3(gradient[3], gradient[4], gradient[5]) != vec3(0.0));
    whiten(lane);
    if (lane == 0u) {
        change(gradient);
    }
    workgroupBarrier();
    var mine: array<f32, MOST_COMMON>;
    for (var i = lane; i < 6u * descent.cameras; i += LANES) {
        for (var k = 0u; k < MOST_COMMON; k++) {
            mine[k] += common_motions[MOST_COMMON * i + k] * correction(i);
        }
    }
    for (var k = 0u; k < MOST_COMMON; k++) {
        of_lane[lane * MOST_COMMON + k] = mine[k];
    }
    workgroupBarrier();
    if (lane < MOST_COMMON) {
        var sum = 0.0;
        for (var k = 0u; k < LANES; k++) {
            sum += of_lane[k * MOST_COMMON + lane];
        }
        sums[lane] = sum;
    }
    workgroupBarrier();
    if (guard != 0u || !any_gradient) {
        return;
    }
    for (var i = lane; i < 6u * descent.cameras; i += LANES) {
        var value = correction(i);
        for (var k = 0u; k < MOST_COMMON; k++) {
            value -= common_motions[MOST_COMMON * i + k] * sums[k];
        }
        cameras[CAMERA * (i / 6u) + i % 6u] = value;
    }
    if (lane < 6u) {
        cameras[CAMERA * descent.number + 6u + lane] = fresh[6u + lane];
    }
    if (lane == 0u) {
        cameras[CAMERA * descent.number + 12u] += 1.0;
        cameras[CAMERA * descent.cameras] = square;
        cameras[CAMERA * descent.cameras + 1u] += 1.0;
    }
}
