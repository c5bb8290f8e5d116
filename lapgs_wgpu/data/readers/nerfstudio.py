"""Reader of the nerfstudio format: one transforms.json with intrinsics, pose and time of each image.

docs/data.md lists the fields. The cloud of ply_file_path is in the coordinates of transform_matrix: applied_transform
was applied to both. Apps that write ARKit's or ARCore's poses in this form state `timestamp` instead of `time`, and
some leave out the images' suffix .png (NeRFCapture).
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path, PurePosixPath

from lapgs_wgpu.data.cloud import read_cloud
from lapgs_wgpu.data.frames import Capture, Frame, Reader, Split
from lapgs_wgpu.data.image_files import ImageFinder, check_absent
from lapgs_wgpu.data.images import check_image
from lapgs_wgpu.data.json_fields import Fields, check_inside, image_path, kind, read_json
from lapgs_wgpu.data.poses import opengl_pose
from lapgs_wgpu.data.readers.transforms import read_lens, timed_frames
from lapgs_wgpu.data.stamps import ImageName, image_names
from lapgs_wgpu.errors import InputError


def _matches(folder: Path) -> bool:
    return (folder / "transforms.json").is_file()


def _read(folder: Path, image_size: int | None) -> Capture:
    path = folder / "transforms.json"
    data = read_json(path)
    time_field = "time" if any("time" in frame for frame in data.objects("frames", "frame")) else "timestamp"
    frames = []
    images, absent, stated_names = ImageFinder(folder), list[str](), list[str]()
    for entry, stated in timed_frames(data, time_field):
        named = image_path(entry, images, absent)
        stated_names.append(str(entry.values["file_path"]))
        if named is None:
            continue
        name_in_file, file = named
        image = check_image(file)
        relative = PurePosixPath(name_in_file)
        frames.append(
            Frame(
                image,
                read_lens(entry, data, image.size),
                opengl_pose(entry.required("transform_matrix"), entry.where),
                entry.where,
                ImageName(str(relative), str(relative.parent)),
                time=stated,
                black=_optional_file(entry, "mask_path", folder),
            )
        )
    names = [frame.name.file for frame in frames]
    frames = [dataclasses.replace(frame, name=name) for frame, name in zip(frames, image_names(names), strict=True)]
    if len(set(names)) < len(names):
        twice = next(name for i, name in enumerate(names) if name in names[:i])
        raise InputError(f"{path}: {len(names)} frames name {len(set(names))} images; {twice} is there twice.")
    warnings = check_absent(absent, len(stated_names), path)
    if splits := _splits(data, [*names, *map(_posix, stated_names)]):
        left_out = [name for name in names if name not in splits]
        frames = [dataclasses.replace(frame, split=split) for frame in frames if (split := splits.get(frame.name.file))]
        if left_out:
            warnings.append(
                f"{path}: {len(left_out)} of {len(names)} images, such as {left_out[0]}, are in none of "
                "train_filenames, val_filenames and test_filenames, and are left out."
            )
    cloud = _optional_file(data, "ply_file_path", folder)
    return Capture(
        frames,
        None if cloud is None else read_cloud(cloud),
        source=cloud or path,
        warnings=warnings,
        left_out=len(stated_names) - len(frames),
        time_source=f"{time_field} in {path}",
        shares_cameras=True,
        own_footage=True,
    )


def _optional_file(entry: Fields, field: str, folder: Path) -> Path | None:
    """Return the existing file that a field names, None if the field is missing or null. Raises InputError."""
    name = entry.values.get(field)
    if name is None:
        return None
    if isinstance(name, str):
        check_inside(name, field, entry.where)
    if not isinstance(name, str) or not os.path.isfile(folder / name):
        raise InputError(
            f"{folder / name if isinstance(name, str) else kind(name)} does not exist, but {entry.where} names it as "
            f"its {field}; without that field, the capture opens."
        )
    return folder / name


def _splits(data: Fields, names: list[str]) -> dict[str, Split]:
    """Return the split of each image, as the file's lists state it; {} if they hold nothing out.

    An image in no list is for training, but missing here if the file lists those for training.
    """
    test, validation, train = (_listed(data, f"{split}_filenames", names) for split in ("test", "val", "train"))
    if not test:  # one list is enough to measure by
        test, validation = validation, []
    if not test:
        return {}
    splits: dict[str, Split] = dict.fromkeys(train or names, "train")
    return splits | dict.fromkeys(validation, "val") | dict.fromkeys(test, "test")


def _listed(data: Fields, field: str, names: list[str]) -> list[str]:
    """Return the names of images in a list of the file. Raises InputError, also for one that is no image's."""
    listed = data.values.get(field) or []
    if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
        raise InputError(f"{data.where}: {field} must be a list of names, got {kind(listed)}.")
    normal = [str(PurePosixPath(name)) if str(PurePosixPath(name)) in names else _posix(name) for name in listed]
    unknown = next((name for name in normal if name not in names), None)
    if unknown is not None:
        raise InputError(f"{data.where}: {field} names {unknown[:80]}, which is none of its {len(names)} frames.")
    return normal


def _posix(name: str) -> str:
    return str(PurePosixPath(name.replace("\\", "/")))


READER = Reader("nerfstudio", "transforms.json", _matches, _read)
