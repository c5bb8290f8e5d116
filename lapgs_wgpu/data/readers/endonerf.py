"""Reader of EndoNeRF's layout: one camera that stands still before something that moves, such as an endoscope.

poses_bounds.npy holds a row for each image in images/: a 3x5 matrix [R, position, (height, width, focal length)], then
nearest and furthest depth. It is camera to world; R's columns are right, down and forward, as EndoNeRF's successors
read it; in published scenes R is the identity and the position 0. depth/ is optional: PNG of 8 or 16 bits, depths along
the optical axis in the units of the bounds, 0 where unknown. masks/ (tools) are not read.

Images 1, 9, 17, ... are for testing, as in published work. Without depth/ nothing in the files tells any depth.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.frames import Capture, Frame, Reader
from lapgs_wgpu.data.images import ERRORS, SUFFIXES, check_image, decode, size_text
from lapgs_wgpu.data.poses import world_to_camera
from lapgs_wgpu.data.readers.poses_bounds import POSES, read_rows
from lapgs_wgpu.data.timestamps import ImageName, natural_key
from lapgs_wgpu.data.undistort import Lens
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.listing import listed

IMAGES, DEPTH = "images", "depth"
EVERY, FIRST = 8, 1  # images that are tested
MAPS = 8  # depth maps that make the cloud, evenly chosen over the clip
MOST_POINTS = 40_000  # of the cloud
LARGEST_MAP = 64_000_000  # pixels
EXPECT = (
    "one camera that stands still sees no parallax, so {depth}; what the camera sees will be right, and views from "
    "elsewhere the worse the further away they are"
)
AXES = (
    "{count} poses, whose axes are read as right, down and forward, as EndoNeRF's scenes have them; those of an LLFF "
    "capture are down, right and backward, so convert it to COLMAP's or nerfstudio's format"
)


def _matches(folder: Path) -> bool:
    return (folder / POSES).is_file() and (folder / IMAGES).is_dir()


def _read(folder: Path, image_size: int | None) -> Capture:
    path = folder / POSES
    found = (file for file in listed(folder / IMAGES) if file.suffix.lower() in SUFFIXES)
    images = [check_image(file) for file in sorted(found, key=lambda file: natural_key(file.name))]
    if not images:
        raise InputError(f"{folder / IMAGES} holds no images (.png or .jpg); extract the camera's frames into it.")
    lenses: dict[bytes, Lens] = {}
    poses: dict[bytes, NDArray[np.float64]] = {}
    frames = []
    rows = read_rows(path, [image.path.name for image in images], "images")
    for index, (row, image) in enumerate(zip(rows, images, strict=True)):
        T_cam_world = world_to_camera(row.R, row.position)  # right, down and forward are OpenCV's axes
        frames.append(
            Frame(
                image,
                lenses.setdefault(row.lens.K.tobytes(), row.lens),
                poses.setdefault(T_cam_world.tobytes(), T_cam_world),
                row.where,
                ImageName(image.path.name),
                time=index,
                split="test" if index % EVERY == FIRST else "train",
                depths=row.depths,
            )
        )
    cloud = _cloud(folder, frames)
    told = f"depths are those of {folder / DEPTH}" if cloud is not None else "depths are a guess between the bounds"
    return Capture(
        frames,
        cloud,
        source=path if cloud is None else folder / DEPTH,
        time_source=f"the order of the images in {folder / IMAGES}",
        warnings=[f"{folder}: {EXPECT.format(depth=told) if len(poses) == 1 else AXES.format(count=len(poses))}."],
    )


def _cloud(folder: Path, frames: list[Frame]) -> Cloud | None:
    """Points at the depths of some of the maps, in their images' colors; None without maps."""
    if not (folder / DEPTH).is_dir():
        return None
    found = (file for file in listed(folder / DEPTH) if file.suffix == ".png")
    maps = sorted(found, key=lambda file: natural_key(file.name))
    if len(maps) != len(frames):
        raise InputError(
            f"{folder / DEPTH} holds {len(maps)} depth maps (.png) for {len(frames)} images; each image needs one, or "
            "remove the folder."
        )
    chosen = evenly(list(zip(frames, maps, strict=True)), MAPS)
    random, points, colors = np.random.default_rng(0), [], []
    for frame, path in chosen:
        depth, image = _depth_map(path), decode(folder / IMAGES / frame.name.file)[..., :3]
        if depth.shape != image.shape[:2]:
            raise InputError(
                f"{path} is {size_text(depth.shape[::-1])} pixels, and its image is "
                f"{size_text(image.shape[1::-1])}; a depth map needs the size of its image."
            )
        row, column = np.nonzero(depth > 0)
        kept = random.permutation(len(row))[: MOST_POINTS // len(chosen)]
        row, column = row[kept], column[kept]
        K = frame.lens.resized(image.shape[1], image.shape[0]).K
        pixels = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=1)
        rays = pixels @ np.linalg.inv(K).T
        R, t = frame.T_cam_world[:3, :3], frame.T_cam_world[:3, 3]
        points.append((depth[row, column, None] * rays - t) @ R)
        colors.append(image[row, column] / 255)
    if not sum(map(len, points)):
        raise InputError(f"{folder / DEPTH}: all depths are 0, which means unknown; remove the folder.")
    return Cloud(np.concatenate(points).astype(np.float32), np.concatenate(colors).astype(np.float32))


def _depth_map(path: Path) -> NDArray[np.float64]:
    """(H, W) depths. Raises InputError."""
    try:
        with Image.open(path, formats=("PNG",)) as file:
            if file.width * file.height > LARGEST_MAP or file.mode not in ("L", "I", "I;16", "I;16B"):
                raise InputError(
                    f"{path} is a PNG of {size_text(file.size)} pixels of mode {file.mode}; a depth map is gray, of 8 "
                    "or 16 bits."
                )
            return np.asarray(file).astype(np.float64)
    except InputError:
        raise
    except ERRORS as error:
        raise InputError(f"{path} is not a readable depth map ({error}); export it again, or remove depth/.") from None


READER = Reader("EndoNeRF", "poses_bounds.npy beside images/", _matches, _read)
