"""Reader of the layout of Dynamic 3D Gaussians: CMU Panoptic's calibrated cameras, which stand still and film together.

docs/data.md lists the fields. Source: Luiten et al., Dynamic 3D Gaussians (3DV 2024).
"""

from pathlib import Path, PurePosixPath

import numpy as np

from lapgs_wgpu.data.capture_files import CaptureFiles
from lapgs_wgpu.data.frames import Capture, Frame, Reader, Split
from lapgs_wgpu.data.images import Size
from lapgs_wgpu.data.json_fields import LARGEST_INTRINSIC, Fields, read_json
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.poses import check_rotation, place_of, world_to_camera
from lapgs_wgpu.data.stamps import ImageName
from lapgs_wgpu.errors import InputError, shown

IMAGES = "ims"
FIELDS = ("fn", "k", "w2c", "cam_id")  # of each time, lists over the cameras
FILES: dict[Split, str] = {"train": "train_meta.json", "test": "test_meta.json"}


def _read(folder: Path, image_size: int | None) -> Capture:
    """Frames are in the order of splits, times and cameras."""
    frames, warnings = [], list[str]()
    files = {split: read_json(folder / name) for split, name in FILES.items()}
    for split, data in files.items():
        images, size, count = CaptureFiles(folder / IMAGES), (data.side("w"), data.side("h")), 0
        for time, cameras in enumerate(data.table("time", *FIELDS)):
            for entry in cameras.table("image", *FIELDS):
                count += 1
                if named := images.image(entry, "fn"):
                    file, image = named
                    T = entry.matrix("w2c", 4, 4)
                    check_rotation(T[:3, :3], f"{entry.where}: w2c")
                    lens, pose = _lens(entry, size), world_to_camera(T[:3, :3].T, place_of(T))
                    name = ImageName(file, str(PurePosixPath(file).parent))
                    label = f"cam{shown(entry.values['cam_id'])}_{time:05d}"
                    frames.append(Frame(image, lens, pose, entry.where, name, time, split, label))
        warnings += images.left_out(count, folder / FILES[split])
    source = folder / FILES["train"]
    time_source = f"the order of the lists in {source}"
    return Capture(frames, source, warnings=warnings, time_source=time_source, shares_cameras=True)


def _lens(entry: Fields, size: Size) -> Lens:
    K = entry.matrix("k", 3, 3)
    if not ((np.diag(K)[:2] > 0).all() and (np.abs(K) <= LARGEST_INTRINSIC).all()):
        raise InputError(f"{entry.where}: k must hold focal lengths from 0 to {LARGEST_INTRINSIC:g} pixels.")
    if np.abs(K[[1, 2, 2, 2], [0, 0, 1, 2]] - [0, 0, 0, 1]).max() > 0:
        raise InputError(f"{entry.where}: k must be the rows fx s cx, 0 fy cy, 0 0 1.")
    return Lens(*size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1])


LAYOUT = "train_meta.json and test_meta.json beside ims/"
READERS = (Reader("Panoptic", LAYOUT, lambda folder: (folder / FILES["train"]).is_file(), _read),)
