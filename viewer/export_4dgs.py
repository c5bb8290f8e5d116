"""A scene for players without our field: straight pieces of motion in a `.4dgs` file, and how far off they are."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.fourdgs_file import Grid, LinearPieces, bytes_harmonics, harmonics_bytes, pack_4dgs, round_pieces
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.motion.playback.linear_pieces import Pieces, linear_pieces, piece_errors
from lapgs_wgpu.motion.playback.playback import Playback
from lapgs_wgpu.progress import Progress
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.splat.linear_light import directions, display_colors, linear_harmonics, sh_basis, to_display
from lapgs_wgpu.viewer.export import check_free
from lapgs_wgpu.viewer.loaded_scene import LoadedScene

MAX_ERROR = 0.5  # pixels, without --max-error
_SHADE = 4 / 255  # largest change of opacity and color within a piece
_OF_LINES = 0.85  # share of the error that straight lines may use up; the rest is for rounding
_TICKS = 1 << 12  # of the clip: middles of pieces lie on them
_PROGRESS = 1000


class Baked(NamedTuple):
    """data: the file. gaussians, pieces: how many. error: largest displacement found, pixels."""

    data: bytes
    gaussians: int
    pieces: int
    error: float


def export_4dgs(scene: LoadedScene, file: Path, max_error: float, *, overwrite: bool = False) -> Baked:
    """Write a `.4dgs`. Atomic. Raises InputError as `bake_4dgs`, and where it cannot be written or is there already."""
    check_free(file, overwrite)
    with atomic_write(file) as target:  # before minutes of work
        baked = bake_4dgs(scene, max_error)
        target.write(baked.data)
    return baked


def bake_4dgs(scene: LoadedScene, max_error: float) -> Baked:
    """Bake a scene that moves.

    max_error: how far a point of the ellipsoid of one standard deviation of a Gaussian may lie from where it should,
    pixels of the captured pictures at the distance of the focus. Raises InputError where nothing moves or can be seen.
    """
    playback, look = scene.playback, scene.look
    if not playback.moves:
        raise InputError(f"{scene.path}: holds no motion; --export FILE.ply writes it for other viewers.")
    camera = scene.camera()
    pixel = 2 * math.tan(0.5 * camera.fov_y) * camera.distance / look.camera.height  # world units
    with Progress(_PROGRESS, "thousandths of the motion") as progress:
        allowed = _OF_LINES * max_error * pixel
        pieces = linear_pieces(playback, allowed, _SHADE, lambda share: progress.at(1 + int((_PROGRESS - 2) * share)))
        progress.at(_PROGRESS)
    if not len(pieces.source):
        raise InputError(f"{scene.path}: holds no Gaussians that can be seen.")
    seconds = scene.clock().seconds
    largest = float(np.quantile(pieces.scales.max(axis=1), 0.999))
    grid = _grid((1 - _OF_LINES) * max_error * pixel, largest, seconds)
    rounded = round_pieces(_colored(pieces, _harmonics(playback), seconds), grid)
    error = float(piece_errors(playback, _on_the_clip(rounded.pieces, seconds)).max()) / pixel
    texts = {
        "color_space": "linear-rec709-display",
        "visibility_profile": "box",
        "source": f"baked by lapgs-view: at most {error:.2f} pixels of {look.camera.height} beside the learned motion",
    }
    pose = (math.degrees(camera.fov_y), camera.position.tolist(), camera.focus.tolist())
    data = pack_4dgs(rounded, grid, seconds, camera=pose, axes=_axes(look), texts=texts)
    return Baked(data, len(np.unique(pieces.source)), len(pieces.source), error)


def _on_the_clip(pieces: LinearPieces, seconds: float) -> Pieces:
    """What a file says of its pieces, in times of the clip."""
    begin, end = pieces.spans.T / seconds
    return Pieces(
        pieces.source, begin, end, pieces.means, pieces.velocities * seconds, pieces.scales, pieces.quats,
        pieces.opacities, pieces.colors,
    )  # fmt: skip


def _grid(rest: float, largest: float, seconds: float) -> Grid:
    """Steps whose roundings together displace Gaussians of up to the largest scale by about `rest`, world units."""
    angle = min(rest / (40 * largest), 2e-3)
    return Grid(
        mean=0.25 * rest,
        log_scale=min(rest / (4 * largest), 0.04),
        rotation=angle,
        color=1 / 2047,
        opacity=1 / 255,
        velocity=2 * rest / max(1.0, seconds),  # displaces most at the ends of the longest span
        time=seconds / _TICKS,
    )


def _harmonics(playback: Playback) -> NDArray[np.float32]:
    """(N, K, 3) of the Gaussians; those of degree 0 change with time."""
    sh: NDArray[np.float32] = playback.at(0.0).sh.read()
    return sh


def _colored(pieces: Pieces, sh: NDArray[np.float32], seconds: float) -> LinearPieces:
    """The pieces on the clock of the file, their colors as linear light."""
    colors = sh[pieces.source].astype(np.float64)
    colors[:, 0] = pieces.dc
    light = linear_harmonics(colors, best_degree(colors))
    return LinearPieces(
        source=pieces.source,
        spans=np.stack([pieces.begin, pieces.end], axis=1) * seconds,
        means=pieces.means,
        velocities=pieces.slopes / seconds,
        scales=pieces.scales,
        quats=pieces.quats,
        opacities=pieces.opacities,
        colors=(CONSTANTS["SH_C0"] * light[:, 0]).clip(0, 1),
        harmonics=light[:, 1:],
    )


def best_degree(sh: NDArray[np.floating]) -> int:
    """The degree whose harmonics, as bytes of linear light, come nearest to the displayed colors of sh (N, K, 3).

    Bytes are coarse (fourdgs_file.harmonics_bytes), and most so in the dark: where colors hardly depend on the
    direction, fewer harmonics are nearer to them than all.
    """
    some = sh[:: max(1, len(sh) // 2000)]
    degree = int(sh.shape[1] ** 0.5) - 1
    around = directions(64)
    true = display_colors(some, sh_basis(around, degree))
    errors = []
    for fewer in range(degree + 1):
        light = linear_harmonics(some, fewer)
        light[:, 1:] = bytes_harmonics(harmonics_bytes(light[:, 1:]))
        shown = to_display(np.einsum("dk,nkc->ndc", sh_basis(around, fewer), light).clip(0, 1))
        errors.append(float(((shown - true) ** 2).mean()))
    return int(np.argmin(errors))


def _axes(look: InitialView) -> tuple[int, int] | None:
    """Up and ahead as the nearest of +x +y +z -x -y -z; None where up is not near to one."""
    up = _axis(look.up)
    ahead = look.camera.T_cam_world[2, :3] * (np.arange(3) != up % 3)
    return (up, _axis(ahead)) if np.abs(look.up).max() > 0.9 else None


def _axis(direction: NDArray[np.floating]) -> int:
    largest = int(np.abs(direction).argmax())
    return largest + (3 if direction[largest] < 0 else 0)
