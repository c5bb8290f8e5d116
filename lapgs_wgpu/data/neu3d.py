"""Captures in the layout of Neu3D (DyNeRF): still cameras that film together, poses_bounds.npy beside camXX.mp4 or
camXX/images/*.png.

docs/data.md says what each file holds and what is done with it. Everything but the pixels is checked at opening.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.cloud import check_cloud, find_cloud, points_in_view, read_cloud, read_npy
from lapgs_wgpu.data.pictures import (
    PICTURE_SUFFIXES,
    check_picture,
    check_proportions,
    read_picture,
    shrunk,
)
from lapgs_wgpu.data.pictures import text as size_text
from lapgs_wgpu.data.poses import LARGEST_ENTRY, check_focal, check_rotation, fitting, world_to_camera
from lapgs_wgpu.data.video import Video
from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

CAMERA = re.compile(r"cam(\d{1,4})")
CLOUDS = ("points3D_downsample*.ply", "points3D.ply")
PROBES = 4096  # points that decide where a capture without a cloud is put


class _Recording(NamedTuple):
    """What one camera filmed. path: the video, or the folder of pictures. read: of a frame, at (width, height)."""

    path: Path
    frames: int
    size: tuple[int, int]
    read: Callable[[int, tuple[int, int]], NDArray[np.uint8]]
    source: Callable[[int], str]


def is_neu3d(folder: str | Path) -> bool:
    """Whether a folder looks like a capture in Neu3D's layout."""
    return (Path(folder) / "poses_bounds.npy").is_file()


def load_neu3d(folder: str | Path, *, image_size: int | None = None) -> Dataset:
    """Open a capture in Neu3D's layout; frames are decoded later, view by view.

    image_size: longer side in pixels to which frames are shrunk; None keeps them as they are.
    The first camera by number is held out for testing, all others are trained on; frame i of n has the time i / n.
    Cameras and points are moved and scaled together so that what is filmed fills the cube that the presets expect
    (`poses.fitting`). Raises InputError, naming file and field.
    """
    folder = Path(folder)
    path = folder / "poses_bounds.npy"
    recordings = _recordings(folder)
    cameras, bounds = _read_poses(path, [recording.path for recording in recordings])
    first = recordings[0]
    for recording in recordings[1:]:
        for what, ours, theirs in (
            ("frames", recording.frames, first.frames),
            ("pixels", size_text(recording.size), size_text(first.size)),
        ):
            if ours != theirs:
                raise InputError(
                    f"{recording.path} has {ours} {what} and {first.path} has {theirs}; all cameras must have as many."
                )
    size = shrunk(first.size, image_size)
    for camera in cameras:
        check_proportions(first.size, (camera.width, camera.height), first.path, f"{path}")
    cameras = [camera.resized(*size) for camera in cameras]

    near, far = float(bounds[1:, 0].min()), float(np.median(bounds[1:, 1]))
    source = find_cloud(folder, CLOUDS)
    cloud = None if source is None else read_cloud(source)
    if cloud is not None and source is not None:
        check_cloud(cloud, cameras[1:], source)
        placement = fitting(cloud.points.astype(np.float64))
    else:
        placement = fitting(points_in_view(cameras[1:], near, far, PROBES, 0))
    cameras = [placement.camera(camera) for camera in cameras]

    def views(split: str, first: int, last: int) -> tuple[View, ...]:
        return tuple(
            View(
                name=f"{split}_{recordings[index].path.stem}_{frame:05d}",
                camera=cameras[index],
                time=frame / recordings[index].frames,
                source=recordings[index].source(frame),
                pixels=partial(recordings[index].read, frame, size),
            )
            for index in range(first, last)
            for frame in range(recordings[index].frames)
        )

    return Dataset(
        folder.resolve().name,
        views("train", 1, len(cameras)),
        views("test", 0, 1),
        cloud=None if cloud is None else cloud.moved(placement),
        depths=(near * placement.scale, far * placement.scale),
        placement=placement,
        time_source=f"the number of frames in {recordings[1].path}",
    )


