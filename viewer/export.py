"""Files for other viewers: stills as plain .ply in Inria's layout, one or a sequence; a compact scene; a web page."""

import dataclasses
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.ply import write_ply
from lapgs_wgpu.motion.compact_scene import held_rows
from lapgs_wgpu.motion.playback.playback import DevicePlayback, playback_of
from lapgs_wgpu.motion.scene_file import compact_bytes, read_compact, read_scene
from lapgs_wgpu.progress import counted
from lapgs_wgpu.viewer.export_4dgs import export_4dgs
from lapgs_wgpu.viewer.export_loss import Loss, measure
from lapgs_wgpu.viewer.export_usd import export_usd
from lapgs_wgpu.viewer.loaded_scene import LoadedScene, given_scene, nearest_axis
from lapgs_wgpu.viewer.moving_files import MANIFEST, SampledPlayback, read_sequence
from lapgs_wgpu.viewer.offscreen import OffscreenRenderer
from lapgs_wgpu.viewer.options import USD
from lapgs_wgpu.viewer.web_page import page_html


def write_export(given: Any, device: Callable[[], Device]) -> None:
    """Write the file, or the folder, that the options of lapgs-view ask for, and print what it lost."""
    scene = given_scene(given, device)
    file, overwrite = Path(given.export), bool(given.overwrite)
    ending = file.suffix.lower()
    if ending in (".4dgs", ".lapgs", ".html", ".ply", *USD):
        check_free(scene, file, overwrite)
    if ending == ".4dgs":
        loss = export_4dgs(scene, file, given.max_error or 0.5)
    elif ending in USD:
        loss = export_usd(scene, file, given.frames)
    elif ending in (".lapgs", ".html"):
        loss = export_compact(scene, file)
    elif ending == ".ply":
        loss = export_still(scene, file, given.time or 0.0)
    else:
        loss = export_frames(scene, file, given.frames, overwrite=overwrite)
    size = f", {file.stat().st_size / 1e6:.2f} MB" if file.is_file() else ""
    print(f"{file}: {scene.playback.count} Gaussians{size}, {loss.psnr:.1f} dB PSNR against {scene.path}")
    if loss.reason:
        print(f"warning: the loss is seen: {loss.reason}.", file=sys.stderr)


def check_free(scene: LoadedScene, file: Path, overwrite: bool) -> None:
    """Raises InputError where a file must not be written: over the opened one, or another without `overwrite`."""
    if file.exists() and file.samefile(scene.path):
        raise InputError(f"{file}: is the opened file; take another name.")
    if file.exists() and not overwrite:
        raise InputError(f"{file}: is there already; --overwrite replaces it.")


def export_still(scene: LoadedScene, file: Path, time: float) -> Loss:
    """Write the Gaussians at a time in [0, 1], and compare the file with the scene. Atomic. Raises InputError."""
    write_ply(file, scene.playback.snapshot(time), antialiased=scene.playback.at(time).antialiased)
    return measure(scene, playback_of(read_scene(file), scene.playback.device), time=time)


def export_frames(scene: LoadedScene, folder: Path, frames: int, *, overwrite: bool = False) -> Loss:
    """Write a still frame_0000.ply for each of the times evenly from 0 to 1, and their manifest, and compare them with
    the scene.

    overwrite: frames of an earlier export go, other files stay; without it the folder must be new or empty. Raises
    InputError where it is not, and OSError where it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    held = list(folder.iterdir())
    if held and not overwrite:
        raise InputError(f"{folder}: is not empty; --overwrite replaces the frames in it.")
    old = [file for file in held if file.match("frame_*.ply") or file.name == MANIFEST]
    for file in old:
        check_free(scene, file, overwrite)
    for file in old:
        file.unlink()
    names = [f"frame_{number:04}.ply" for number in range(frames)]
    antialiased = scene.playback.at(0.0).antialiased
    for name, time in zip(counted(names, frames, "frames"), np.linspace(0, 1, frames).tolist(), strict=True):
        write_ply(folder / name, scene.playback.snapshot(time), antialiased=antialiased)
    manifest = {
        "fps": max(1, frames - 1) / scene.clock().seconds,  # so that they last as long as the clip
        "up": nearest_axis(scene.initial_view.up),
        "antialiased": antialiased,
        "view": scene.initial_view._replace(frames=frames).to_json(),
        "frames": names,
    }
    with atomic_write(folder / MANIFEST) as target:
        target.write(json.dumps(manifest, indent=1).encode())
    written = SampledPlayback(scene.playback.device, read_sequence(folder / MANIFEST))
    return measure(scene, written, frames=frames)


def export_compact(scene: LoadedScene, file: Path) -> Loss:
    """Write a compact scene (.lapgs), or a web page with one inside (.html), and compare it with the scene. Atomic.

    Its steps are finer where the usual ones lose what may be seen. Raises InputError where it cannot be written, and
    where only torch evaluates the field.
    """
    if scene.file is None:
        raise InputError(f"{scene.path}: holds no field of lapgs_wgpu; --export a folder, a .ply, .usd or .4dgs.")
    with atomic_write(file) as target:  # before a minute of work
        metadata = scene.file.metadata | {"view": scene.initial_view.to_json()}
        opened = dataclasses.replace(scene.file, metadata=metadata)
        features = scene.playback.static_features() if isinstance(scene.playback, DevicePlayback) else None
        rows = held_rows(opened.gaussians["opacity_logits"], opened.field_config)
        best, loss = b"", Loss(-np.inf, "")
        for finer in (1.0, 1 / 8, 1 / 64, 1 / 512):  # factors of the largest errors
            content = compact_bytes(opened, features, finer=finer)
            written = playback_of(read_compact(content, opened.path), scene.playback.device)
            found = measure(scene, written, rows)
            if found.psnr > loss.psnr + 1:
                best, loss = content, found
            if found.psnr >= 45.0:  # trained scenes have some 55 in the usual steps
                break
        if file.suffix.lower() == ".html":
            poster = OffscreenRenderer(scene)(scene.camera().camera(960, 540), 0.0)
            best = page_html(best, file.stem, poster, narrowest=scene.initial_view.narrowest).encode()
        target.write(best)
    return loss
