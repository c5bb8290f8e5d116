// Constants of the passes. Each number stands here once; Python reads this file, too (splat/constants.py).

const DILATION: f32 = 0.3;                      // px^2, the low-pass filter's variance where nothing else is said
const NEAR: f32 = 0.01;                         // world units; a Gaussian at or before this camera depth is culled
const FRUSTUM_MARGIN: f32 = 0.3;                // the Jacobian's x/z, y/z end this many half-images beyond the borders
const MIN_SCALE: f32 = 1e-7;                     // world units; no scale is below it, at rest or deformed
const ALPHA_MAX: f32 = 0.99;                    // one splat never hides all that is behind it
const ALPHA_MIN: f32 = 0.00392156862745098;     // 1/255: a fainter contribution is skipped
const LOG2_ALPHA_MIN: f32 = -7.994353436858858; // its log2: compared before the exponential is taken
const TRANSMITTANCE_MIN: f32 = 1e-4;            // a pixel stops before its transmittance falls to this

// Real spherical harmonics (Condon-Shortley phase in the signs of the basis, not here), SH_C<degree>_<kind>.
const SH_C0: f32 = 0.28209479177387814;         // 1/2 sqrt(1/pi)
const SH_C1: f32 = 0.4886025119029199;          // 1/2 sqrt(3/pi): x, y, z
const SH_C2_0: f32 = 1.0925484305920792;        // 1/2 sqrt(15/pi): xy, yz, xz
const SH_C2_1: f32 = 0.31539156525252005;       // 1/4 sqrt(5/pi): 2zz - xx - yy
const SH_C2_2: f32 = 0.5462742152960396;        // 1/4 sqrt(15/pi): xx - yy
const SH_C3_0: f32 = 0.5900435899266435;        // 1/4 sqrt(35/(2 pi)): y (3xx - yy), x (xx - 3yy)
const SH_C3_1: f32 = 2.890611442640554;         // 1/2 sqrt(105/pi): xyz
const SH_C3_2: f32 = 0.4570457994644658;        // 1/4 sqrt(21/(2 pi)): y (4zz - xx - yy), x (4zz - xx - yy)
const SH_C3_3: f32 = 0.3731763325901154;        // 1/4 sqrt(7/pi): z (2zz - 3xx - 3yy)
const SH_C3_4: f32 = 1.445305721320277;         // 1/4 sqrt(105/pi): z (xx - yy)
const SH_OFFSET: f32 = 0.5;                     // color = max(SH + this, 0): zero coefficients mean mid grey

// Image losses.
const SSIM_C1: f32 = 1e-4;                      // 0.01^2, of the luminance
const SSIM_C2: f32 = 9e-4;                      // 0.03^2, of contrast and structure
const NCC_E: f32 = 1e-4;                        // a covariance; a window with less variance counts as flat
const NCC_TINY: f32 = 1e-14;                    // keeps the square root differentiable; its own root is far below NCC_E
