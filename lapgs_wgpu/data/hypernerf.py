"""Captures in the layout of nerfies and HyperNeRF: scene, dataset and metadata.json, camera/, rgb/, points.npy; masks.

docs/data.md says what each file holds and what is done with it. Everything but the pixels is checked at opening.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lapgs_wgpu.data.cloud import check_cloud, find_cloud, points_in_view, read_cloud
from lapgs_wgpu.data.covisible import check_mask, find_masks, read_mask
from lapgs_wgpu.data.fields import finite, kind, read_json, required, vector
from lapgs_wgpu.data.lens import LARGEST_ZOOM, Lens, read_straight
from lapgs_wgpu.data.pictures import check_pictures, check_proportions, factor_folders, shrunk
from lapgs_wgpu.data.poses import LARGEST_ENTRY, Placement, check_focal, check_rotation, fitting, world_to_camera
from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

NEEDED = "which a capture in nerfies' layout needs"
CLOUDS = ("points.npy", "points3D_downsample*.ply", "points3D.ply")  # all in the coordinates of the camera files
STRIDE = 4  # without val_ids: every fourth id from the first on is trained on, every fourth from the third on tested
PROBES = 4096  # points that decide where a capture without a cloud is put


def is_hypernerf(folder: str | Path) -> bool:
    """Whether a folder looks like a capture in nerfies' layout."""
    return (Path(folder) / "dataset.json").is_file()


def load_hypernerf(folder: str | Path, *, image_size: int | None = None) -> Dataset:
    """Open a capture in nerfies' layout; pictures are decoded, and straightened, later, view by view.

    image_size: longer side in pixels. The pictures come from the folder rgb/Nx of the smallest ones that are at least
    so large, and are shrunk to it; None takes the largest there are.
    Cameras and points are moved and scaled together, as scene.json says and then so that the points fill the cube that
    the presets expect (`poses.fitting`). Raises InputError, naming file and field.
    """
    folder = Path(folder)
    ids, train_ids, test_ids = _splits(folder / "dataset.json")
    scene_json = folder / "scene.json"
    scene = _object(scene_json, "scale and center")
    scale = _positive(scene, "scale", scene_json)
    placement = Placement(vector(required(scene, "center", scene_json, NEEDED), 3, "center", scene_json), scale)
    depths = _positive(scene, "near", scene_json), _positive(scene, "far", scene_json)
    if depths[0] >= depths[1]:
        raise InputError(f"{scene_json}: near must be below far, got {depths[0]:g} and {depths[1]:g}.")
    times = _times(folder / "metadata.json", ids)

    used = train_ids + test_ids
    lenses, cameras = {}, {}
    for name in used:
        cameras[name], lenses[name] = _read_camera(folder / "camera" / f"{name}.json")
    rgb, stored = _picture_folder(folder / "rgb", used, image_size)
    size = shrunk(stored, image_size)
    masks = find_masks(folder / "covisible", test_ids, rgb.name)
    for name in used:
        camera, lens = cameras[name], lenses[name]
        taken = (camera.width, camera.height)
        field = f"image_size of {folder / 'camera' / name}.json"
        check_proportions(stored, taken, rgb / f"{name}.png", field)
        if name in masks:
            check_mask(masks[name], taken, field)
        resize = np.diag([stored[0] / taken[0], stored[1] / taken[1], 1.0])
        lenses[name] = Lens(resize @ lens.K, lens.radial, lens.tangential)
        K = lenses[name].pinhole(*stored)
        if K is None:
            raise InputError(
                f"{folder / 'camera' / name}.json: radial_distortion and tangential_distortion bend the picture so "
                f"much that enlarging it {LARGEST_ZOOM:g} times leaves gaps; check both."
            )
        cameras[name] = placement.camera(Camera(K, camera.T_cam_world, *stored))

    # Everything is in the coordinates of nerfies from here on; what is left is where the cube lies in them.
    source = find_cloud(folder, CLOUDS)
    cloud = None
    if source is not None:
        cloud = read_cloud(source).moved(placement)
        check_cloud(cloud, [cameras[name] for name in train_ids], source)
        fit = fitting(cloud.points.astype(np.float64))
    else:
        fit = fitting(points_in_view([cameras[name] for name in train_ids], depths[0], depths[1], PROBES, 0))

    def view(name: str, split: str, index: int) -> View:
        shape = (lenses[name], cameras[name].K, stored, size)
        return View(
            name=f"{split}_{index:03d}",
            camera=fit.camera(cameras[name]).resized(*size),
            time=times[name],
            source=str(rgb / f"{name}.png"),
            pixels=partial(read_straight, rgb / f"{name}.png", *shape),
            mask=partial(read_mask, masks[name], *shape) if name in masks else None,
        )

    return Dataset(
        folder.resolve().name,
        tuple(view(name, "train", index) for index, name in enumerate(train_ids)),
        tuple(view(name, "test", index) for index, name in enumerate(test_ids)),
        cloud=None if cloud is None else cloud.moved(fit),
        depths=(depths[0] * fit.scale, depths[1] * fit.scale),
        placement=placement.then(fit),
        time_source=f"time_id (else warp_id) in {folder / 'metadata.json'}",
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
                f"{path}: {len(both)} of {len(test)} val_ids are train_ids, too, such as {both[0]}; no test picture "
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


def _times(path: Path, ids: Sequence[str]) -> dict[str, float]:
    """Id -> time in [0, 1], the first frame of the capture at 0 and its last at 1."""
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
    first, last = min(values.values()), max(values.values())
    return {name: (value - first) / max(last - first, 1) for name, value in values.items()}


def _read_camera(path: Path) -> tuple[Camera, Lens]:
    """A camera file: the pinhole camera at image_size, in the file's coordinates, and its lens."""
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
    camera = Camera(K, world_to_camera(R_cam_world.T, position), width, height)
    check_focal(camera, f"{path}: focal_length")
    return camera, Lens(K, radial, tangential)


def _picture_folder(rgb: Path, names: Sequence[str], image_size: int | None) -> tuple[Path, tuple[int, int]]:
    """The folder rgb/Nx that suits the wanted size best, and the size of its pictures, all of which are there."""
    folders = factor_folders(rgb)
    if not folders:
        raise InputError(f"{rgb} holds no folder 1x, 2x, ... of pictures, {NEEDED}.")
    best: Path | None = None
    for folder in folders:  # from the largest pictures on
        first = folder / f"{names[0]}.png"
        if first.is_file():
            longer = max(check_pictures([first], whole=False))
            if best is None or (image_size is not None and longer >= image_size):
                best = folder
    if best is None:
        raise InputError(f"{folders[0] / names[0]}.png does not exist, but dataset.json names {names[0]}.")
    paths = [best / f"{name}.png" for name in names]
    for name, path in zip(names, paths, strict=True):
        if not path.is_file():
            raise InputError(f"{path} does not exist, but dataset.json names {name}.")
    return best, check_pictures(paths)


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
