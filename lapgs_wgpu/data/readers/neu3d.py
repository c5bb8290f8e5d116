"""Reader of the Neu3D (DyNeRF) format: synchronized cameras that do not move.

poses_bounds.npy (`poses_bounds`) holds a row for each camera; R has the columns down, right and backward (LLFF).
camXX.mp4 or camXX/images/*.png hold the frames, in the order of the rows. A cloud, points3D_downsample*.ply or
points3D.ply, is optional.

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
from lapgs_wgpu.data.stamps import ImageName
from lapgs_wgpu.data.timestamps import natural_key
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
    first, *others = recordings
    count = len(recordings[first])
    for other in others:
        if len(recordings[other]) != count:
            raise InputError(
                f"{other} has {len(recordings[other])} frames and {first} has {count}; all cameras must have as many."
            )
    frames = [
        Frame(
            image,
            row.lens,
            llff_pose(row),
            row.where,
            ImageName(f"{recording.stem}/{_file_name(image, index)}", recording.stem),
            time=index,
            split="test" if recording is first else "train",
            label=f"{recording.stem}_{index:05d}",
            depths=row.depths,
        )
        for (recording, images), row in zip(recordings.items(), rows, strict=True)
        for index, image in enumerate(images)
    ]
    cloud = find_cloud(folder, CLOUDS)
    return Capture(
        frames,
        None if cloud is None else read_cloud(cloud),
        source=cloud or path,
        warnings=warnings,
        time_source=f"the number of frames in {others[0]}",
        time_range=(0.0, float(count)),
        shares_cameras=True,
    )


def llff_pose(row: PoseRow) -> NDArray[np.float64]:
    """Return the (4, 4) pose in OpenCV's axes of a row in LLFF's."""
    down, right, back = row.R.T
    return world_to_camera(np.stack([right, down, -back], axis=1), row.position)


def _recordings(folder: Path) -> dict[Path, list[ImageSource]]:
    """Return the frames of each camera, by its number. Images take precedence over a video of the same camera."""
    videos = {child.stem: child for child in sorted(folder.iterdir()) if child.suffix.lower() == ".mp4"}
    folders = {child.name: child for child in sorted(folder.iterdir()) if (child / "images").is_dir()}
    recordings = {name: path for name, path in (videos | folders).items() if CAMERA.fullmatch(name)}
    if len(recordings) < 2:
        raise InputError(
            f"{folder} holds the recordings of {len(recordings)} cameras, cam00.mp4, ... or cam00/images/*.png, ...; "
            "at least 2 are needed: one for testing, one for training."
        )
    paths = sorted(recordings.values(), key=lambda path: natural_key(path.stem))
    return {path: _images(path) if path.is_dir() else _video(path) for path in paths}


def _file_name(image: ImageSource, index: int) -> str:
    """The name of an image; of a film's frame, its number from 0 on, which masks are named by."""
    return image.path.name if isinstance(image, ImageFile) else f"{index}.png"


def _video(path: Path) -> list[ImageSource]:
    video = Video(path)
    return [VideoFrame(video, index) for index in range(video.frames)]


def _images(folder: Path) -> list[ImageSource]:
    """Return the images in camXX/images in the order of their numbers: 2.png comes before 10.png."""
    files = [file for file in listed(folder / "images") if file.suffix.lower() in SUFFIXES]
    if not files:
        raise InputError(f"{folder / 'images'} holds no images (.png or .jpg); extract the camera's frames into it.")
    numbered: dict[int, Path] = {}
    for file in files:
        digits = re.findall(r"\d+", file.stem)
        if not digits or int(digits[-1]) in numbered:
            why = f"has the number {int(digits[-1])}, as another has" if digits else "has no number"
            raise InputError(f"{file} {why}; frames are put in order by the last number in their names.")
        numbered[int(digits[-1])] = file
    return [check_image(numbered[number], whole=False) for number in sorted(numbered)]  # whole, they may be gigabytes


READER = Reader("Neu3D", "poses_bounds.npy beside cam00.mp4, ... or cam00/images/, ...", _matches, _read)
