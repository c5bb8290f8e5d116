"""Gaussians in .ply files of other programs: what their variants mean, and what their comments say."""

import json
import re
import sys

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.ply import GaussianSnapshot, gaussian_names, problems, snapshot_of, vertex_of
from lapgs_wgpu.io.ply_elements import BAD_SHARE, SH_C0, Floats, PathLike, PlyFile, read_colors

_MOTION = re.compile(  # words of a property's name that speak of time or of motion
    "(.*_)?(trbf|motion|omega|velocity|vel|v[xyz]|rot_r|t|time|timestamp|duration|lifetime|poly|fourier|traj|deform|temporal)"
    "(_.*)?",
    re.IGNORECASE,
)
_FLAT = float(np.log(1e-7))  # log of the smallest scale that is drawn
_SCALES, _UNTURNED = {"scale_0", "scale_1", "scale_2"}, {"rot_0": 1.0, "rot_1": 0.0, "rot_2": 0.0, "rot_3": 0.0}
_OPAQUE = 20.0  # its sigmoid is 1 in float32
_FAR = 100.0  # distance of the scene's middle from the origin, in extents of the scene


def read_foreign(ply: PlyFile) -> tuple[GaussianSnapshot, dict[str, str]]:
    """The Gaussians of a 3DGS .ply of any program, and as metadata what else it says. Notes go to stderr.

    Metadata: `antialiased` is "true" where a comment says so; `up`, an axis such as "z" or "-y", is the comment's
    vertical axis; `offset` is a JSON list of 3 numbers, which were taken off the means.

    Degree 0 may be given as colors; the third scale of flat Gaussians, or two scales and the quaternion of spherical
    ones, may be missing. An infinite opacity is opaque, or leaves the Gaussian out; a scale of 0 is flat; a quaternion
    of 0 does not turn. A few rows that cannot be rendered are left out. Raises InputError for all else that
    `snapshot_of` refuses, and for Gaussians that move.
    """
    vertex = vertex_of(ply)
    moving = [name for name in vertex.properties if _MOTION.fullmatch(name)]
    if moving:
        raise InputError(
            f"{ply.path}: its Gaussians move (properties {', '.join(moving[:5])}, {len(moving)} in all), as in "
            "Spacetime Gaussians, of which no still is read; lapgs-view plays those with a cubic motion"
        )
    held, missing = set(vertex.properties), dict[str, Floats | float]()
    scales = held & _SCALES
    if scales == {"scale_0", "scale_1"}:
        missing["scale_2"] = _FLAT
    elif scales == {"scale_0"}:
        missing |= dict.fromkeys(("scale_1", "scale_2"), ply.columns(vertex, ["scale_0"])[:, 0])
        if not held & set(_UNTURNED):
            missing |= _UNTURNED
    if not held & {"f_dc_0", "f_dc_1", "f_dc_2"} and "opacity" in held:
        colors = read_colors(ply, vertex)
        if colors is not None:
            missing |= {f"f_dc_{i}": (colors[:, i] - 0.5) / np.float32(SH_C0) for i in range(3)}
    names = gaussian_names(vertex, held | set(missing), ply.path)
    unused = [name for name in vertex.properties if name not in (*names, "nx", "ny", "nz", "red", "green", "blue")]
    if unused:
        _note(ply.path, f"{len(unused)} further properties, such as {', '.join(unused[:5])}, are not used")
    values = ply.columns(vertex, [name for name in names if name not in missing])
    for index, name in enumerate(names):
        if name in missing:
            values = np.insert(values, index, missing[name], axis=1)
    metadata, text = {}, "\n".join(ply.comments)
    if re.search(r"SplatRenderMode\s*[:=]\s*mip", text, re.IGNORECASE):
        metadata["antialiased"] = "true"
    axis = re.search(r"(?:vertical|up)[ _]?axis\s*[:=]\s*\+?(-?[xyz])\b", text, re.IGNORECASE)
    if axis:
        metadata["up"] = axis[1].lower()
    middle, extent = _middle_and_extent(values[:, :3].astype(np.float64))
    if np.abs(middle).max() > _FAR * extent:
        means = ply.columns(vertex, ["x", "y", "z"], np.float64)  # in float32 they are terraces
        middle, extent = _middle_and_extent(means)
        if extent > 0:
            offset = np.round(middle, max(0, -int(np.floor(np.log10(extent)))))
            with np.errstate(over="ignore"):
                values[:, :3] = means - offset
            metadata["offset"] = json.dumps(offset.tolist())
            _note(ply.path, f"lies far from the origin: {offset.tolist()} is taken off all coordinates")
    return snapshot_of(_mended(values, names, ply.path), names, ply.path), metadata


def _note(path: PathLike, text: str) -> None:
    print(f"note: {path}: {text}.", file=sys.stderr)


def _middle_and_extent(means: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Median (3,) of means (N, 3), and the longest side of the box around nine tenths of them; 0 of no finite ones."""
    finite = means[np.isfinite(means).all(axis=1)]
    if not len(finite):
        return np.zeros(3), 0.0
    low, middle, high = np.quantile(finite, [0.05, 0.5, 0.95], axis=0)
    return middle, float((high - low).max())


def _mended(values: Floats, names: list[str], path: PathLike) -> Floats:
    """Replace in columns what is legal and cannot be rendered as it is, and leave out rows."""
    opacities, scales, quats = values[:, -8], values[:, -7:-4], values[:, -4:]
    invisible = opacities == -np.inf
    opacities[opacities == np.inf] = _OPAQUE
    scales[scales == -np.inf] = _FLAT
    quats[(quats == 0).all(axis=1)] = [1, 0, 0, 0]
    bad = np.zeros(len(values), bool)
    for rows, _ in problems(values, names):
        bad |= rows & ~invisible
    if bad.mean() > BAD_SHARE:
        return values  # refused as a whole
    if bad.any():
        _note(path, f"{bad.sum()} of {len(bad)} Gaussians hold NaN, infinite or enormous values and are left out")
    if invisible.all():
        raise InputError(f"{path}: no Gaussian is visible (property opacity is minus infinity in all {len(bad)} rows)")
    kept = ~(bad | invisible)
    return values if kept.all() else values[kept]
