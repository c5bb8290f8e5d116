"""The columns of a projected splat and of its gradient, (N, SPLAT_FLOATS) float32, as common/splat.wgsl has them."""

from __future__ import annotations

SPLAT_FLOATS = 12
MEAN = slice(0, 2)  # pixels
OPACITY = 5  # of a splat its log2; of a gradient that by the opacity itself
COLOR = slice(6, 9)  # red, green, blue
RADIUS = 10  # pixels; 0 where a Gaussian is not seen
