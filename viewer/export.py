"""Stills of a moving scene as plain .ply files in Inria's layout, one or one a moment."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.ply import write_ply
from lapgs_wgpu.progress import Progress

from .loaded_scene import LoadedScene

_FRAME = re.compile(r"frame_\d+\.ply")
MOST_FRAMES = 100_000


def export_still(scene: LoadedScene, file: Path, time: float, *, overwrite: bool = False) -> None:
    """Write the Gaussians at a time in [0, 1]. Atomic.

    Raises InputError where it cannot be written, where the file is there already and `overwrite` is not given, and
    always where it is the opened file, whose motion would be lost.
    """
    if file.exists():
        if scene.path is not None and file.samefile(scene.path):
            raise InputError(f"{file}: is the opened file, and a still holds no motion; take another name.")
        if not overwrite:
            raise InputError(f"{file}: is there already; --overwrite replaces it.")
    write_ply(file, scene.playback.still(time))


def export_frames(scene: LoadedScene, folder: Path, frames: int, *, overwrite: bool = False) -> None:
    """Write frame_0000.ply to the last one, at times evenly from 0 to 1, into a new or an empty folder.

    overwrite: frames of an earlier export go, other files stay. Raises InputError where it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held = list(folder.iterdir())
    except OSError as error:
        raise InputError(f"{folder}: cannot be used as a folder ({error.strerror or error}).") from error
    if held and not overwrite:
        raise InputError(f"{folder}: is not empty; --overwrite replaces the frames in it.")
    old = [file for file in held if _FRAME.fullmatch(file.name)]
    if scene.path is not None and any(file.samefile(scene.path) for file in old):
        raise InputError(f"{folder}: holds the opened file under a frame's name; take another folder.")
    for file in old:
        file.unlink()
    digits = max(4, len(str(frames - 1)))
    with Progress(frames, "frames") as progress:
        for number, time in enumerate(np.linspace(0, 1, frames).tolist()):
            write_ply(folder / f"frame_{number:0{digits}}.ply", scene.playback.still(time))
            progress.step()
