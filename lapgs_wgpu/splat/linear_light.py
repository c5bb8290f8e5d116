"""Spherical harmonics of linear light, fitted over all directions to those of displayed colors (sRGB)."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.splat.constants import CONSTANTS

Floats = NDArray[np.floating]

_BLOCK = 1 << 13


def sh_basis(directions: Floats, degree: int) -> Floats:
    """Return real spherical harmonics (D, (degree + 1)^2) of unit vectors (D, 3), in the order and signs of 3DGS."""
    c = CONSTANTS
    x, y, z = directions.T
    xx, yy, zz = x * x, y * y, z * z
    basis = [np.full_like(x, c["SH_C0"]), -c["SH_C1"] * y, c["SH_C1"] * z, -c["SH_C1"] * x]
    basis += [c["SH_C2_0"] * x * y, -c["SH_C2_0"] * y * z, c["SH_C2_1"] * (2 * zz - xx - yy)]
    basis += [-c["SH_C2_0"] * x * z, c["SH_C2_2"] * (xx - yy)]
    basis += [-c["SH_C3_0"] * y * (3 * xx - yy), c["SH_C3_1"] * x * y * z, -c["SH_C3_2"] * y * (4 * zz - xx - yy)]
    basis += [c["SH_C3_3"] * z * (2 * zz - 3 * xx - 3 * yy), -c["SH_C3_2"] * x * (4 * zz - xx - yy)]
    basis += [c["SH_C3_4"] * z * (xx - yy), -c["SH_C3_0"] * x * (xx - 3 * yy)]
    return np.stack(basis[: (degree + 1) ** 2], axis=1)


def directions(count: int) -> Floats:
    """Return unit vectors (count, 3), spread evenly (Fibonacci's spiral)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def display_colors(sh: Floats, basis: Floats) -> Floats:
    """Return colors (N, D, 3) in [0, 1] of harmonics (N, K, 3) in the directions of a basis (D, K)."""
    return np.clip(np.einsum("dk,nkc->ndc", basis, sh) + CONSTANTS["SH_OFFSET"], 0, 1)


def to_linear(display: Floats) -> Floats:
    """Return the linear light of sRGB (IEC 61966-2-1), both in [0, 1]."""
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def to_display(linear: Floats) -> Floats:
    """Return sRGB of linear light, both in [0, 1]."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.003) ** (1 / 2.4) - 0.055)


def linear_harmonics(sh: Floats, degree: int) -> Floats:
    """Return harmonics (N, (degree + 1)^2, 3) of linear light, without offset, that fit the colors of sh (N, K, 3)."""
    return _fitted(sh, degree, lambda block, basis: to_linear(display_colors(block, basis)))


def display_harmonics(light: Floats) -> Floats:
    """Return harmonics (N, K, 3) of displayed colors that fit those of linear light (N, K, 3), without offset."""

    def shown(block: Floats, basis: Floats) -> Floats:
        return to_display(np.einsum("dk,nkc->ndc", basis, block).clip(0, 1)) - CONSTANTS["SH_OFFSET"]

    return _fitted(light, int(light.shape[1] ** 0.5) - 1, shown)


def _fitted(sh: Floats, degree: int, colors: Callable[[Floats, Floats], Floats]) -> Floats:
    """Fit colors (N, D, 3) of blocks of harmonics in the directions of a basis."""
    around = directions(64)
    seen, fit = sh_basis(around, int(sh.shape[1] ** 0.5) - 1), np.linalg.pinv(sh_basis(around, degree))
    blocks = (sh[first : first + _BLOCK] for first in range(0, len(sh), _BLOCK))
    return np.concatenate([np.einsum("kd,ndc->nkc", fit, colors(block, seen)) for block in blocks])
