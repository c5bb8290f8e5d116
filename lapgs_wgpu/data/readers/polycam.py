"""Reader of Polycam's raw data: keyframes/ with a JSON file for each image, as its developer mode exports it.

Polycam's optimizer writes corrected_cameras/ (and, where it removes a distortion, corrected_images/), which are
preferred to cameras/ and images/. A camera file holds t_00 ... t_23 (camera to world by rows, ARKit's axes, which are
OpenGL's, in meters), `fx`, `fy`, `cx`, `cy`, `width`, `height` in pixels, and `timestamp`, which is also the name of
the file. Depth maps and the mesh are not read.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lapgs_wgpu.data.frames import Capture, Frame, Reader
from lapgs_wgpu.data.images import SUFFIXES, check_image
from lapgs_wgpu.data.json_fields import finite, read_json, required
from lapgs_wgpu.data.poses import opengl_pose
from lapgs_wgpu.data.timestamps import ImageName, natural_key
from lapgs_wgpu.data.undistort import Lens
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.listing import listed

NEEDED = "which raw data of Polycam need"
AXES = "t_00 ... t_23 must be camera to world in ARKit's axes (y up, z backward)"
INTRINSICS = ("width", "height", "fx", "fy", "cx", "cy")
LARGEST = 1e6  # of the intrinsics, pixels
LARGEST_SIDE = 1e5


def _first(folder: Path, names: tuple[str, str]) -> Path | None:
    return next((folder / "keyframes" / name for name in names if (folder / "keyframes" / name).is_dir()), None)


def _cameras(folder: Path) -> Path | None:
    return _first(folder, ("corrected_cameras", "cameras"))


def _matches(folder: Path) -> bool:
    return _cameras(folder) is not None


def _read(folder: Path, image_size: int | None) -> Capture:
    cameras, images = _cameras(folder), _first(folder, ("corrected_images", "images"))
    assert cameras is not None
    if images is None:
        raise InputError(f"{folder / 'keyframes'} has no images/; export raw data from Polycam again.")
    files = {file.stem: file for file in listed(images) if file.suffix.lower() in SUFFIXES}
    found = (file for file in listed(cameras) if file.suffix == ".json")
    described = sorted(found, key=lambda file: natural_key(file.stem))
    if not described:
        raise InputError(f"{cameras} holds no camera (.json); export raw data from Polycam again.")
    lenses: dict[tuple[float, ...], Lens] = {}
    frames: list[Frame] = []
    times: list[float] = []
    for path in described:
        if path.stem not in files:
            raise InputError(f"{images / path.stem}.jpg does not exist, but {path} describes its camera.")
        data = read_json(path, "t_00, ... and fx")
        rows = [[required(data, f"t_{i}{j}", path, NEEDED) for j in range(4)] for i in range(3)]
        values = tuple(finite(required(data, name, path, NEEDED), name, path) for name in INTRINSICS)
        width, height, fx, fy, cx, cy = values
        if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE) or max(map(abs, values)) > LARGEST:
            raise InputError(f"{path}: {', '.join(INTRINSICS)} must be in pixels, got {', '.join(map(str, values))}.")
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        lens = lenses.setdefault(values, Lens(K, round(width), round(height)))
        pose = opengl_pose([*rows, [0.0, 0.0, 0.0, 1.0]], str(path))
        times.append(finite(required(data, "timestamp", path, NEEDED), "timestamp", path))
        file = files[path.stem]
        frames.append(Frame(check_image(file), lens, pose, str(path), ImageName(file.name), times[-1]))
    left = len(files) - len(frames)
    return Capture(
        frames,
        None,
        source=cameras,
        time_source=f"timestamp in {cameras}",
        warnings=[f"{left} of {len(files)} images in {images} have no camera and are left out."] if left else [],
        own_footage=True,
        axes_hint=AXES,
    )


READER = Reader("Polycam", "keyframes/cameras/*.json", _matches, _read)
