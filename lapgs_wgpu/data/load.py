"""Load a capture: reader -> times -> splits -> undistort -> normalize -> masks -> views.

A reader knows its file format and nothing else; whatever holds for all formats stands here, once. A new format needs a
file in `readers` and a line in READERS.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path, PurePath
from typing import NamedTuple

from lapgs_wgpu.data.frames import Capture, Frame, Reader, Split
from lapgs_wgpu.data.images import Pixels, Size, shrink, shrunk_size
from lapgs_wgpu.data.lens import Lens, Undistortion
from lapgs_wgpu.data.masks import Mask, MaskKind, check_masks, find_masks, read_mask
from lapgs_wgpu.data.placement import place
from lapgs_wgpu.data.readers import apps, colmap, hypernerf, poses_bounds, transforms
from lapgs_wgpu.data.split import held_out
from lapgs_wgpu.data.stamps import ImageName, natural_key
from lapgs_wgpu.data.timestamps import as_one_camera, by_camera, disorder, in_step, read_times, to_unit_range
from lapgs_wgpu.data.validation import check_cloud, check_film, check_frames, check_plausible, check_views, upright
from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

READERS: tuple[Reader, ...] = tuple(
    reader for module in (transforms, hypernerf, poses_bounds, colmap, apps) for reader in module.READERS
)


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
    reader = _reader(folder)
    capture = reader.read(folder, image_size)
    if not undistort:
        pinholes = [dataclasses.replace(frame, lens=frame.lens.idealized) for frame in capture.frames]
        capture = dataclasses.replace(capture, frames=pinholes)
    frames, warnings = upright(capture.frames)
    capture = dataclasses.replace(capture, frames=frames)
    warnings = [*capture.warnings, *warnings, *check_plausible(frames)]

    names, times, time_source = _times(folder, capture, warnings)
    frames = [dataclasses.replace(frame, name=name) for frame, name in zip(frames, names, strict=True)]
    capture = dataclasses.replace(capture, frames=frames)
    splits = _splits(folder, frames, times)
    check_frames(frames)
    shots = _undistort(capture, shrunk_size(frames[0].image.size, image_size))
    training = [shot for shot, split in zip(shots, splits, strict=True) if split == "train"]
    training_cameras = list(dict.fromkeys(shot.camera for shot in training))
    if capture.cloud is not None:
        if capture.own_footage:
            cameras, files = [shot.camera for shot in shots], [shot.frame.name.file for shot in shots]
            warnings += check_views(capture.cloud, cameras, files, capture.source)
        cloud = check_cloud(capture.cloud, training_cameras, capture.source, warnings)
        capture = dataclasses.replace(capture, cloud=cloud)
    placement = place(capture, [shot.frame for shot in training], training_cameras, normalize=normalize)
    warnings += placement.warnings
    order = _film_order(frames, times, warnings) if capture.own_footage else range(len(frames))
    ignored, kind = _ignored(masks, frames, splits)
    warnings += check_masks(ignored, frames[0].image.size, kind)
    measured = {frame.name.file: frame.mask for frame in frames if frame.mask is not None}
    check_masks(measured, frames[0].image.size, "measured")

    fit = placement.normalization
    whole = fit if fit is None or capture.moved is None else capture.moved.then(fit)
    distinct = dict.fromkeys(shot.camera for shot in shots)
    placed = {camera: camera if fit is None else fit.camera(camera) for camera in distinct}

    def views(split: Split) -> tuple[View, ...]:
        chosen = [i for i in order if splits[i] == split]
        return tuple(_view(split, n, i) for n, i in enumerate(chosen))

    def _view(split: Split, number: int, i: int) -> View:
        """Make the view of a frame. number: within its split, for its name."""
        shot, frame = shots[i], frames[i]
        mask = ignored.get(frame.name.file) if split == "train" else None
        return View(
            name=f"{split}_{frame.label or f'{number:05d}'}",
            camera=placed[shot.camera],
            time=times[i],
            source=str(frame.image),
            pixels=shot.pixels,
            mask=None if frame.mask is None else partial(shot.mask, frame.mask, "measured"),
            ignored=None if mask is None else partial(shot.mask, mask, kind),
        )

    return Dataset(
        folder.resolve().name,
        views("train"),
        views("test"),
        val=views("val"),
        cloud=placement.cloud,
        depths=placement.depths,
        normalization=whole,
        scale=1.0 if fit is None else fit.scale,
        warnings=tuple(warnings),
        time_source=time_source,
        own_footage=capture.own_footage,
        summary=_summary(reader.name, capture, shots, times, time_source, splits, whole and whole.scale),
    )


def _summary(
    layout: str,
    capture: Capture,
    shots: Sequence[_Shot],
    times: Sequence[float],
    time_source: str,
    splits: Sequence[Split],
    scale: float | None,
) -> str:
    """Say how a capture was understood: layout, cameras, times and their source, what is held out, scale, and what was
    left out."""
    films = by_camera([frame.name for frame in capture.frames])
    folders = {PurePath(frame.name.file).parent for frame in capture.frames}
    held = {frame.name.camera for frame, split in zip(capture.frames, splits, strict=True) if split != "train"}
    count, places = len(splits) - splits.count("train"), len({shot.camera for shot in shots})
    still = len(shots) >= 2 * places
    number = places if still else len(films)
    cameras = f"{number} {'still' if still else 'moving'} camera{'s' * (number > 1)}"
    if len(films) > 1 and not still:
        cameras += " that film at the same time"
    if len(films) == 1 < len(folders) and not still:
        cameras += f" in {len(folders)} folders, one after the other" * capture.own_footage
    whole = len(films) > 1 and len(held) == 1 and len(films[next(iter(held))]) == count
    out = f"{next(iter(held))} is" if whole else f"{count} of {len(shots)} images are"
    told = f"{layout}, {cameras}, {len(set(times))} times from {time_source}; {out} held out"
    told += "; coordinates are kept" if scale is None else f"; 1 unit of the files becomes {scale:.4g}"
    return told + (f"; {capture.left_out} left out" if capture.left_out else "")


def _reader(folder: Path) -> Reader:
    """Return the one reader whose files a folder holds. Raises InputError."""
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "does not exist"
        raise InputError(f"{folder} {problem}; give the folder of a scene.")
    matching = [reader for reader in READERS if reader.matches(folder)]
    if len(matching) == 1:
        return matching[0]
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


def _times(folder: Path, capture: Capture, warnings: list[str]) -> tuple[list[ImageName], list[float], str]:
    """Return names, times in [0, 1] and the source of the times. Appends warnings about own footage."""
    names = [frame.name for frame in capture.frames]
    times, source = [frame.time for frame in capture.frames if frame.time is not None], capture.time_source
    if not times:
        times, source = read_times(names, folder, warnings)
    if capture.own_footage:
        names = as_one_camera(names, times, [frame.place for frame in capture.frames])
        warnings += disorder(names, times, numbered=source.startswith("the frame numbers"))
        times = in_step(names, times)
    return names, to_unit_range(times, *(capture.time_range or (min(times), max(times)))), source


def _splits(folder: Path, frames: Sequence[Frame], times: Sequence[float]) -> list[Split]:
    """Return the split of each frame, as the files state it, or by the rule for own footage. Raises InputError."""
    splits: list[Split] = [frame.split for frame in frames if frame.split is not None]
    if not splits:
        tested = held_out([frame.name for frame in frames], times)
        splits = ["test" if i in tested else "train" for i in range(len(frames))]
    if "train" not in splits:
        raise InputError(f"{folder}: all {len(frames)} images are held out; name fewer in its lists of test images.")
    return splits


class _Shot(NamedTuple):
    """A frame, its pinhole camera, and what makes the camera's image of the file's.

    undistortion: at the file's size; None for a pinhole.
    """

    frame: Frame
    camera: Camera
    undistortion: Undistortion | None

    @property
    def size(self) -> Size:
        return self.camera.width, self.camera.height

    def pixels(self) -> Pixels:
        """Decode, undistort and shrink the image. Raises InputError."""
        image = self.frame.image
        if self.undistortion is None:
            return image.read(self.size)
        return shrink(self.undistortion.apply(image.read(image.size)), self.size)

    def mask(self, file: Path, kind: MaskKind) -> Mask:
        """Decode, undistort and shrink a mask. Raises InputError."""
        return read_mask(file, kind, self.undistortion, self.frame.image.size, self.size)


def _undistort(capture: Capture, size: Size) -> list[_Shot]:
    """Give each frame its pinhole camera for images of `size`, (width, height). Raises InputError.

    Frames of equal lens and pose share the camera if the capture says so.
    """
    stored = capture.frames[0].image.size
    undistortions: dict[Lens, Undistortion | None] = {}
    cameras: dict[tuple[Lens, bytes] | int, Camera] = {}
    shots = []
    for index, frame in enumerate(capture.frames):
        lens = frame.lens
        if lens not in undistortions:
            resized = lens.resized(*stored)
            undistortions[lens] = None if lens.is_pinhole else Undistortion(resized, resized.pinhole(frame.where))
        undistortion = undistortions[lens]
        key = (lens, frame.T_cam_world.tobytes()) if capture.shares_cameras else index
        if key not in cameras:
            K, taken = (lens.K, (lens.width, lens.height)) if undistortion is None else (undistortion.K, stored)
            cameras[key] = Camera(K, frame.T_cam_world, *taken).resized(*size)
        shots.append(_Shot(frame, cameras[key], undistortion))
    return shots


def _film_order(frames: Sequence[Frame], times: Sequence[float], warnings: list[str]) -> list[int]:
    """Return the frames by camera, then time. Appends warnings about blurred and repeated images of each camera."""
    order = []
    for mine in by_camera([frame.name for frame in frames]).values():
        film = sorted(mine, key=lambda i: (times[i], natural_key(frames[i].name.file)))
        warnings += check_film([Path(str(frames[i].image)) for i in film])
        order += film
    return order


def _ignored(
    folder: str | Path | None, frames: Sequence[Frame], splits: Sequence[Split]
) -> tuple[dict[str, Path], MaskKind]:
    """Find the masks of training images, by the images' names: the user's, or else those that the capture names."""
    if folder is None:
        return {frame.name.file: frame.black for frame in frames if frame.black is not None}, "black"
    names = [frame.name.file for frame, split in zip(frames, splits, strict=True) if split == "train"]
    return find_masks(Path(folder), names, "each training image, named as the image"), "white"
