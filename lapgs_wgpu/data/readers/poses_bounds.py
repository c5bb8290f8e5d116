"""Readers of captures with LLFF's poses_bounds.npy: Neu3D (DyNeRF), and EndoNeRF. docs/data.md lists the files.

A row of 17 numbers holds a 3x5 matrix [R, position, (height, width, focal length)], then nearest and furthest depth.
The pose is camera to world. R has the columns down, right and backward (LLFF); EndoNeRF's right, down and forward, as
its successors read it. In both, what is for testing follows published work.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lapgs_wgpu.data.cloud import Cloud, find_cloud, points_at, read_cloud, read_npy
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.frames import Capture, Frame, Reader, Split
from lapgs_wgpu.data.images import SUFFIXES, ImageFile, check_image, decode, decode_gray, size_text
from lapgs_wgpu.data.json_fields import LARGEST_SIDE, number
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.poses import check_rotation, world_to_camera
from lapgs_wgpu.data.stamps import ImageName, natural_key
from lapgs_wgpu.data.video_frames import unpacked
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.listing import listed
from lapgs_wgpu.splat.camera import Array, Camera

POSES = "poses_bounds.npy"
CAMERA = re.compile(r"cam(\d{1,4})")
CLOUDS = ("points3D_downsample*.ply", "points3D.ply")
IMAGES, DEPTH = "images", "depth"
EVERY, FIRST = 8, 1  # images of EndoNeRF that are tested
MAPS = 8  # depth maps that make the cloud, evenly chosen over the clip
MOST_POINTS = 40_000  # of the cloud
STILL = (
    "one camera that stands still sees no parallax, so {depth}; what the camera sees will be right, and views from "
    "elsewhere the worse the further away they are"
)
MOVING = (
    "{count} poses, whose axes are read as right, down and forward, as EndoNeRF's scenes have them; those of an LLFF "
    "capture are down, right and backward, so convert it to COLMAP's or nerfstudio's format"
)
LLFF = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # from down, right and backward to right, down and forward


def _read_rows(path: Path, names: Sequence[str], what: str, axes: Array) -> list[dict[str, Any]]:
    """Read what a row tells of a frame, as arguments of `Frame`, for each of the names, in their order.

    names: at least one, of `what`, such as "images". axes: (3, 3), from the columns of R to right, down and forward.
    Raises InputError: the file is not readable, has another number of rows, or one of them is no camera.
    """
    rows = read_npy(path).astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise InputError(f"{path} must hold (poses, 17) numbers, got {rows.shape}; write it with LLFF's imgs2poses.py.")
    if len(rows) != len(names):
        raise InputError(
            f"{path} holds {len(rows)} poses, but there are {len(names)} {what}, {names[0]} to {names[-1]}; each of "
            "them needs a row, in this order."
        )
    found: list[dict[str, Any]] = []
    for i, (row, name) in enumerate(zip(rows, names, strict=True)):
        where = f"{path}, row {i} ({name})"
        for column, value in enumerate(row.tolist()):
            number(value, f"column {column}", where)
        pose, (near, far) = row[:15].reshape(3, 5), row[15:].tolist()
        height, width, f = pose[:, 4].tolist()
        if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE and f > 0):
            raise InputError(f"{where}: height, width, focal length must be above 0, got {height:g}, {width:g}, {f:g}.")
        if not 0 < near < far:
            raise InputError(f"{where}: the depth bounds must be 0 < near < far, got {near:g} and {far:g}.")
        check_rotation(pose[:, :3], f"{where}: the pose")
        lens = Lens(round(width), round(height), f, f, width / 2, height / 2)
        T_cam_world = world_to_camera(pose[:, :3] @ axes, pose[:, 3])
        found.append({"lens": lens, "T_cam_world": T_cam_world, "where": where, "depths": (near, far)})
    return found


# Neu3D


def _read_neu3d(folder: Path, image_size: int | None) -> Capture:
    path = folder / POSES
    recordings = _recordings(folder, image_size)
    rows = _read_rows(path, [recording.name for recording in recordings], "recordings", LLFF)
    names, warnings = [recording.stem for recording in recordings], []
    if names != sorted(names):
        warnings.append(
            f"{path}: its rows are taken in the order of the cameras' numbers, {', '.join(names)}; if they are in that "
            "of the names, number the cameras with leading zeros."
        )
    first, *others = recordings
    count = len(recordings[first])
    for other in others:
        if len(recordings[other]) != count:
            raise InputError(
                f"{other} has {len(recordings[other])} frames and {first} has {count}; cut all to the same frames."
            )
    frames = []
    for (recording, images), row in zip(recordings.items(), rows, strict=True):
        camera = recording.stem
        split: Split = "test" if recording is first else "train"
        for index, image in enumerate(images):
            # Masks of a film's frames are named by their numbers from 0 on.
            name = ImageName(f"{camera}/{f'{index}.png' if image.source else image.path.name}", camera)
            frames.append(Frame(image, name=name, time=index, split=split, label=f"{camera}_{index:05d}", **row))
    cloud = find_cloud(folder, CLOUDS)
    return Capture(
        frames,
        cloud=None if cloud is None else read_cloud(cloud),
        source=cloud or path,
        warnings=warnings,
        time_source=f"the number of frames in {others[0]}",
        time_range=(0.0, float(count)),
        shares_cameras=True,
    )


def _recordings(folder: Path, image_size: int | None) -> dict[Path, list[ImageFile]]:
    """Return the frames of each camera, by its number: its images if all cameras have them, else those of its film."""
    children = sorted((c for c in folder.iterdir() if CAMERA.fullmatch(c.stem)), key=lambda c: natural_key(c.stem))
    films = [child for child in children if child.suffix.lower() == ".mp4"]
    folders = [child for child in children if (child / IMAGES).is_dir()]
    cameras = {child.stem for child in (*films, *folders)}
    if len(folders) == len(cameras) >= 2:
        return {path: _images(path / IMAGES) for path in folders}
    if len(films) == len(cameras) >= 2:
        return {path: unpacked(path, image_size) for path in films}
    raise InputError(
        f"{folder} holds films of {len(films)} cameras and images of {len(folders)}; it needs cam00.mp4, ... or "
        "cam00/images/*.png, ... of all, and of 2 at least: one for testing, one for training."
    )


def _images(folder: Path, *, whole: bool = False) -> list[ImageFile]:
    """The images of a folder, by number. whole: of `check_image`; a rig's may be gigabytes. Raises InputError."""
    files = sorted((f for f in listed(folder) if f.suffix.lower() in SUFFIXES), key=lambda f: natural_key(f.name))
    if not files:
        raise InputError(f"{folder} holds no images (.png or .jpg); extract the camera's frames into it.")
    return [check_image(file, whole=whole) for file in files]


