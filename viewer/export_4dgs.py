"""Export to `.4dgs`: the motion as straight pieces, written by the format's own library."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError, optional_module
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.motion.playback.linear_pieces import Pieces, linear_pieces
from lapgs_wgpu.progress import Progress
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.splat.linear_light import directions, display_colors, linear_harmonics, sh_basis, to_display
from lapgs_wgpu.viewer.export_loss import Loss, measure, plain_factors
from lapgs_wgpu.viewer.loaded_scene import LoadedScene, nearest_axis
from lapgs_wgpu.viewer.moving_files import AXES, SH_RANGE, SampledPlayback, read_4dgs

_TIME_STEP = 1e-3  # seconds: the library rounds the middles of pieces to it (profile "fine")


def export_4dgs(scene: LoadedScene, file: Path, max_error: float) -> Loss:
    """Write a `.4dgs` of a scene that moves, and compare what the library reads in it with the scene. Atomic.

    max_error: how far a point of the ellipsoid of one standard deviation of a Gaussian may lie from where the field has
    it, pixels of the captured images at the distance of the focus. Raises InputError where the file cannot be written,
    nothing moves or can be seen, or the package fourdgs is missing.
    """
    fourdgs = optional_module("fourdgs", "writing .4dgs needs fourdgs", "export")
    playback = scene.playback
    if not playback.moves:
        raise InputError(f"{scene.path}: holds no motion; --export FILE.ply writes it for other viewers.")
    camera, seconds = scene.camera(), scene.clock().seconds
    pixel = 2 * math.tan(0.5 * camera.fov_y) * camera.distance / scene.initial_view.camera.height  # world units
    with atomic_write(file) as target:  # before minutes of work
        with Progress(1000, "thousandths of the motion") as progress:
            allowed = 0.85 * max_error * pixel  # the rest is for the format's rounding
            shade = 4 / 255  # largest change of opacity and color within a piece
            pieces = linear_pieces(playback, allowed, shade, lambda share: progress.at(1 + int(998 * share)))
            progress.at(1000)
        if not len(pieces.source):
            raise InputError(f"{scene.path}: holds no Gaussians that can be seen.")
        pieces = pieces._replace(opacities=pieces.opacities * plain_factors(scene)[pieces.source])
        up = AXES.index(nearest_axis(scene.initial_view.up))
        ahead = AXES.index(nearest_axis(scene.initial_view.camera.T_cam_world[2, :3] * (np.arange(3) != up % 3)))
        axes = fourdgs.CoordinateFrame(handedness=1, up_axis=up, forward_axis=ahead)  # right-handed, of no unit
        options = fourdgs.WriteOptions(
            profile="fine",
            library="lapgs_wgpu",
            metadata={"color_space": "linear-rec709-display", "visibility_profile": "box"},
            provenance=fourdgs.Provenance(frames=[axes]),
            preserve_source_ids=True,
        )
        fov, position, focus = math.degrees(camera.fov_y), tuple(camera.position), tuple(camera.focus)
        view = fourdgs.CameraTrajectory(fov, position, focus, interpolation="linear")
        sh = playback.at(0.0).sh.read()  # (N, K, 3); those of degree 0 change with time
        fourdgs.write(target, _gaussian_set(fourdgs, pieces, sh, seconds), seconds, options=options, camera=view)
    written = SampledPlayback(playback.device, read_4dgs(file))
    return measure(scene, written, fourdgs.read(file).gaussians.source_index)


def _gaussian_set(fourdgs: Any, pieces: Pieces, sh: NDArray[np.float32], seconds: float) -> Any:
    """Convert pieces to the library's Gaussians, with times in seconds and colors as linear light."""
    colors = sh[pieces.source].astype(np.float64)
    colors[:, 0] = pieces.dc
    degree = best_degree(colors)
    light = linear_harmonics(colors, degree)
    base = (CONSTANTS["SH_C0"] * light[:, 0]).clip(0, 1)
    middles = 0.5 * (pieces.begin + pieces.end)
    at = _TIME_STEP * np.rint(middles * seconds / _TIME_STEP)
    return fourdgs.GaussianSet(
        positions=pieces.means + (at / seconds - middles)[:, None] * pieces.slopes,
        scales=pieces.scales,
        rotations=pieces.quats,
        colors=np.column_stack([base, pieces.opacities]),
        motions=pieces.slopes / seconds,
        mu_t=at,
        sigma_t=np.full(len(at), np.inf),  # a piece is there from its begin to its end, in full opacity
        win_lo=pieces.begin * seconds,
        win_hi=pieces.end * seconds,
        sh=harmonics_bytes(light[:, 1:]).transpose(0, 2, 1).reshape(len(at), -1),  # all reds, greens, blues
        sh_degree=degree,
        source_group=np.zeros(len(at), np.int64),
        source_index=pieces.source,
    )


def best_degree(sh: NDArray[np.floating]) -> int:
    """Find the degree whose harmonics, as bytes of linear light, come nearest to the displayed colors of sh (N, K, 3).

    Bytes are coarse (`harmonics_bytes`), and most so in the dark: where colors hardly depend on the direction, fewer
    harmonics are nearer to them than all.
    """
    some = sh[:: max(1, len(sh) // 2000)]
    degree = int(sh.shape[1] ** 0.5) - 1
    around = directions(64)
    true = display_colors(some, sh_basis(around, degree))
    errors = []
    for fewer in range(degree + 1):
        light = linear_harmonics(some, fewer)
        light[:, 1:] = harmonics_bytes(light[:, 1:]) * (2 * SH_RANGE / 255) - SH_RANGE
        shown = to_display(np.einsum("dk,nkc->ndc", sh_basis(around, fewer), light).clip(0, 1))
        errors.append(float(((shown - true) ** 2).mean()))
    return int(np.argmin(errors))


def harmonics_bytes(coefficients: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Quantize coefficients to the format's bytes, clipped to its range."""
    return np.rint((coefficients + SH_RANGE) * (255 / (2 * SH_RANGE))).clip(0, 255).astype(np.uint8)
