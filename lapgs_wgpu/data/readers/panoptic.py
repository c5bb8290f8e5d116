"""Reader of the layout of Dynamic 3D Gaussians: CMU Panoptic's calibrated cameras, which stand still and film together.

docs/data.md lists the fields. Source: Luiten et al., Dynamic 3D Gaussians (3DV 2024).
"""

from pathlib import Path, PurePosixPath

import numpy as np

from lapgs_wgpu.data.capture_files import CaptureFiles
from lapgs_wgpu.data.frames import Capture, Frame, Reader, Split
from lapgs_wgpu.data.json_fields import LARGEST_INTRINSIC, Fields, matrix, read_json
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.poses import check_rotation, place_of, world_to_camera
from lapgs_wgpu.data.stamps import ImageName
from lapgs_wgpu.errors import InputError, shown

IMAGES = "ims"
FILES: dict[Split, str] = {"train": "train_meta.json", "test": "test_meta.json"}


def _read(folder: Path, image_size: int | None) -> Capture:
    train, test = (read_json(folder / name) for name in FILES.values())
    warnings: list[str] = []
    frames = [*_read_split(folder, train, "train", warnings), *_read_split(folder, test, "test", warnings)]
    return Capture(
        frames,
        source=folder / FILES["train"],
        warnings=warnings,
        time_source=f"the order of the lists in {folder / FILES['train']}",
        shares_cameras=True,
    )


def _read_split(folder: Path, data: Fields, split: Split, warnings: list[str]) -> list[Frame]:
    """Read the frames of one file, by time, then camera. Appends a warning about images that do not exist."""
    width, height = data.side("w"), data.side("h")
    times = len(data.entries("fn"))
    columns = {name: data.entries(name, times) for name in ("fn", "k", "w2c", "cam_id")}
    images = CaptureFiles(folder / IMAGES)
    frames, count = [], 0
    for time in range(times):
        here = Fields({name: column[time] for name, column in columns.items()}, f"{data.where}, time {time}")
        names = here.entries("fn")
        others = [here.entries(name, len(names)) for name in ("k", "w2c", "cam_id")]
        for file, k, w2c, camera in zip(names, *others, strict=True):
            count += 1
            where = f"{here.where}, image {shown(file)}"
            if (named := images.image(Fields({"fn": file}, here.where), "fn")) is None:
                continue
            found, image = named
            T = matrix(w2c, (4, 4), "w2c", where)
            check_rotation(T[:3, :3], f"{where}: w2c")
            lens, pose = _lens(k, width, height, where), world_to_camera(T[:3, :3].T, place_of(T))
            name = ImageName(found, str(PurePosixPath(found).parent))
            label = f"cam{shown(camera)}_{time:05d}"
            frames.append(Frame(image, lens, pose, where, name, time=time, split=split, label=label))
    warnings += images.left_out(count, folder / FILES[split])
    return frames


def _lens(k: object, width: int, height: int, where: str) -> Lens:
    K = matrix(k, (3, 3), "k", where)
    if not ((np.diag(K)[:2] > 0).all() and (np.abs(K) <= LARGEST_INTRINSIC).all()):
        raise InputError(f"{where}: k must hold focal lengths from 0 to {LARGEST_INTRINSIC:g} pixels.")
    if np.abs(K[[1, 2, 2, 2], [0, 0, 1, 2]] - [0, 0, 0, 1]).max() > 0:
        raise InputError(f"{where}: k must be the rows fx s cx, 0 fy cy, 0 0 1.")
    return Lens(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1])


LAYOUT = "train_meta.json and test_meta.json beside ims/"
READERS = (Reader("Panoptic", LAYOUT, lambda folder: (folder / FILES["train"]).is_file(), _read),)