# EndoNeRF


def _read_endonerf(folder: Path, image_size: int | None) -> Capture:
    path = folder / POSES
    images = _images(folder / IMAGES, whole=True)
    names = [image.path.name for image in images]
    rows = _read_rows(path, names, "images", np.eye(3))
    frames = []
    for index, (image, name, row) in enumerate(zip(images, names, rows, strict=True)):
        split: Split = "test" if index % EVERY == FIRST else "train"
        frames.append(Frame(image, name=ImageName(name), time=index, split=split, **row))
    cloud = _depth_cloud(folder, frames) if (folder / DEPTH).is_dir() else None
    depth = f"depths are those of {folder / DEPTH}" if cloud is not None else "depths are a guess between the bounds"
    poses = len({frame.T_cam_world.tobytes() for frame in frames})
    return Capture(
        frames,
        cloud=cloud,
        source=path if cloud is None else folder / DEPTH,
        time_source=f"the order of the images in {folder / IMAGES}",
        warnings=[f"{folder}: {STILL.format(depth=depth) if poses == 1 else MOVING.format(count=poses)}."],
        shares_cameras=True,
    )


def _depth_cloud(folder: Path, frames: list[Frame]) -> Cloud:
    """Make points at the depths of some of the maps, in their images' colors. Raises InputError."""
    maps = [image.path for image in _images(folder / DEPTH)]
    if len(maps) != len(frames):
        raise InputError(f"{folder / DEPTH} has {len(maps)} maps for {len(frames)} images; add the rest, or remove it.")
    chosen = evenly(list(zip(frames, maps, strict=True)), MAPS)
    random, points, colors = np.random.default_rng(0), [], []
    for frame, path in chosen:
        depth, image = decode_gray(path).astype(np.float64), decode(folder / IMAGES / frame.name.file)[..., :3]
        if depth.shape != image.shape[:2]:
            raise InputError(
                f"{path} is {size_text(depth.shape[::-1])} pixels, and its image is "
                f"{size_text(image.shape[1::-1])}; a depth map needs the size of its image."
            )
        row, column = np.nonzero(depth > 0)
        kept = random.permutation(len(row))[: MOST_POINTS // len(chosen)]
        row, column = row[kept], column[kept]
        height, width = depth.shape
        camera = Camera(frame.lens.resized(width, height).K, frame.T_cam_world, width, height)
        points.append(points_at(camera, np.column_stack([column + 0.5, row + 0.5]), depth[row, column]))
        colors.append(image[row, column] / 255)
    if not sum(map(len, points)):
        raise InputError(f"{folder / DEPTH}: all depths are 0, which means unknown; remove the folder.")
    return Cloud(np.concatenate(points).astype(np.float32), np.concatenate(colors).astype(np.float32))


FILMS = f"{POSES} beside cam00.mp4, ... or cam00/images/, ..."
ALONE = f"{POSES} beside images/"
READERS = (
    Reader("Neu3D", FILMS, lambda f: (f / POSES).is_file() and not (f / IMAGES).is_dir(), _read_neu3d),
    Reader("EndoNeRF", ALONE, lambda f: (f / POSES).is_file() and (f / IMAGES).is_dir(), _read_endonerf),
)
