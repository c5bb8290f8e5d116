"""Scenes in the D-NeRF layout: transforms_train.json and transforms_test.json beside 8-bit PNG (or JPEG) pictures.

Everything that can be checked without decoding a picture is checked when the scene is opened, before any training.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.cloud import Cloud, check_cloud, find_cloud, read_cloud
from lapgs_wgpu.data.fields import check_inside, finite, kind, number, read_json, required
from lapgs_wgpu.data.objects import ObjectTruth, read_objects
from lapgs_wgpu.data.pictures import PICTURE_SUFFIXES, check_pictures, read_picture, shrunk
from lapgs_wgpu.data.poses import BOX, opengl_pose
from lapgs_wgpu.data.standard_box import cube_in_view, cube_of_cloud, is_random
from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

NEEDED = "which a D-NeRF scene needs"
LARGEST_INTRINSIC = 1e6  # pixels
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
CLOUDS = ("fused.ply", "points3d.ply", "points3D.ply")


class _Intrinsics(NamedTuple):
    """Focal lengths and principal point, in pixels of an image of size (w, h).

    Where a file leaves one out, fov_x (radians) gives the focal lengths, the centre is the principal point, and (w, h)
    is the size of the stored image."""

    fov_x: float | None
    fl_x: float | None
    fl_y: float | None
    cx: float | None
    cy: float | None
    w: float | None
    h: float | None

    def matrix(self, width: int, height: int) -> NDArray[np.float64]:
        """(3, 3) K of a stored image of width x height pixels."""
        across, down = width / (self.w or width), height / (self.h or height)
        if self.fl_x is not None:
            fx = self.fl_x * across
        else:
            assert self.fov_x is not None
            fx = 0.5 * width / math.tan(0.5 * self.fov_x)
        fy = fx if self.fl_y is None else self.fl_y * down
        cx = 0.5 * width if self.cx is None else self.cx * across
        cy = 0.5 * height if self.cy is None else self.cy * down
        return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


class _Frame(NamedTuple):
    picture: Path
    T_cam_world: NDArray[np.float64]
    time: float
    intrinsics: _Intrinsics


def is_dnerf(folder: str | Path) -> bool:
    """Whether a folder looks like a D-NeRF scene."""
    return any((Path(folder) / f"transforms_{split}.json").is_file() for split in ("train", "test"))


def load_dnerf(folder: str | Path, *, image_size: int | None = None, normalize: bool = True) -> Dataset:
    """Open a D-NeRF scene; pictures are decoded later, view by view.

    image_size: longer side in pixels to which pictures are shrunk by averaging; None keeps them as they are.
    The training views come from transforms_train.json alone and the test views from transforms_test.json alone;
    transforms_val.json is not read. Frames without `time` are taken as evenly spaced over the clip.
    objects.json, where there is one, says where moving objects are in the test views.
    normalize: move and scale a scene that does not fit the presets' cube (`standard_box`); False keeps its coordinates.
    fl_x, fl_y, cx, cy, of a frame or of the file, count more than camera_angle_x.
    Raises InputError, naming file, frame and field, where the scene cannot be trained on as it stands.
    """
    folder = Path(folder)
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "does not exist"
        raise InputError(f"{folder} {problem}; give the folder that holds transforms_train.json.")
    train, test = _read_split(folder, "train"), _read_split(folder, "test")

    stored = check_pictures([frame.picture for frame in train + test])
    size = shrunk(stored, image_size)

    def cameras(frames: list[_Frame]) -> list[Camera]:
        return [Camera(frame.intrinsics.matrix(*stored), frame.T_cam_world, *stored).resized(*size) for frame in frames]

    train_cameras, test_cameras = cameras(train), cameras(test)
    objects = read_objects(folder, "test", [frame.picture.stem for frame in test], test_cameras)
    cloud = _surfaces(folder, train_cameras)
    cube = cube_of_cloud(cloud) if cloud is not None else cube_in_view(train_cameras)
    warnings = []
    if cube is None:
        warnings.append(
            f"{folder / 'transforms_train.json'}: half or more of {len(train)} cameras look away from the point "
            "nearest to all lines of sight, so the size of the scene is unknown and it stays where it is: if that is "
            f"not [-{BOX:g}, {BOX:g}]^3, raise points.box and field.bound, or add a cloud ({CLOUDS[0]})."
        )
    placement = cube.placement if cube is not None and normalize else None
    if placement is not None:
        train_cameras = [placement.camera(camera) for camera in train_cameras]
        test_cameras = [placement.camera(camera) for camera in test_cameras]
        cloud = None if cloud is None else cloud.moved(placement)

    def views(
        split: str, cameras: list[Camera], frames: list[_Frame], truths: Sequence[Sequence[ObjectTruth]]
    ) -> tuple[View, ...]:
        return tuple(
            View(
                name=f"{split}_{index:03d}",
                camera=camera,
                time=frame.time,
                source=str(frame.picture),
                pixels=partial(read_picture, frame.picture, size),
                objects=tuple(objects),
            )
            for index, (frame, camera, objects) in enumerate(zip(frames, cameras, truths, strict=True))
        )

    return Dataset(
        folder.resolve().name,
        views("train", train_cameras, train, [()] * len(train)),
        views("test", test_cameras, test, objects),
        cloud=cloud,
        placement=placement,
        warnings=tuple(warnings),
        time_source=f"time in {folder / 'transforms_train.json'}",
    )


def _surfaces(folder: Path, cameras: list[Camera]) -> Cloud | None:
    """The cloud in the folder, in the cameras' coordinates; None without one. Raises InputError.

    A random cloud, as other trainers write it, says nothing about the scene: points, colours and extent are ignored.
    """
    path = find_cloud(folder, CLOUDS)
    cloud = None if path is None else read_cloud(path)
    if path is None or cloud is None or is_random(cloud):
        return None
    check_cloud(cloud, cameras, path)
    return cloud


def _read_split(folder: Path, split: str) -> list[_Frame]:
    """The frames of one transforms file."""
    path = folder / f"transforms_{split}.json"
    if not path.is_file():
        raise InputError(f"{path} does not exist; a D-NeRF scene needs transforms_train.json and transforms_test.json.")
    data = read_json(path, "camera_angle_x and frames")
    frames = required(data, "frames", path, NEEDED)
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames must be a list of at least one frame, got {kind(frames)}.")

    timed = sum(isinstance(frame, dict) and "time" in frame for frame in frames)
    parsed = []
    for index, frame in enumerate(frames):
        where = f"{path}, frame {index}"
        if not isinstance(frame, dict):
            raise InputError(f"{where} must be a JSON object, got {kind(frame)}.")
        file_path = required(frame, "file_path", where, NEEDED)
        if not isinstance(file_path, str) or not file_path:
            raise InputError(f"{where}: file_path must be the path of a picture, got {kind(file_path)}.")
        suffix = "" if file_path.lower().endswith(PICTURE_SUFFIXES) else ".png"
        check_inside(file_path, "file_path", where)
        picture = folder / (file_path + suffix)
        if not os.path.isfile(picture):  # Path.is_file raises where a name is too long
            raise InputError(f"{picture} does not exist, but {where} names it as its file_path.")
        T_cam_world = opengl_pose(required(frame, "transform_matrix", where, NEEDED), where)
        if timed == 0:
            time = index / max(len(frames) - 1, 1)
        else:
            hint = f"though {timed} of {len(frames)} frames have it; give it for all frames or for none"
            time = number(required(frame, "time", where, hint), "time", where)
            if not 0 <= time <= 1:
                raise InputError(f"{where}: time must lie in [0, 1], got {time:g}; divide by the clip's duration.")
        parsed.append(_Frame(picture, T_cam_world, time, _intrinsics(frame, data, where, path)))
    return parsed


def _intrinsics(frame: dict[str, Any], shared: dict[str, Any], where: str, path: Path) -> _Intrinsics:
    """A frame's own values, else those of the file, which itself is `shared`."""
    values: dict[str, float | None] = dict.fromkeys(_Intrinsics._fields)
    for name in (*_Intrinsics._fields[1:], *DISTORTION):
        source, at = (frame, where) if name in frame else (shared, str(path))
        if source.get(name) is None:
            continue
        got = finite(source[name], name, at)
        if name in DISTORTION:
            if got:
                raise InputError(
                    f"{at}: {name} is {got:g}, but images in the D-NeRF layout must have no lens distortion; undistort "
                    "them, or use nerfstudio's layout (transforms.json)."
                )
            continue
        positive = name not in ("cx", "cy")
        if abs(got) > LARGEST_INTRINSIC or (positive and got <= 0):
            raise InputError(f"{at}: {name} is {got:g}, which no camera has; it must be in pixels.")
        values[name] = got
    if values["fl_x"] is None:
        source, at = (frame, where) if "camera_angle_x" in frame else (shared, str(path))
        fov_x = number(required(source, "camera_angle_x", at, NEEDED), "camera_angle_x", at)
        if not 1e-6 < fov_x < math.pi:
            raise InputError(f"{at}: camera_angle_x must be an angle in radians between 0 and pi, got {fov_x:g}.")
        values["fov_x"] = fov_x
    return _Intrinsics(**values)
