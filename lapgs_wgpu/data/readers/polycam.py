"""Reader of Polycam's raw data: keyframes/ with a JSON file for each image, as its developer mode exports it.

Polycam's optimizer writes corrected_cameras/ (and, where it removes a distortion, corrected_images/), which are
preferred to cameras/ and images/. A camera file holds t_00 ... t_23 (camera to world by rows, ARKit's axes, which are
OpenGL's, in meters), `fx`, `fy`, `cx`, `cy`, `width`, `height` in pixels, and `timestamp`, which is also the name of
the file. Depth maps and the mesh are not read.
"""

from __future__ import annotations

from pathlib import Path

from lapgs_wgpu.data.frames import Capture, Frame, Reader
from lapgs_wgpu.data.images import SUFFIXES, check_image
from lapgs_wgpu.data.json_fields import LARGEST_INTRINSIC, absent_image, read_json
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.poses import opengl_pose
from lapgs_wgpu.data.stamps import ImageName
from lapgs_wgpu.data.timestamps import natural_key
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.listing import listed


def _subfolder(folder: Path, name: str) -> Path:
    """Return keyframes/corrected_NAME where it exists, else keyframes/NAME."""
    corrected = folder / "keyframes" / f"corrected_{name}"
    return corrected if corrected.is_dir() else folder / "keyframes" / name


def _matches(folder: Path) -> bool:
    return _subfolder(folder, "cameras").is_dir()


def _read(folder: Path, image_size: int | None) -> Capture:
    cameras, images = _subfolder(folder, "cameras"), _subfolder(folder, "images")
    if not images.is_dir():
        raise InputError(f"{images} does not exist; export raw data from Polycam again.")
    files = {file.stem: file for file in listed(images) if file.suffix.lower() in SUFFIXES}
    described = sorted((file for file in listed(cameras) if file.suffix == ".json"), key=lambda f: natural_key(f.stem))
    if not described:
        raise InputError(f"{cameras} holds no camera (.json); export raw data from Polycam again.")
    frames = []
    for path in described:
        if path.stem not in files:
            raise absent_image(images / f"{path.stem}.jpg", f"{path} describes its camera")
        data = read_json(path)
        fx, fy, cx, cy = (data.number(k, -LARGEST_INTRINSIC, LARGEST_INTRINSIC) for k in ("fx", "fy", "cx", "cy"))
        rows = [[data.required(f"t_{i}{j}") for j in range(4)] for i in range(3)]
        frames.append(
            Frame(
                check_image(files[path.stem]),
                Lens(data.side("width"), data.side("height"), fx, fy, cx, cy),
                opengl_pose([*rows, [0.0, 0.0, 0.0, 1.0]], str(path)),
                str(path),
                ImageName(files[path.stem].name),
                data.number("timestamp", -1e18, 1e18),
            )
        )
    left_out = len(files) - len(frames)
    return Capture(
        frames,
        None,
        source=cameras,
        time_source=f"timestamp in {cameras}",
        warnings=[f"{left_out} of {len(files)} images in {images} have no camera and are left out."]
        if left_out
        else [],
        own_footage=True,
    )


READER = Reader("Polycam", "keyframes/cameras/*.json", _matches, _read)
