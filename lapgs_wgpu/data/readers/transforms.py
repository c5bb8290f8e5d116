"""Readers of transforms files: nerfstudio's transforms.json, and D-NeRF's transforms_{train,test,val}.json.

Both list frames: path, pose (`transform_matrix`, camera to world, OpenGL's axes) and perhaps time of each image, with
intrinsics of each or of all. docs/data.md lists the fields. nerfstudio's cloud is in the coordinates of
transform_matrix, since applied_transform was applied to both.
"""

import dataclasses
import math
from pathlib import Path, PurePosixPath

from lapgs_wgpu.data.capture_files import CaptureFiles
from lapgs_wgpu.data.cloud import find_cloud, is_random, read_cloud
from lapgs_wgpu.data.frames import Capture, Frame, Reader, Split
from lapgs_wgpu.data.images import SIDEWAYS, ImageFile
from lapgs_wgpu.data.json_fields import FINITE, LARGEST_INTRINSIC, LARGEST_SIDE, Fields, read_json
from lapgs_wgpu.data.lens import Lens
from lapgs_wgpu.data.poses import opengl_pose, place_of
from lapgs_wgpu.data.stamps import ImageName, image_names
from lapgs_wgpu.data.validation import check_frames
from lapgs_wgpu.errors import InputError, shown
from lapgs_wgpu.splat.camera import intrinsics_of_fov

TRAIN, TEST = "transforms_train.json", "transforms_test.json"  # D-NeRF's
CLOUDS = ("fused.ply", "points3d.ply", "points3D.ply")
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
SIDE, FOCAL, ANY = (1, LARGEST_SIDE), (1e-9, LARGEST_INTRINSIC), (-LARGEST_INTRINSIC, LARGEST_INTRINSIC)
INTRINSICS = {  # bounds, in pixels of an image w x h
    "w": SIDE, "h": SIDE, "fl_x": FOCAL, "fl_y": FOCAL, "cx": ANY, "cy": ANY,
    "k1": ANY, "k2": ANY, "k3": ANY, "k4": (0, 0), "p1": ANY, "p2": ANY,
}  # fmt: skip


def _read_frames(data: Fields, files: CaptureFiles, time: str) -> dict[int, Frame]:
    """Return the frames of a transforms file whose images exist, by the places of their entries. time: the field of the
    times, in all entries or in none. Raises InputError."""
    entries = data.objects("frames", "frame")
    timed = sum(_states(entry, time) for entry in entries)
    frames = {}
    for index, entry in enumerate(entries):
        if timed and not _states(entry, time):
            raise InputError(
                f"{entry.where} has no field {time}, though {timed} of {len(entries)} frames have it; give it for all."
            )
        stated = entry.number(time, *FINITE) if timed else None
        pose = opengl_pose(entry.required("transform_matrix"), entry.where)
        if found := files.image(entry, "file_path"):
            name, image = found
            lens, sized = read_lens(entry, data, image)
            frames[index] = Frame(image, lens, pose, entry.where, ImageName(name), time=stated, states_size=sized)
    return frames


def _states(entry: Fields, field: str) -> bool:
    return entry.values.get(field) is not None


def read_lens(frame: Fields, shared: Fields, image: ImageFile) -> tuple[Lens, bool]:
    """Return the lens of a frame, and whether size or center are stated; each value is the frame's, else its file's. A
    missing size is the image's, and a missing fl_x that of camera_angle_x (radians). Raises InputError."""

    def source(name: str) -> Fields:
        return frame if name in frame else shared

    model = source("camera_model").values.get("camera_model", "OPENCV")
    if model not in MODELS or source("is_fisheye").values.get("is_fisheye"):
        named = shown(model) if model not in MODELS else "is_fisheye"
        raise InputError(f"{frame.where}: camera_model {named} is none of {', '.join(MODELS)}; undistort the images.")
    stated = [name for name in INTRINSICS if _states(source(name), name)]
    values = {name: source(name).number(name, *INTRINSICS[name]) for name in stated}
    centered = {"cx", "cy"} <= values.keys()
    size = image.size
    if centered and image.orientation >= SIDEWAYS:  # of the two sizes, that whose middle is nearer
        size = min(size, size[::-1], key=lambda s: abs(s[0] - 2 * values["cx"]) + abs(s[1] - 2 * values["cy"]))
    width, height = int(values.get("w", size[0])), int(values.get("h", size[1]))
    if "fl_x" in values:
        fx = values["fl_x"]
    else:
        angle = source("camera_angle_x")
        if "camera_angle_x" not in angle:
            raise InputError(f"{frame.where} and {shared.where} have neither fl_x nor camera_angle_x; give one.")
        fov_x = angle.number("camera_angle_x")
        if not 1e-6 < fov_x < math.pi:
            raise InputError(f"{angle.where}: camera_angle_x must be radians between 0 and pi, got {fov_x:g}.")
        fx = float(intrinsics_of_fov(fov_x, width, height)[0, 0])
    k1, k2, k3, p1, p2 = (values.get(name, 0.0) for name in ("k1", "k2", "k3", "p1", "p2"))
    lens = Lens(
        width, height, fx, values.get("fl_y", fx), values.get("cx", width / 2), values.get("cy", height / 2),
        radial=(k1, k2, k3), tangential=(p1, p2),
    )  # fmt: skip
    return lens, centered or {"w", "h"} <= values.keys()


