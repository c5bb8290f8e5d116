"""Reader of the D-NeRF format.

transforms_train.json and transforms_test.json hold `camera_angle_x` (horizontal field of view, radians) or intrinsics
(`transforms`; those of a frame override those of the file, and both override the angle), and `frames`:
`file_path` of an image (.png is appended if it has no suffix), `transform_matrix` (camera to world, OpenGL axes) and
`time` in [0, 1], in all frames of a file or in none; frames without times are evenly spaced. transforms_val.json is
optional, and left out with a warning if it is not usable. A cloud is optional:
fused.ply, points3d.ply or points3D.ply.
"""

from __future__ import annotations

from pathlib import Path

from lapgs_wgpu.data.cloud import find_cloud, is_random, read_cloud
from lapgs_wgpu.data.frames import Capture, Frame, Reader, Split
from lapgs_wgpu.data.image_files import ImageFinder, check_absent
from lapgs_wgpu.data.images import check_image
from lapgs_wgpu.data.json_fields import image_path, read_json
from lapgs_wgpu.data.poses import opengl_pose
from lapgs_wgpu.data.readers.transforms import read_lens, timed_frames
from lapgs_wgpu.data.stamps import ImageName
from lapgs_wgpu.data.validation import check_frames
from lapgs_wgpu.errors import InputError

CLOUDS = ("fused.ply", "points3d.ply", "points3D.ply")


def _matches(folder: Path) -> bool:
    return any((folder / f"transforms_{split}.json").is_file() for split in ("train", "test"))


def _read(folder: Path, image_size: int | None) -> Capture:
    warnings: list[str] = []
    frames = [*_read_split(folder, "train", warnings), *_read_split(folder, "test", warnings)]
    if (folder / "transforms_val.json").is_file():
        try:
            validation = _read_split(folder, "val", warnings)
            check_frames([frames[0], *validation])
            frames += validation
        except InputError as error:
            warnings.append(f"the validation views are left out: {error}")
    path = find_cloud(folder, CLOUDS)
    cloud = None if path is None else read_cloud(path)
    if cloud is not None and is_random(cloud):  # other trainers write one, often of 1.3 whatever the scene's size
        cloud = None
    cameras = folder / "transforms_train.json"
    return Capture(
        frames,
        cloud,
        warnings=warnings,
        source=cameras if path is None or cloud is None else path,
        time_source=f"time in {cameras}",
        time_range=(0.0, 1.0),
        keeps_coordinates=True,
    )


def _read_split(folder: Path, split: Split, warnings: list[str]) -> list[Frame]:
    """Read the frames of one transforms file. Appends a warning about images that do not exist."""
    path = folder / f"transforms_{split}.json"
    if not path.is_file():
        raise InputError(f"{path} does not exist; a D-NeRF scene needs transforms_train.json and transforms_test.json.")
    data = read_json(path)
    entries = timed_frames(data)
    frames: list[Frame] = []
    images, absent = ImageFinder(folder), list[str]()
    for index, (entry, stated) in enumerate(entries):
        named = image_path(entry, images, absent)
        if named is None:
            continue
        file_path, file = named
        T_cam_world = opengl_pose(entry.required("transform_matrix"), entry.where)
        time = index / max(len(entries) - 1, 1) if stated is None else stated
        if not 0 <= time <= 1:
            raise InputError(f"{entry.where}: time must lie in [0, 1], got {time:g}; divide by the clip's duration.")
        image = check_image(file)
        lens, name = read_lens(entry, data, image.size), ImageName(file_path)
        frames.append(Frame(image, lens, T_cam_world, entry.where, name, time=time, split=split, label=f"{index:03d}"))
    warnings += check_absent(absent, len(entries), path)
    return frames


READER = Reader("D-NeRF", "transforms_train.json and transforms_test.json", _matches, _read)
