"""Reader of the HyperNeRF format, the layout of nerfies.

scene.json, dataset.json, metadata.json, camera/ID.json and rgb/Nx/ID.png; optional are points.npy, points3D*.ply and
covisible/Nx/val/ID.png. docs/data.md lists the fields. Cameras and points are returned in the coordinates of
scene.json: (p - center) scale.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lapgs_wgpu.data.cloud import find_cloud, read_cloud
from lapgs_wgpu.data.covisible import factor_folders, find_covisible
from lapgs_wgpu.data.frames import Capture, Frame, Reader, Split
from lapgs_wgpu.data.images import check_image
from lapgs_wgpu.data.json_fields import finite, kind, read_json, required, vector
from lapgs_wgpu.data.normalize import Normalization
from lapgs_wgpu.data.poses import LARGEST_ENTRY, check_rotation, world_to_camera
from lapgs_wgpu.data.timestamps import ImageName
from lapgs_wgpu.data.undistort import Lens
from lapgs_wgpu.errors import InputError

NEEDED = "which a capture in nerfies' layout needs"
CLOUDS = ("points.npy", "points3D_downsample*.ply", "points3D.ply")  # all in the coordinates of the camera files
STRIDE = 4  # without val_ids: every fourth id from the first on is for training, from the third on for testing


def _matches(folder: Path) -> bool:
    return (folder / "dataset.json").is_file()


def _read(folder: Path, image_size: int | None) -> Capture:
    """Images come from the folder rgb/Nx with the smallest that are at least of the wanted size, else the largest."""
    ids, train_ids, test_ids = _splits(folder / "dataset.json")
    scene_json = folder / "scene.json"
    scene = _object(scene_json, "scale and center")
    scale = _positive(scene, "scale", scene_json)
    moved = Normalization(vector(required(scene, "center", scene_json, NEEDED), 3, "center", scene_json), scale)
    depths = _positive(scene, "near", scene_json), _positive(scene, "far", scene_json)
    if depths[0] >= depths[1]:
        raise InputError(f"{scene_json}: near must be below far, got {depths[0]:g} and {depths[1]:g}.")
    times = _times(folder / "metadata.json", ids)
    cameras = {name: _read_camera(folder / "camera" / f"{name}.json") for name in train_ids + test_ids}
    rgb = _image_folder(folder / "rgb", train_ids + test_ids, image_size)
    masks = find_covisible(folder / "covisible", test_ids, rgb.name)
    splits: list[tuple[Split, list[str]]] = [("train", train_ids), ("test", test_ids)]
    frames = [
        Frame(
            check_image(rgb / f"{name}.png"),
            cameras[name][0],
            moved.pose(cameras[name][1]),
            f"{folder / 'camera' / name}.json (image_size, focal_length, radial_distortion, tangential_distortion)",
            ImageName(name),
            time=times[name],
            split=split,
            label=f"{index:03d}",
            depths=depths,
            mask=masks.get(name),
        )
        for split, names in splits
        for index, name in enumerate(names)
    ]
    cloud = find_cloud(folder, CLOUDS)
    return Capture(
        frames,
        None if cloud is None else moved.cloud(read_cloud(cloud)),
        source=cloud or scene_json,
        time_source=f"time_id (else warp_id) in {folder / 'metadata.json'}",
        time_range=(min(times.values()), max(times.values())),
        moved=moved,
    )


def _splits(path: Path) -> tuple[list[str], list[str], list[str]]:
    """All ids, and those to train on and to test on."""
    data = _object(path, "ids")
    ids = _names(required(data, "ids", path, NEEDED), "ids", path)
    test = _names(data.get("val_ids") or [], "val_ids", path)
    if test:
        train = _names(required(data, "train_ids", path, NEEDED), "train_ids", path)
        both = [name for name in train if name in set(test)]
        if both:
            raise InputError(
                f"{path}: {len(both)} of {len(test)} val_ids are train_ids, too, such as {both[0]}; no test image "
                "may be trained on."
            )
    else:  # "interp": the frames between
        train, test = ids[::STRIDE], ids[STRIDE // 2 :: STRIDE]
    if not train or not test:
        raise InputError(f"{path}: {len(train)} train_ids and {len(test)} test ids; at least one of each is needed.")
    known = set(ids)
    for field, names in (("train_ids", train), ("val_ids", test)):
        for name in names:
            if name not in known:
                raise InputError(f"{path}: {field} names {name}, which is not among its {len(ids)} ids.")
    return ids, train, test


def _times(path: Path, ids: Sequence[str]) -> dict[str, int]:
    """The time_id or warp_id of each id."""
    metadata = _object(path, "an entry for each id")
    entries = {}
    for name in ids:
        entries[name] = entry = required(metadata, name, path, "though dataset.json names it")
        if not isinstance(entry, dict):
            raise InputError(f"{path}: {name} must be a JSON object, got {kind(entry)}.")
    field = "time_id" if any("time_id" in entry for entry in entries.values()) else "warp_id"
    values = {}
    with_it = sum(field in entry for entry in entries.values())
    for name, entry in entries.items():
        hint = f"though {with_it} of {len(entries)} entries have it" if with_it else NEEDED
        value = required(entry, field, f"{path}: {name}", hint)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= LARGEST_ENTRY:
            raise InputError(f"{path}: {field} of {name} must be a whole number from 0 up, got {kind(value)}.")
        values[name] = value
    return values


def _read_camera(path: Path) -> tuple[Lens, np.ndarray]:
    """A camera file: the lens at image_size and the pose, in the file's coordinates."""
    data = _object(path, "orientation, position and focal_length")

    def field(name: str) -> Any:
        return required(data, name, path, NEEDED)

    rows = field("orientation")
    if not isinstance(rows, list) or len(rows) != 3:
        raise InputError(f"{path}: orientation must be 3 rows of 3 numbers, got {kind(rows)}.")
    R_cam_world = np.stack([vector(row, 3, "orientation", path) for row in rows])
    check_rotation(R_cam_world.T, f"{path}: orientation")
    position = vector(field("position"), 3, "position", path)
    if np.abs(position).max() > LARGEST_ENTRY:
        raise InputError(f"{path}: position holds {np.abs(position).max():g}; at most {LARGEST_ENTRY:g} is allowed.")
    width, height = (int(side) for side in vector(field("image_size"), 2, "image_size", path))
    if not (1 <= width <= 1e5 and 1 <= height <= 1e5):
        raise InputError(f"{path}: image_size must be 1 to 100000 pixels a side, got {width}x{height}.")
    focal = _positive(data, "focal_length", path)
    aspect = _positive(data, "pixel_aspect_ratio", path, default=1.0)
    cx, cy = vector(field("principal_point"), 2, "principal_point", path)
    skew = finite(data.get("skew", 0.0), "skew", path)
    K = np.array([[focal, skew, cx], [0, focal * aspect, cy], [0, 0, 1]])
    radial = vector(data.get("radial_distortion", [0.0] * 3), 3, "radial_distortion", path)
    # nerfies has written the second name, and its first releases the first one.
    tangential_name = "tangential" if "tangential" in data else "tangential_distortion"
    tangential = vector(data.get(tangential_name, [0.0] * 2), 2, tangential_name, path)
    lens = Lens(K, width, height, tuple(radial.tolist()), tuple(tangential.tolist()))
    return lens, world_to_camera(R_cam_world.T, position)


