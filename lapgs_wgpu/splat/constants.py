"""Constants that kernels and Python share: those of shaders/common/constants.wgsl, and the columns of a splat."""

import re

from lapgs_wgpu.gpu.shader import shader_text

CONSTANTS = {
    name: float(value)
    for name, value in re.findall(r"^const (\w+): f32 = ([^;]+);", shader_text("common/constants"), re.MULTILINE)
}

# Columns of projected splats and of their gradients, (N, SPLAT_FLOATS) float32, as in common/splat.wgsl.
SPLAT_FLOATS = 12
MEAN = slice(0, 2)  # pixels
CONIC = slice(2, 5)
OPACITY = 5  # log2 of a splat's opacity; in a gradient, that of its natural logarithm
COLOR = slice(6, 9)  # red, green, blue
DEPTH = 9
RADIUS = 10  # pixels; 0 if the Gaussian is invisible