# nerfstudio


def _read_nerfstudio(folder: Path, image_size: int | None) -> Capture:
    path, files = folder / "transforms.json", CaptureFiles(folder)
    data = read_json(path)
    entries = data.objects("frames", "frame")
    time = "time" if any(_states(entry, "time") for entry in entries) else "timestamp"
    read = _read_frames(data, files, time)
    warnings = files.left_out(len(entries), path)
    frames: dict[str, Frame] = {}
    for index, frame in read.items():
        file, mask = frame.name.file, files.optional(entries[index], "mask_path")
        if file in frames:
            raise InputError(f"{frame.where} and {frames[file].where} name the same image, {file}; keep one of them.")
        frames[file] = dataclasses.replace(frame, mask=mask, mask_kind="black")
    if splits := _splits(data, list(frames), files):
        if unlisted := [file for file in frames if file not in splits]:
            warnings.append(
                f"{path}: {len(unlisted)} of {len(frames)} images, such as {unlisted[0]}, are in none of "
                "train_filenames, val_filenames and test_filenames, and are left out."
            )
        frames = {f: dataclasses.replace(frame, split=splits[f]) for f, frame in frames.items() if f in splits}
    names = image_names(list(frames), {file: place_of(frame.T_cam_world) for file, frame in frames.items()})
    cloud = files.optional(data, "ply_file_path")
    return Capture(
        [dataclasses.replace(frames[name.file], name=name) for name in names],
        cloud=None if cloud is None else read_cloud(cloud),
        source=cloud or path,
        warnings=warnings,
        left_out=len(entries) - len(frames),
        time_source=f"{time} in {path}",
        shares_cameras=True,
        own_footage=True,
    )


def _splits(data: Fields, names: list[str], files: CaptureFiles) -> dict[str, Split]:
    """Return the split of each image, as the file's lists state it; {} if they hold nothing out. An image in no list is
    for training, but missing here if the file lists those for training. Raises InputError for other names."""
    known = set(names)
    stated = {PurePosixPath(str(entry["file_path"]).replace("\\", "/")) for entry in data.values["frames"]}
    lists: dict[Split, list[str]] = {"train": [], "val": [], "test": []}
    for split, found in lists.items():
        field = f"{split}_filenames"
        listed = data.values.get(field) or []
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise InputError(f"{data.where}: {field} must be a list of names, got {shown(listed)}.")
        for name in listed:
            if (file := files.find(name)) in known:
                found.append(str(file))
            elif PurePosixPath(name.replace("\\", "/")) not in stated:
                raise InputError(f"{data.where}: {field} names {name[:80]}, none of {len(names)} frames; remove it.")
    if not lists["test"]:  # one list is enough to measure by
        lists["test"], lists["val"] = lists["val"], []
    if not lists["test"]:
        return {}
    lists["train"] = lists["train"] or names
    return {name: split for split, found in lists.items() for name in found}


# D-NeRF


def _read_dnerf(folder: Path, image_size: int | None) -> Capture:
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
    cameras = folder / TRAIN
    return Capture(
        frames,
        cloud=cloud,
        warnings=warnings,
        source=cameras if path is None or cloud is None else path,
        time_source=f"time in {cameras}",
        time_range=(0.0, 1.0),
        keeps_coordinates=True,
    )


def _read_split(folder: Path, split: Split, warnings: list[str]) -> list[Frame]:
    """Read the frames of one transforms file. Appends a warning about images that do not exist."""
    path, files = folder / f"transforms_{split}.json", CaptureFiles(folder)
    if not path.is_file():
        raise InputError(
            f"{path} does not exist, which a D-NeRF scene needs; if there is one file alone, name it transforms.json, "
            "and every eighth image is held out."
        )
    data, frames = read_json(path), []
    read, count = _read_frames(data, files, "time"), len(data.values["frames"])
    for index, frame in read.items():
        time = index / max(count - 1, 1) if frame.time is None else frame.time
        if not 0 <= time <= 1:
            raise InputError(f"{frame.where}: time must lie in [0, 1], got {time:g}; divide by the clip's duration.")
        frames.append(dataclasses.replace(frame, time=time, split=split, label=f"{index:03d}"))
    warnings += files.left_out(count, path)
    return frames


READERS = (
    Reader("D-NeRF", f"{TRAIN} and {TEST}", lambda f: (f / TRAIN).is_file() or (f / TEST).is_file(), _read_dnerf),
    Reader("nerfstudio", "transforms.json", lambda f: (f / "transforms.json").is_file(), _read_nerfstudio),
)