def _image_folder(rgb: Path, names: Sequence[str], image_size: int | None) -> Path:
    """The folder rgb/Nx that suits the wanted size best, which holds the images of all names."""
    folders = factor_folders(rgb)
    if not folders:
        raise InputError(f"{rgb} holds no folder 1x, 2x, ... of images, {NEEDED}.")
    best: Path | None = None
    for folder in folders:  # from the largest images on
        first = folder / f"{names[0]}.png"
        if first.is_file():
            longer = max(check_image(first, whole=False).size)
            if best is None or (image_size is not None and longer >= image_size):
                best = folder
    if best is None:
        raise InputError(f"{folders[0] / names[0]}.png does not exist, but dataset.json names {names[0]}.")
    for name in names:
        if not (best / f"{name}.png").is_file():
            raise InputError(f"{best / name}.png does not exist, but dataset.json names {name}.")
    return best


def _object(path: Path, needs: str) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"{path} does not exist; a capture in nerfies' layout needs it.")
    return read_json(path, needs)


def _names(value: Any, field: str, path: Path) -> list[str]:
    """A list of ids, each of which is safe as a file name."""
    if not isinstance(value, list):
        raise InputError(f"{path}: {field} must be a list of ids, got {kind(value)}.")
    for name in value:
        if not isinstance(name, str) or not re.fullmatch(r"\w[\w.-]{0,99}", name):
            raise InputError(f"{path}: {field} holds {kind(name)}, which is no id (letters, digits and . _ - only).")
    if len(set(value)) < len(value):
        raise InputError(f"{path}: {field} holds {len(value)} ids of which {len(set(value))} differ; name each once.")
    return value


def _positive(data: dict[str, Any], name: str, path: Path, default: float | None = None) -> float:
    value = required(data, name, path, NEEDED) if default is None else data.get(name, default)
    got = finite(value, name, path)
    if not 0 < got <= LARGEST_ENTRY:
        raise InputError(f"{path}: {name} must be above 0 and at most {LARGEST_ENTRY:g}, got {got:g}.")
    return got


READER = Reader("HyperNeRF", "dataset.json beside camera/ and rgb/", _matches, _read)
