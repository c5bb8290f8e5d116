// A step of Adam of an image's color correction, unless the guard is closed; the mean of all corrections stays the
// identity (train/exposure.py). An image without a gradient stays as it is.
struct ExposureStep {
    number: u32,    // of the image
    count: u32,     // of all
    rate: f32,
}

const LANES = 192u;
const VALUES = 12u;
const PARTS = 16u;   // LANES / VALUES
const ROW = 40u;
const MEAN_DECAY = 0.9;
const SQUARE_DECAY = 0.999;
const LOG2_MEAN_DECAY = -0.15200309344504997;
const LOG2_SQUARE_DECAY = -0.0014434168696687078;
const EPSILON = 1e-15;

@group(0) @binding(0) var<uniform> descent: ExposureStep;
@group(0) @binding(1) var<storage, read> guard: u32;
@group(0) @binding(2) var<storage, read> d_exposure: array<f32>;            // (12,)
@group(0) @binding(3) var<storage, read_write> exposures: array<f32>;       // (V, ROW): correction, Adam's moments, steps, 0

var<workgroup> of_lane: array<f32, LANES>;

@compute @workgroup_size(192)
fn main(@builtin(local_invocation_index) lane: u32) {
    let column = lane % VALUES;
    let at = ROW * descent.number + column;
    let gradient = d_exposure[column];
    let steps = exposures[ROW * descent.number + 3u * VALUES] + 1.0;
    let mean = MEAN_DECAY * exposures[at + VALUES] + (1.0 - MEAN_DECAY) * gradient;
    let square = SQUARE_DECAY * exposures[at + 2u * VALUES] + (1.0 - SQUARE_DECAY) * gradient * gradient;
    let size = sqrt(square / (1.0 - exp2(steps * LOG2_SQUARE_DECAY)));
    let fresh = exposures[at] - descent.rate * mean / (1.0 - exp2(steps * LOG2_MEAN_DECAY)) / (size + EPSILON);
    var any_gradient = false;
    for (var k = 0u; k < VALUES; k++) {
        any_gradient = any_gradient || d_exposure[k] != 0.0;
    }
    var sum = 0.0;
    for (var i = lane / VALUES; i < descent.count; i += PARTS) {
        sum += select(exposures[ROW * i + column], fresh, i == descent.number);
    }
    of_lane[lane] = sum;
    storageBarrier();
    workgroupBarrier();
    if (guard != 0u || !any_gradient) {
        return;
    }
    sum = 0.0;
    for (var k = 0u; k < PARTS; k++) {
        sum += of_lane[VALUES * k + column];
    }
    // The identity's ones are the first, the sixth and the eleventh.
    let excess = sum / f32(descent.count) - select(0.0, 1.0, column % 5u == 0u);
    for (var i = lane / VALUES; i < descent.count; i += PARTS) {
        exposures[ROW * i + column] = select(exposures[ROW * i + column], fresh, i == descent.number) - excess;
    }
    if (lane < VALUES) {
        exposures[at + VALUES] = mean;
        exposures[at + 2u * VALUES] = square;
    }
    if (lane == 0u) {
        exposures[ROW * descent.number + 3u * VALUES] = steps;
    }
}
