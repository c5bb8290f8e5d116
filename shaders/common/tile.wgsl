// Which tiles a splat touches: exactly those that hold a pixel centre inside the ellipse where its alpha reaches 1/255.
// `project` counts with these functions and `duplicate_with_keys` writes with them. A driver may round differently in
// the two, so `project` uses a slightly larger ellipse: every tile that is written was counted.
#import common/constants

// Pixels added around the ellipse, against rounding. A tile too many costs a little time, a tile too few a hole.
const WRITTEN_PADDING: f32 = 0.02;
const COUNTED_PADDING: f32 = 0.025;
const LN_2: f32 = 0.6931471805599453;

struct Ellipse {
    mean: vec2<f32>,
    conic: vec3<f32>,    // a x^2 + 2 b x y + c y^2 <= tau
    det: f32,            // a c - b^2
    tau: f32,
    extent: vec2<f32>,   // half its bounding box
}

// covariance_det is that of the inverse of `conic`: from the conic itself it would be lost to cancellation in long splats.
fn make_ellipse(mean: vec2<f32>, conic: vec3<f32>, covariance_det: f32, log2_opacity: f32) -> Ellipse {
    let tau = 2.0 * (log2_opacity * LN_2 - log(ALPHA_MIN));
    let extent = sqrt(max(0.0, tau) * covariance_det * vec2(conic.z, conic.x));
    return Ellipse(mean, conic, 1.0 / covariance_det, tau, extent);
}

// First and one past the last row of tiles, within the band.
fn tile_rows(e: Ellipse, frame_band: vec2<u32>, padding: f32) -> vec2<u32> {
    let low = ceil(e.mean.y - e.extent.y - padding - 0.5);
    let high = floor(e.mean.y + e.extent.y + padding - 0.5);
    let band = vec2<f32>(frame_band);
    let first = clamp(floor(low / f32($TILE_H)), band.x, band.y);
    let last = clamp(floor(high / f32($TILE_H)) + 1.0, first, band.y);
    return vec2<u32>(vec2(first, last));
}

// First and one past the last column of tiles in one row of tiles. The ellipse cut by the row's pixel centres is convex,
// so its tiles are an interval, whose ends lie where the ellipse's border is farthest out within the row.
fn tile_columns(e: Ellipse, row: u32, columns: u32, padding: f32) -> vec2<u32> {
    let top = f32(row * u32($TILE_H)) + 0.5 - e.mean.y;
    let slack = padding - WRITTEN_PADDING;   // also along y: in long flat splats a little of y is much of x
    let low = max(top - slack, -e.extent.y);
    let high = min(top + f32($TILE_H - 1) + slack, e.extent.y);
    if (low > high + 2.0 * padding) {
        return vec2(0u);
    }
    let y_right = clamp(-e.conic.y / e.conic.z * e.extent.x, min(low, high), max(low, high));
    let y_left = clamp(e.conic.y / e.conic.z * e.extent.x, min(low, high), max(low, high));
    let x_right = (-e.conic.y * y_right + sqrt(max(0.0, e.conic.x * e.tau - e.det * y_right * y_right))) / e.conic.x;
    let x_left = (-e.conic.y * y_left - sqrt(max(0.0, e.conic.x * e.tau - e.det * y_left * y_left))) / e.conic.x;
    let first_pixel = ceil(e.mean.x + x_left - padding - 0.5);
    let last_pixel = floor(e.mean.x + x_right + padding - 0.5);
    if (first_pixel > last_pixel) {
        return vec2(0u);
    }
    let first = clamp(floor(first_pixel / f32($TILE_W)), 0.0, f32(columns));
    let last = clamp(floor(last_pixel / f32($TILE_W)) + 1.0, first, f32(columns));
    return vec2<u32>(vec2(first, last));
}
