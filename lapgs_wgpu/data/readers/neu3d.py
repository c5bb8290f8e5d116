"""Reader of the Neu3D (DyNeRF) format: synchronized cameras that do not move.

poses_bounds.npy holds a row of 17 numbers per camera: a 3x5 matrix [R, position, (height, width, focal length)] whose
R has the columns down, right and backward (LLFF), then nearest and furthest depth. camXX.mp4 or camXX/images/*.png hold
the frames, in the order of the rows. A cloud, points3D_downsample*.ply or points3D.ply, is optional.

The first camera is for testing, as in published work, and frame i of n has the time i / n.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.cloud import find_cloud, read_cloud
from lapgs_wgpu.data.frames import Capture, Frame, ImageSource, Reader
from lapgs_wgpu.data.images import SUFFIXES, ImageFile, check_image
from lapgs_wgpu.data.poses import world_to_camera
from lapgs_wgpu.data.readers.poses_bounds import POSES, PoseRow, read_rows
from lapgs_wgpu.data.timestamps import ImageName
from lapgs_wgpu.data.video_frames import Video, VideoFrame
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.listing import listed

CAMERA = re.compile(r"cam(\d{1,4})")
CLOUDS = ("points3D_downsample*.ply", "points3D.ply")


def _matches(folder: Path) -> bool:
    return (folder / POSES).is_file() and not (folder / "images").is_dir()  # EndoNeRF's


def _read(folder: Path, image_size: int | None) -> Capture:
    path = folder / POSES
    recordings = _recordings(folder)
    rows = read_rows(path, [recording.name for recording in recordings], "recordings")
    names = [recording.stem for recording in recordings]
    warnings = []
    if names != sorted(names):
        odd = next(i for i, name in enumerate(sorted(names)) if name != names[i])
        warnings.append(
            f"{path}: its rows are taken in the order of the cameras' numbers, so row {odd} is of {names[odd]}; if "
            f"they are in the order of the names, in which it is of {sorted(names)[odd]}, number the cameras with "
            "leading zeros."
        )
    (first, images), *others = recordings.items()
    for other, found in others:
        if len(found) != len(images):
            raise InputError(
                f"{other} has {len(found)} frames and {first} has {len(images)}; all cameras must have as many."
            )
    frames = [
        Frame(
            image,
            row.lens,
            T_cam_world,
            row.where,
            ImageName(f"{recording.stem}/{_file_name(image, index)}", recording.stem),
            time=index,
            split="train" if camera else "test",
            label=f"{recording.stem}_{index:05d}",
            depths=row.depths,
        )
        for camera, ((recording, found), row, T_cam_world) in enumerate(
            zip(recordings.items(), rows, map(_pose, rows), strict=True)
        )
        for index, image in enumerate(found)
    ]
    cloud = find_cloud(folder, CLOUDS)
    return Capture(
        frames,
        None if cloud is None else read_cloud(cloud),
        source=cloud or path,
        warnings=warnings,
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
    files = [file for file in listed(folder / "images") if file.suffix.lower() in SUFFIXES]
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


def _pose(row: PoseRow) -> NDArray[np.float64]:
    """(4, 4) pose in OpenCV's axes."""
    down, right, back = row.R.T  # LLFF's order
    return world_to_camera(np.stack([right, down, -back], axis=1), row.position)


READER = Reader("Neu3D", "poses_bounds.npy beside cam00.mp4, ... or cam00/images/, ...", _matches, _read)
