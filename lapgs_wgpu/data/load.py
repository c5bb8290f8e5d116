"""Load a capture: reader -> frames and cloud -> undistort -> normalize -> split -> validate -> Dataset.

A reader knows its file format and nothing else; whatever holds for all formats stands here, once. A new format needs a
file in `readers` and a line in READERS.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from lapgs_wgpu.data.cloud import Cloud, points_in_view
from lapgs_wgpu.data.covisible import read_mask
from lapgs_wgpu.data.focus import are_parallel, focus_of
from lapgs_wgpu.data.frames import Capture, Frame, ImageSource, Reader, Split
from lapgs_wgpu.data.ignored import check_ignored, find_ignored, read_ignored
from lapgs_wgpu.data.images import Pixels, Size, shrink, shrunk_size
from lapgs_wgpu.data.normalize import BOX, Cube, cube_in_view, cube_of_points
from lapgs_wgpu.data.readers import colmap, dnerf, endonerf, hypernerf, nerfstudio, neu3d, polycam, record3d
from lapgs_wgpu.data.split import held_out
from lapgs_wgpu.data.timestamps import disorder, in_step, natural_key, read_times, to_unit_range
from lapgs_wgpu.data.undistort import Undistortion
from lapgs_wgpu.data.validation import check_cloud, check_film, check_frames, check_views
from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

READERS: tuple[Reader, ...] = tuple(
    module.READER for module in (dnerf, hypernerf, neu3d, nerfstudio, colmap, record3d, polycam, endonerf)
)

PROBES = 4096  # points that determine the normalization of a capture without a cloud
DENSE = 4096  # points; a smaller cloud is filled up: Gaussians multiply too slowly to fill what it leaves empty
NEAREST, FURTHEST = 0.25, 2.0  # depths relative to the distance of the focus, for own footage without a cloud


def load_dataset(
    folder: str | Path,
    *,
    image_size: int | None = None,
    normalize: bool = True,
    undistort: bool = True,
    masks: str | Path | None = None,
) -> Dataset:
    """Open a capture; its files determine the format (docs/data.md). Images are decoded later, view by view.

    Args:
        folder: of the capture.
        image_size: longer side in pixels, 1 or more, to which larger images are shrunk; None keeps their size.
        normalize: False keeps the coordinates of a D-NeRF scene of any size; other formats are always normalized.
        undistort: False takes images as they are, and cameras as pinholes that look at the center of the image,
            whatever the files say of distortion, skew and principal point, as published code on HyperNeRF does.
        masks: folder with a PNG for each training image, under its name, white where the training loss ignores it.

    Returns:
        A dataset, whose `train`, `test` and `val` are tuples of views (`name`, `camera`, `time`, `load()`).

    Raises:
        InputError: not a capture, or one that cannot be trained on as it is; names file and field.
    """
    folder = Path(folder)
    if image_size is not None and image_size < 1:
        raise InputError(f"image_size must be at least 1 pixel, got {image_size}.")
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "does not exist"
        raise InputError(f"{folder} {problem}; give the folder of a scene.")
    matching = [reader for reader in READERS if reader.matches(folder)]
    if len(matching) == 1:
        capture = matching[0].read(folder, image_size)
        masks = None if masks is None else Path(masks)
        return _dataset(folder, capture if undistort else _idealized(capture), image_size, normalize, masks)
    if matching:
        both = " and of ".join(f"{reader.name} ({reader.files})" for reader in matching)
        raise InputError(f"{folder} holds the files of {both}; keep one format's in it.")
    children = sorted(child for child in folder.iterdir() if child.is_dir())
    scenes = [child.name for child in children if any(reader.matches(child) for reader in READERS)]
    inside = f"; it holds the scenes {', '.join(scenes[:8])}: name one of them" if scenes else ""
    if any(reader.matches(folder.resolve().parent) for reader in READERS):
        inside = f"; its parent folder {folder.resolve().parent} is one: name that"
    expected = ", or ".join(f"{reader.files} ({reader.name})" for reader in READERS)
    raise InputError(f"{folder} is no scene in a known format: expected {expected}{inside}.")


def _dataset(folder: Path, capture: Capture, image_size: int | None, normalize: bool, masks: Path | None) -> Dataset:
    """Turn what a reader returned into a dataset."""
    frames, cloud, warnings = capture.frames, capture.cloud, list(capture.warnings)
    times, time_source = _times(folder, capture, warnings)
    splits = _splits(folder, frames, times)
    check_frames(frames)
    stored = frames[0].image.size
    size = shrunk_size(stored, image_size)
    cameras, undistortions = _undistort(frames, stored, size)
    trained = [camera for camera, split in zip(cameras, splits, strict=True) if split == "train"]
    training = list({id(camera): camera for camera in trained}.values())  # distinct ones

    if cloud is not None:
        if capture.own_footage:
            names = [frame.name.file for frame in frames]
            warnings += check_views(cloud, cameras, names, capture.source, capture.axes_hint)
        check_cloud(cloud, training, capture.source)
    depths = _depths(capture, splits, training, warnings)
    cube = _cube(capture, training, depths)
    if cube is None:
        warnings.append(
            f"{capture.source}: half or more of {len(training)} cameras look away from the point nearest to all "
            "optical axes, so the size of the scene is unknown and it keeps its coordinates: if that is not "
            f"[-{BOX:g}, {BOX:g}]^3, raise points.box and field.bound, or add a cloud (fused.ply)."
        )
    kept = cube is None or (capture.keeps_coordinates and (cube.fits or not normalize))
    fit = None if cube is None or kept else cube.normalization
    if cloud is not None and capture.own_footage:
        cloud = _filled(cloud, training)
    order = _film_order(frames, times, warnings) if capture.own_footage else range(len(frames))
    ignored = {frame.name.file: frame.black for frame in frames if frame.black is not None}
    if masks is not None:
        ignored = find_ignored(masks, [frame.name.file for frame in frames], splits)
    warnings += check_ignored(ignored, stored, black=masks is None)
    placed = {id(camera): camera if fit is None else fit.camera(camera) for camera in cameras}

    def views(split: Split) -> tuple[View, ...]:
        chosen = [i for i in order if splits[i] == split]
        return tuple(
            View(
                name=f"{split}_{frames[i].label or f'{index:05d}'}",
                camera=placed[id(cameras[i])],
                time=times[i],
                source=str(frames[i].image),
                pixels=partial(_read_pixels, frames[i].image, undistortions[i], size),
                mask=None
                if (path := frames[i].mask) is None
                else partial(read_mask, path, undistortions[i], stored, size),
                ignored=None
                if split != "train" or (path := ignored.get(frames[i].name.file)) is None
                else partial(read_ignored, path, undistortions[i], stored, size, black=masks is None),
            )
            for index, i in enumerate(chosen)
        )

    return Dataset(
        folder.resolve().name,
        views("train"),
        views("test"),
        val=views("val"),
        cloud=cloud if cloud is None or fit is None else fit.cloud(cloud),
        depths=depths if depths is None or fit is None else (depths[0] * fit.scale, depths[1] * fit.scale),
        normalization=fit if fit is None or capture.moved is None else capture.moved.then(fit),
        scale=1.0 if fit is None else fit.scale,
        warnings=tuple(warnings),
        time_source=time_source,
        own_footage=capture.own_footage,
    )


def _idealized(capture: Capture) -> Capture:
    """The capture as if its lenses had neither distortion nor skew, and looked at the center of the image."""
    lenses = {id(frame.lens): frame.lens.idealized for frame in capture.frames}
    frames = [dataclasses.replace(frame, lens=lenses[id(frame.lens)]) for frame in capture.frames]
    return dataclasses.replace(capture, frames=frames)


def _times(folder: Path, capture: Capture, warnings: list[str]) -> tuple[list[float], str]:
    """The times of all frames in [0, 1], and their source. Appends warnings about own footage."""
    names = [frame.name for frame in capture.frames]
    values, source = [frame.time for frame in capture.frames if frame.time is not None], capture.time_source
    if not values:
        values, source = read_times(names, folder)
    if capture.own_footage:
        warnings += disorder(names, values)
        values = in_step(names, values)
    return to_unit_range(values, *(capture.time_range or (min(values), max(values)))), source


def _splits(folder: Path, frames: Sequence[Frame], times: Sequence[float]) -> list[Split]:
    """The split of each frame, as the files state it, or by the rule for own footage."""
    splits: list[Split] = [frame.split for frame in frames if frame.split is not None]
    if not splits:
        tested = held_out([frame.name for frame in frames], times)
        splits = ["test" if i in tested else "train" for i in range(len(frames))]
    if "train" not in splits:
        raise InputError(f"{folder}: all {len(frames)} images are held out for testing; none is left to train on.")
    return splits


def _undistort(frames: Sequence[Frame], stored: Size, size: Size) -> tuple[list[Camera], list[Undistortion | None]]:
    """The pinhole camera of each frame at `size`, and what undistorts its image of size `stored`; None for a pinhole.

    Frames that share lens and pose share the camera.
    """
    undistortions: dict[int, Undistortion | None] = {}
    cameras: dict[tuple[int, int], Camera] = {}
    for frame in frames:
        lens, key = frame.lens, (id(frame.lens), id(frame.T_cam_world))
        if id(lens) not in undistortions:
            resized = lens.resized(*stored)
            undistortions[id(lens)] = None if lens.is_pinhole else Undistortion(resized, resized.pinhole(frame.where))
        if key not in cameras:
            undistortion = undistortions[id(lens)]
            K, taken = (lens.K, (lens.width, lens.height)) if undistortion is None else (undistortion.K, stored)
            cameras[key] = Camera(K, frame.T_cam_world, *taken).resized(*size)
    return (
        [cameras[id(frame.lens), id(frame.T_cam_world)] for frame in frames],
        [undistortions[id(frame.lens)] for frame in frames],
    )


def _read_pixels(image: ImageSource, undistortion: Undistortion | None, size: Size) -> Pixels:
    return image.read(size) if undistortion is None else shrink(undistortion.apply(image.read(image.size)), size)


def _depths(
    capture: Capture, splits: Sequence[Split], cameras: Sequence[Camera], warnings: list[str]
) -> tuple[float, float] | None:
    """Nearest and furthest depth of the training cameras, if the files state it or there is no cloud to replace it.
    Appends a warning where it is a guess."""
    trained = [frame for frame, split in zip(capture.frames, splits, strict=True) if split == "train"]
    stated = [frame.depths for frame in trained if frame.depths is not None]
    if stated:
        return min(near for near, _ in stated), float(np.median([far for _, far in stated]))
    if capture.cloud is not None or capture.keeps_coordinates:
        return None
    focus = focus_of(cameras, origin=False)
    depth = np.array([(camera.T_cam_world @ [*focus, 1.0])[2] for camera in cameras])
    behind = int((depth <= 0).sum())
    if 2 * behind > len(cameras):
        raise InputError(
            f"{capture.source}: there is no cloud, and {behind} of {len(cameras)} cameras look away from the point "
            f"nearest to all optical axes: {capture.axes_hint}, or give a cloud."
        )
    near, far = NEAREST * float(depth[depth > 0].min()), FURTHEST * float(depth.max())
    if are_parallel(cameras):
        warnings.append(
            f"{capture.source}: there is no cloud, and all cameras look in one direction, so nothing tells how far "
            f"away the scene is, and {near:.3g} to {far:.3g} in the capture's units is a guess: walk around what "
            "moves, or give a cloud."
        )
    return near, far


def _cube(capture: Capture, cameras: Sequence[Camera], depths: tuple[float, float] | None) -> Cube | None:
    """The cube that the capture fills, in its own coordinates; None if neither files nor cameras determine it."""
    if capture.cloud is not None:
        return cube_of_points(capture.cloud.points.astype(np.float64))
    if depths is not None:
        return cube_of_points(points_in_view(cameras, *depths, PROBES, 0))
    return cube_in_view(cameras)


def _filled(cloud: Cloud, cameras: Sequence[Camera]) -> Cloud:
    """Fill up a cloud to DENSE points.

    The new points are random where views overlap, between the depths of the cloud. Each has the color of the nearest
    old one.
    """
    from scipy.spatial import cKDTree  # slow to import

    missing = DENSE - len(cloud.points)
    if missing <= 0:
        return cloud
    points = cloud.points.astype(np.float64)
    depths = np.concatenate([points @ c.T_cam_world[2, :3] + c.T_cam_world[2, 3] for c in cameras])
    near, far = np.percentile(depths[depths > 0], [1, 99])
    added = points_in_view(cameras, float(near), float(far) * 1.01, missing, 0)
    _, nearest = cKDTree(points).query(added)
    return Cloud(
        np.concatenate([cloud.points, added.astype(np.float32)]),
        np.concatenate([cloud.colors, cloud.colors[nearest]]),
    )


def _film_order(frames: Sequence[Frame], times: Sequence[float], warnings: list[str]) -> list[int]:
    """The frames by camera, then time. Appends warnings about blurred and repeated images of each camera."""
    films: dict[str, list[int]] = {}
    for i in sorted(range(len(frames)), key=lambda i: (times[i], natural_key(frames[i].name.file))):
        films.setdefault(frames[i].name.camera, []).append(i)
    for film in films.values():
        warnings += check_film([Path(str(frames[i].image)) for i in film])
    return [i for camera in sorted(films, key=natural_key) for i in films[camera]]
