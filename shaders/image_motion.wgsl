// How the image moves when its camera does: the lower half of the sum of J^T J over the points in the image, and the sum of
// their weights (train/camera_refinement.image_motion), by one workgroup. The points are every so many Gaussians.
#import common/frame
#import common/geometry

struct Seen {
    gaussians: u32,
    spacing: u32,    // so that there are 2000 points at most
    unit: f32,       // of a shift of the camera, world units
}

const LANES = 128u;
const ENTRIES = 22u;     // of a symmetric matrix (6, 6), and a weight
const LARGEST = 3e38;
const NEAREST = 0.05;    // depth relative to the median, below which a point does not count

@group(0) @binding(0) var<uniform> seen: Seen;
@group(0) @binding(1) var<uniform> frame: Frame;
@group(0) @binding(2) var<storage, read> geometry: array<vec4<f32>>;
@group(0) @binding(3) var<storage, read_write> motion: array<f32>;   // (ENTRIES,), rows from the first on

var<workgroup> memory: array<f32, 2816>;   // LANES * ENTRIES; at first the depths of the points
var<workgroup> counted: atomic<u32>;

fn points() -> u32 {
    return (seen.gaussians + seen.spacing - 1u) / seen.spacing;
}

fn arm_of(point: u32) -> vec3<f32> {
    return geometry[ROW * seen.spacing * point].xyz - frame.position;
}

fn ahead_below(limit: f32, lane: u32) -> u32 {
    workgroupBarrier();
    if (lane == 0u) {
        atomicStore(&counted, 0u);
    }
    workgroupBarrier();
    var mine = 0u;
    for (var i = lane; i < points(); i += LANES) {
        mine += select(0u, 1u, memory[i] > 0.0 && memory[i] < limit);
    }
    atomicAdd(&counted, mine);
    workgroupBarrier();
    return atomicLoad(&counted);
}

// Of the depths that are positive, bit by bit: the largest value that at most half of them lie below.
fn median_depth(lane: u32) -> f32 {
    let middle = (max(ahead_below(LARGEST, lane), 1u) - 1u) / 2u;
    var found = 0u;
    for (var bit = 0x40000000u; bit > 0u; bit >>= 1u) {
        let below = ahead_below(bitcast<f32>(min(found | bit, 0x7f7fffffu)), lane);
        found = select(found, found | bit, below <= middle);
    }
    return bitcast<f32>(min(found, 0x7f7fffffu));
}

@compute @workgroup_size(128)
fn main(@builtin(local_invocation_index) lane: u32) {
    let R = transpose(mat3x3(frame.view[0].xyz, frame.view[1].xyz, frame.view[2].xyz));   // its columns are the rows
    for (var i = lane; i < points(); i += LANES) {
        memory[i] = dot(R[2], arm_of(i));
    }
    let nearest = NEAREST * median_depth(lane);
    var mine: array<f32, ENTRIES>;
    for (var i = lane; i < points(); i += LANES) {
        let arm = arm_of(i);
        let depth = dot(R[2], arm);
        let uv = vec2(dot(R[0], arm), dot(R[1], arm)) / depth;
        let place = frame.focal * uv + frame.center;
        if (depth <= nearest || depth <= 0.0 || any(place < vec2(0.0)) || any(place >= vec2<f32>(frame.size))) {
            continue;
        }
        let weight = 1.0 / (1.0 + exp(-geometry[ROW * seen.spacing * i].w));
        let x = (R[0] - uv.x * R[2]) / depth;
        let y = (R[1] - uv.y * R[2]) / depth;
        let turns = mat2x3(cross(x, arm), cross(y, arm));
        let shifts = mat2x3(-seen.unit * x, -seen.unit * y);
        for (var k = 0u; k < 2u; k++) {
            let J = array<f32, 6>(turns[k].x, turns[k].y, turns[k].z, shifts[k].x, shifts[k].y, shifts[k].z);
            var entry = 0u;
            for (var row = 0u; row < 6u; row++) {
                for (var column = 0u; column <= row; column++) {
                    mine[entry] += weight * J[row] * J[column];
                    entry++;
                }
            }
        }
        mine[21] += weight;
    }
    workgroupBarrier();
    for (var entry = 0u; entry < ENTRIES; entry++) {
        memory[lane * ENTRIES + entry] = mine[entry];
    }
    workgroupBarrier();
    if (lane < ENTRIES) {
        var sum = 0.0;
        for (var k = 0u; k < LANES; k++) {
            sum += memory[k * ENTRIES + lane];
        }
        motion[lane] = sum;
    }
}
