"""Reader of the HyperNeRF format, the layout of nerfies.

docs/data.md lists the files. Cameras and points are returned in the coordinates of scene.json: (p - center) scale.
"""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lapgs_wgpu.data.capture_files import CaptureFiles
from lapgs_wgpu.data.cloud import find_cloud, read_cloud
from lapgs_wgpu.data.frames import Capture, Frame, Reader, Split
from lapgs_wgpu.data.images import check_image
from lapgs_wgpu.data.json_fields import LARGEST_SIDE, TINY, Fields, number, read_json
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.normalize import Normalization
from lapgs_wgpu.data.poses import check_rotation, world_to_camera
from lapgs_wgpu.data.stamps import ImageName
from lapgs_wgpu.errors import InputError, shown

CLOUDS = ("points.npy", "points3D_downsample*.ply", "points3D.ply")  # all in the coordinates of the camera files
STRIDE = 4  # without val_ids: every fourth id from the first on is for training, from the third on for testing
DEFAULTS = {"pixel_aspect_ratio": 1, "skew": 0, "radial_distortion": [0] * 3, "tangential_distortion": [0] * 2}


def _read(folder: Path, image_size: int | None) -> Capture:
    """Images come from the folder rgb/Nx with the smallest that are at least of the wanted size, else the largest."""
    ids, splits = _splits(read_json(folder / "dataset.json"))
    scene = read_json(folder / "scene.json")
    moved = Normalization(scene.matrix("center", 3), scene.number("scale", TINY))
    depths = scene.number("near", TINY), scene.number("far", TINY)
    if depths[0] >= depths[1]:
        raise InputError(f"{scene.where}: near must be below far, got {depths[0]:g} and {depths[1]:g}.")
    metadata = read_json(folder / "metadata.json")
    stated = {name: Fields(metadata.required(name), f"{metadata.where}: {name}") for name in ids}
    field = "time_id" if any("time_id" in entry for entry in stated.values()) else "warp_id"
    times = {name: int(entry.number(field, 0)) for name, entry in stated.items()}
    named = [name for names in splits.values() for name in names]
    rgb = _image_folder(folder / "rgb", named, image_size)
    files, frames = CaptureFiles(rgb), []
    for split, names in splits.items():
        for index, name in enumerate(names):
            if image := files.find_image(f"{name}.png", f"dataset.json names {name}"):
                camera = read_json(folder / "camera" / f"{name}.json")
                lens, pose = _read_camera(camera)
                where = f"{camera.where} (image_size, focal_length, radial_distortion, tangential_distortion)"
                taken = check_image(rgb / image), lens, moved.pose(pose), where, ImageName(name)
                frames.append(Frame(*taken, times[name], split, f"{index:03d}", depths))
    cloud = find_cloud(folder, CLOUDS)
    return Capture(
        frames,
        cloud=None if cloud is None else moved.cloud(read_cloud(cloud)),
        source=cloud or folder / "scene.json",
        time_source=f"time_id (else warp_id) in {folder / 'metadata.json'}",
        time_range=(min(times.values()), max(times.values())),
        warnings=files.left_out(len(named), folder / "dataset.json"),
        left_out=len(files.absent),
        moved=moved,
    )


def _splits(data: Fields) -> tuple[list[str], dict[Split, list[str]]]:
    """Return all ids, and those to train on and to test on."""
    ids = _names(data, "ids")
    if data.values.get("val_ids"):
        train, test = _names(data, "train_ids"), _names(data, "val_ids")
    else:  # "interp": the frames between
        train, test = ids[::STRIDE], ids[STRIDE // 2 :: STRIDE]
    if not test:
        raise InputError(f"{data.where}: {len(train)} train_ids and {len(test)} test ids; at least one of each.")
    if both := set(train) & set(test):
        raise InputError(
            f"{data.where}: {len(both)} of {len(test)} val_ids are train_ids, too, such as {min(both)}; no test image "
            "may be trained on: remove them from one of the two."
        )
    if unknown := {*train, *test} - {*ids}:
        raise InputError(f"{data.where}: train_ids or val_ids name {min(unknown)}, none of its {len(ids)} ids; add it.")
    return ids, {"train": train, "test": test}


def _read_camera(stated: Fields) -> tuple[Lens, np.ndarray]:
    """Return the lens and the pose of a camera file, in the file's coordinates."""
    data = Fields(DEFAULTS | stated.values, stated.where)
    R_cam_world = data.matrix("orientation", 3, 3)
    check_rotation(R_cam_world.T, f"{data.where}: orientation")
    sides = (number(side, "image_size", data.where, 1, LARGEST_SIDE) for side in data.entries("image_size", 2))
    width, height = map(int, sides)
    fx = data.number("focal_length", TINY)
    fy = fx * data.number("pixel_aspect_ratio", TINY)
    cx, cy = data.matrix("principal_point", 2).tolist()
    k1, k2, k3 = data.matrix("radial_distortion", 3).tolist()
    # nerfies has written the second name, and its first releases the first one.
    p1, p2 = data.matrix("tangential" if "tangential" in data else "tangential_distortion", 2).tolist()
    lens = Lens(width, height, fx, fy, cx, cy, data.number("skew"), (k1, k2, k3), (p1, p2))
    return lens, world_to_camera(R_cam_world.T, data.matrix("position", 3))


def _image_folder(rgb: Path, names: Sequence[str], image_size: int | None) -> Path:
    """Return the folder rgb/Nx, of images at 1 / N of their size, that suits the wanted size best."""
    best: Path | None = None
    folders = [child for child in rgb.glob("*x") if re.fullmatch(r"[1-9]\d{0,3}x", child.name)]
    for folder in sorted(folders, key=lambda child: int(child.name[:-1])):
        first = next((file for name in names if (file := folder / f"{name}.png").is_file()), None)
        if first is not None:
            longer = max(check_image(first, whole=False).size)
            if best is None or (image_size is not None and longer >= image_size):
                best = folder
    if best is None:
        raise InputError(f"{rgb} holds no folder 1x, 2x, ... with {names[0]}.png, which dataset.json names.")
    return best


def _names(data: Fields, field: str) -> list[str]:
    """Return a list of ids, each of which is safe as a file name."""
    names = data.entries(field)
    for name in names:
        if not isinstance(name, str) or not re.fullmatch(r"\w[\w.-]{0,99}", name):
            raise InputError(f"{data.where}: {field} holds {shown(name)}, no id (letters, digits and . _ - only).")
    if len(set(names)) < len(names):
        raise InputError(f"{data.where}: {field} holds {len(names)} ids, {len(set(names))} different; name each once.")
    return names


FILES = "dataset.json beside camera/ and rgb/"
READERS = (Reader("HyperNeRF", FILES, lambda folder: (folder / "dataset.json").is_file(), _read),)