def _recordings(folder: Path) -> list[_Recording]:
    """What the cameras filmed, by their number. Pictures go before a video of the same camera."""
    found: dict[str, Path] = {}
    for child in sorted(folder.iterdir()):
        if child.suffix.lower() == ".mp4" and CAMERA.fullmatch(child.stem):
            found.setdefault(child.stem, child)
    for child in sorted(folder.iterdir()):
        if CAMERA.fullmatch(child.name) and (child / "images").is_dir():
            found[child.name] = child
    if len(found) < 2:
        raise InputError(
            f"{folder} holds the recordings of {len(found)} cameras, cam00.mp4, ... or cam00/images/*.png, ...; at "
            "least 2 are needed: one to test on, one to train on."
        )
    names = sorted(found, key=lambda name: int(name.removeprefix("cam")))
    return [_pictures(found[name]) if found[name].is_dir() else _video(found[name]) for name in names]


def _video(path: Path) -> _Recording:
    video = Video(path)
    return _Recording(path, video.frames, video.size, video.read, lambda frame: f"{path}, frame {frame}")


def _pictures(folder: Path) -> _Recording:
    """The pictures of a folder camXX/images in the order of their numbers: 2.png comes before 10.png."""
    files = [file for file in (folder / "images").iterdir() if file.suffix.lower() in PICTURE_SUFFIXES]
    if not files:
        raise InputError(f"{folder / 'images'} holds no pictures (.png or .jpg); extract the camera's frames into it.")
    numbers: dict[int, Path] = {}
    for file in files:
        digits = re.findall(r"\d+", file.stem)
        number = int(digits[-1]) if digits else -1
        if number < 0 or number in numbers:
            why = "has no number" if number < 0 else f"has the number {number}, as {numbers[number].name}"
            raise InputError(f"{file} {why}; frames are put in order by the last number in their names.")
        numbers[number] = file
    ordered = [numbers[number] for number in sorted(numbers)]
    size = check_picture(ordered[0], whole=False)  # all of them may be gigabytes
    return _Recording(
        folder,
        len(ordered),
        size,
        lambda frame, size: read_picture(ordered[frame], size),
        lambda frame: str(ordered[frame]),
    )


def _read_poses(path: Path, recordings: list[Path]) -> tuple[list[Camera], NDArray[np.float64]]:
    """A camera a row, at the size that the row says, in OpenCV's axes; and the rows' nearest and furthest depths."""
    rows = read_npy(path).astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise InputError(f"{path} must hold 17 numbers a camera, an array of (cameras, 17), got {rows.shape}.")
    if len(rows) != len(recordings):
        raise InputError(
            f"{path} holds the poses of {len(rows)} cameras, but there are {len(recordings)} recordings, "
            f"{recordings[0].name} to {recordings[-1].name}; they belong together in the order of their numbers."
        )
    cameras = []
    for index, (row, recording) in enumerate(zip(rows, recordings, strict=True)):
        where = f"{path}, row {index} ({recording.name})"
        if not (np.abs(row) <= LARGEST_ENTRY).all():  # so written, NaN is bad too
            column = int(np.argmin(np.abs(row) <= LARGEST_ENTRY))
            raise InputError(f"{where} holds {row[column]:g} in column {column}; it must be at most {LARGEST_ENTRY:g}.")
        pose, (near, far) = row[:15].reshape(3, 5), row[15:]
        height, width, focal = pose[:, 4]
        if not (1 <= width <= 1e5 and 1 <= height <= 1e5 and focal > 0):
            raise InputError(
                f"{where}: height, width and focal length must be positive pixels, "
                f"got {height:g}, {width:g} and {focal:g}."
            )
        if not 0 < near < far:
            raise InputError(f"{where}: the depth bounds must be 0 < near < far, got {near:g} and {far:g}.")
        down, right, back = pose[:, :3].T  # LLFF's order
        R_world_cam = np.stack([right, down, -back], axis=1)
        check_rotation(R_world_cam, f"{where}: the pose")
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        cameras.append(Camera(K, world_to_camera(R_world_cam, pose[:, 3]), round(width), round(height)))
        check_focal(cameras[-1], where)
    return cameras, rows[:, 15:]
