"""Reader of EndoNeRF's layout: one camera that stands still before something that moves, such as an endoscope.

poses_bounds.npy (`poses_bounds`) holds a row for each image in images/; R's columns are right, down and forward, as
EndoNeRF's successors read it; in published scenes R is the identity and the position 0. depth/ is optional: PNG of 8 or
16 bits, depths along the optical axis in the units of the bounds, 0 where unknown. masks/ (tools) are not read.

Images 1, 9, 17, ... are for testing, as in published work. Without depth/ nothing in the files tells any depth.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lapgs_wgpu.data.cloud import Cloud
from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.frames import Capture, Frame, Reader
from lapgs_wgpu.data.images import SUFFIXES, check_image, decode, decode_gray, size_text
from lapgs_wgpu.data.poses import world_to_camera
from lapgs_wgpu.data.readers.poses_bounds import POSES, read_rows
from lapgs_wgpu.data.stamps import ImageName
from lapgs_wgpu.data.timestamps import natural_key
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.listing import listed

IMAGES, DEPTH = "images", "depth"
EVERY, FIRST = 8, 1  # images that are tested
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


def _matches(folder: Path) -> bool:
    return (folder / POSES).is_file() and (folder / IMAGES).is_dir()


def _read(folder: Path, image_size: int | None) -> Capture:
    path = folder / POSES
    images = [check_image(file) for file in _listed(folder / IMAGES, SUFFIXES)]
    if not images:
        raise InputError(f"{folder / IMAGES} holds no images (.png or .jpg); extract the camera's frames into it.")
    rows = read_rows(path, [image.path.name for image in images], "images")
    frames = [
        Frame(
            image,
            row.lens,
            world_to_camera(row.R, row.position),  # right, down and forward are OpenCV's axes
            row.where,
            ImageName(image.path.name),
            time=index,
            split="test" if index % EVERY == FIRST else "train",
            depths=row.depths,
        )
        for index, (row, image) in enumerate(zip(rows, images, strict=True))
    ]
    cloud = _cloud(folder, frames) if (folder / DEPTH).is_dir() else None
    depth = f"depths are those of {folder / DEPTH}" if cloud is not None else "depths are a guess between the bounds"
    poses = len({frame.T_cam_world.tobytes() for frame in frames})
    return Capture(
        frames,
        cloud,
        source=path if cloud is None else folder / DEPTH,
        time_source=f"the order of the images in {folder / IMAGES}",
        warnings=[f"{folder}: {STILL.format(depth=depth) if poses == 1 else MOVING.format(count=poses)}."],
        shares_cameras=True,
    )


def _listed(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """The files of these types in a folder, by number."""
    files = (file for file in listed(folder) if file.suffix.lower() in suffixes)
    return sorted(files, key=lambda file: natural_key(file.name))


def _cloud(folder: Path, frames: list[Frame]) -> Cloud:
    """Make points at the depths of some of the maps, in their images' colors. Raises InputError."""
    maps = _listed(folder / DEPTH, (".png",))
    if len(maps) != len(frames):
        raise InputError(
            f"{folder / DEPTH} holds {len(maps)} depth maps (.png) for {len(frames)} images; each image needs one, or "
            "remove the folder."
        )
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
        pixels = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=1)
        rays = pixels @ np.linalg.inv(frame.lens.resized(image.shape[1], image.shape[0]).K).T
        R, t = frame.T_cam_world[:3, :3], frame.T_cam_world[:3, 3]
        points.append((depth[row, column, None] * rays - t) @ R)
        colors.append(image[row, column] / 255)
    if not sum(map(len, points)):
        raise InputError(f"{folder / DEPTH}: all depths are 0, which means unknown; remove the folder.")
    return Cloud(np.concatenate(points).astype(np.float32), np.concatenate(colors).astype(np.float32))


READER = Reader("EndoNeRF", "poses_bounds.npy beside images/", _matches, _read)
