"""Columns of projected splats and of their gradients, (N, SPLAT_FLOATS) float32, as in common/splat.wgsl."""

from __future__ import annotations

SPLAT_FLOATS = 12
MEAN = slice(0, 2)  # pixels
OPACITY = 5  # log2 of a splat's opacity; in a gradient, that of its natural logarithm
COLOR = slice(6, 9)  # red, green, blue
RADIUS = 10  # pixels; 0 if the Gaussian is invisible
