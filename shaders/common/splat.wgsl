// A projected Gaussian, as `project` and `color` leave it and the rasterizer reads it: three vec4.
//   0: mean x, mean y (pixels), conic a, conic b
//   1: conic c, log2 opacity, red, green
//   2: blue, depth (camera z), radius (pixels; 0: invisible), determinant of the covariance
const SPLAT_STRIDE = 3u;

// The loss's gradient by those, as `gather_gradients` leaves it: three vec4.
//   0: mean x, mean y, conic a, conic b
//   1: conic c, natural logarithm of the opacity, red, green
//   2: blue, depth, 1 where the Gaussian was drawn, -
