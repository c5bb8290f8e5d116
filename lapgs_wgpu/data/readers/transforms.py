"""What the D-NeRF and the nerfstudio formats share: a list of frames with optional times, and fields of intrinsics."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lapgs_wgpu.data.json_fields import finite, kind, number, required
from lapgs_wgpu.errors import InputError

MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
INTRINSICS = ("w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2")  # pixels of an image w x h
LARGEST = 1e6  # of them
LIMITS = {"w": (1, 1e5), "h": (1, 1e5), "fl_x": (1e-9, LARGEST), "fl_y": (1e-9, LARGEST)}


def frame_entries(
    data: dict[str, Any], path: Path, needed: str, field: str = "time"
) -> Iterator[tuple[dict[str, Any], str, float | None]]:
    """Yield the entry of each frame, its place for errors, and its time as stated; None if no frame has one.

    needed: reason for the field frames, for errors. field: that states the time. Raises InputError, also if only some
    frames have a time.
    """
    entries = required(data, "frames", path, needed)
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{path}: frames must be a list of at least one frame, got {kind(entries)}.")
    timed = sum(isinstance(entry, dict) and field in entry for entry in entries)
    hint = f"though {timed} of {len(entries)} frames have it; give it for all frames or for none"
    for index, entry in enumerate(entries):
        where = f"{path}, frame {index}"
        if not isinstance(entry, dict):
            raise InputError(f"{where} must be a JSON object, got {kind(entry)}.")
        yield entry, where, number(required(entry, field, where, hint), field, where) if timed else None


def intrinsics(entry: dict[str, Any], shared: dict[str, Any], where: str, path: Path) -> dict[str, float]:
    """The values of INTRINSICS that a frame states, or else its file. Raises InputError, also for other lens models."""
    model = entry.get("camera_model", shared.get("camera_model", "OPENCV"))
    if model not in MODELS:
        raise InputError(
            f"{where}: camera_model {kind(model)} is not among those that are read ({', '.join(MODELS)}); undistort "
            "the images first."
        )
    if entry.get("is_fisheye", shared.get("is_fisheye")):
        raise InputError(f"{where}: is_fisheye is set, and no lens of that kind is read; undistort the images first.")
    values: dict[str, float] = {}
    for name in INTRINSICS:
        source, at = (entry, where) if name in entry else (shared, str(path))
        if source.get(name) is None:
            continue
        value = values[name] = finite(source[name], name, at)
        least, most = LIMITS.get(name, (-LARGEST, LARGEST))
        if not least <= value <= most:
            raise InputError(f"{at}: {name} is {value:g}, which no camera has; it must be in pixels.")
    if values.get("k4"):
        raise InputError(
            f"{where}: k4 is {values['k4']:g}, and only k1, k2, k3, p1 and p2 are read; undistort the images."
        )
    return values
