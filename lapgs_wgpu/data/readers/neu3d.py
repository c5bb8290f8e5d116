"""Reader of the Neu3D (DyNeRF) format: synchronized cameras that do not move.

poses_bounds.npy holds a row of 17 numbers per camera: a 3x5 matrix [R, position, (height, width, focal length)] whose
R has the columns down, right and backward (LLFF), then nearest and furthest depth. camXX.mp4 or camXX/images/*.png hold
the frames, in the order of the rows. A cloud, points3D_downsample*.ply or points3D.ply, is optional.

The first camera is for testing, as in published work, and frame i of n has the time i / n.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.cloud import find_cloud, read_cloud, read_npy
from lapgs_wgpu.data.frames import Capture, Frame, ImageSource, Reader
from lapgs_wgpu.data.images import SUFFIXES, ImageFile, check_image
from lapgs_wgpu.data.poses import LARGEST_ENTRY, check_rotation, world_to_camera
from lapgs_wgpu.data.timestamps import ImageName
from lapgs_wgpu.data.undistort import Lens
from lapgs_wgpu.data.video_frames import Video, VideoFrame
from lapgs_wgpu.errors import InputError

CAMERA = re.compile(r"cam(\d{1,4})")
CLOUDS = ("points3D_downsample*.ply", "points3D.ply")


class _Pose(NamedTuple):
    """One row of poses_bounds.npy. T_cam_world: (4, 4), OpenCV axes. depths: nearest and furthest."""

    lens: Lens
    T_cam_world: NDArray[np.float64]
    depths: tuple[float, float]
    where: str


def _matches(folder: Path) -> bool:
    return (folder / "poses_bounds.npy").is_file() and not (folder / "images").is_dir()  # EndoNeRF's


def _read(folder: Path, image_size: int | None) -> Capture:
    path = folder / "poses_bounds.npy"
    recordings = _recordings(folder)
    poses = _read_poses(path, list(recordings))
    (first, images), *others = recordings.items()
    for other, found in others:
        if len(found) != len(images):
            raise InputError(
                f"{other} has {len(found)} frames and {first} has {len(images)}; all cameras must have as many."
            )
    frames = [
        Frame(
            image,
            pose.lens,
            pose.T_cam_world,
            pose.where,
            ImageName(f"{recording.stem}/{_file_name(image, index)}", recording.stem),
            time=index,
            split="train" if camera else "test",
            label=f"{recording.stem}_{index:05d}",
            depths=pose.depths,
        )
        for camera, ((recording, found), pose) in enumerate(zip(recordings.items(), poses, strict=True))
        for index, image in enumerate(found)
    ]
    cloud = find_cloud(folder, CLOUDS)
    return Capture(
        frames,
        None if cloud is None else read_cloud(cloud),
        source=cloud or path,
        time_source=f"the number of frames in {others[0][0]}",
        time_range=(0.0, float(len(images))),
    )


def _recordings(folder: Path) -> dict[Path, list[ImageSource]]:
    """The frames of each camera, by its number. Images take precedence over a video of the same camera."""
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
            "least 2 are needed: one for testing, one for training."
        )
    names = sorted(found, key=lambda name: int(name.removeprefix("cam")))
    return {found[name]: _images(found[name]) if found[name].is_dir() else _video(found[name]) for name in names}


def _file_name(image: ImageSource, index: int) -> str:
    """Of an image; of a film's frame, its number from 0 on, which masks are named by."""
    return image.path.name if isinstance(image, ImageFile) else f"{index}.png"


def _video(path: Path) -> list[ImageSource]:
    video = Video(path)
    return [VideoFrame(video, index) for index in range(video.frames)]


def _images(folder: Path) -> list[ImageSource]:
    """The images in camXX/images in the order of their numbers: 2.png comes before 10.png."""
    files = [file for file in (folder / "images").iterdir() if file.suffix.lower() in SUFFIXES]
    if not files:
        raise InputError(f"{folder / 'images'} holds no images (.png or .jpg); extract the camera's frames into it.")
    numbers: dict[int, Path] = {}
    for file in files:
        digits = re.findall(r"\d+", file.stem)
        number = int(digits[-1]) if digits else -1
        if number < 0 or number in numbers:
            why = "has no number" if number < 0 else f"has the number {number}, as {numbers[number].name}"
            raise InputError(f"{file} {why}; frames are put in order by the last number in their names.")
        numbers[number] = file
    return [check_image(numbers[number], whole=False) for number in sorted(numbers)]  # whole, they may be gigabytes


def _read_poses(path: Path, recordings: Sequence[Path]) -> list[_Pose]:
    """The pose of each recording."""
    rows = read_npy(path).astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise InputError(f"{path} must hold 17 numbers a camera, an array of (cameras, 17), got {rows.shape}.")
    if len(rows) != len(recordings):
        raise InputError(
            f"{path} holds the poses of {len(rows)} cameras, but there are {len(recordings)} recordings, "
            f"{recordings[0].name} to {recordings[-1].name}; they belong together in the order of their numbers."
        )
    poses = []
    for index, (row, recording) in enumerate(zip(rows, recordings, strict=True)):
        where = f"{path}, row {index} ({recording.name})"
        if not (np.abs(row) <= LARGEST_ENTRY).all():  # true for NaN, too
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
        lens, T_cam_world = Lens(K, round(width), round(height)), world_to_camera(R_world_cam, pose[:, 3])
        poses.append(_Pose(lens, T_cam_world, (float(near), float(far)), where))
    return poses


READER = Reader("Neu3D", "poses_bounds.npy beside cam00.mp4, ... or cam00/images/, ...", _matches, _read)
