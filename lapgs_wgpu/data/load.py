"""Load a capture: reader -> times -> splits -> undistort -> normalize -> masks -> views.

A reader knows its file format and nothing else; whatever holds for all formats stands here, once. A new format needs a
file in `readers` and a line in READERS.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from lapgs_wgpu.data.frames import Capture, Frame, Reader, Split
from lapgs_wgpu.data.images import Pixels, Size, shrink, shrunk_size
from lapgs_wgpu.data.lens import Lens, Undistortion
from lapgs_wgpu.data.masks import Mask, check_ignored, find_masks, read_ignored, read_measured
from lapgs_wgpu.data.placement import place
from lapgs_wgpu.data.readers import colmap, dnerf, endonerf, hypernerf, nerfstudio, neu3d, polycam, record3d
from lapgs_wgpu.data.split import held_out
from lapgs_wgpu.data.timestamps import disorder, in_step, natural_key, read_times, to_unit_range
from lapgs_wgpu.data.validation import check_cloud, check_film, check_frames, check_plausible, check_views, upright
from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

READERS: tuple[Reader, ...] = tuple(
    module.READER for module in (dnerf, hypernerf, neu3d, nerfstudio, colmap, record3d, polycam, endonerf)
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
    frames, turned = upright(capture.frames)
    capture = dataclasses.replace(capture, frames=frames)
    warnings = [*capture.warnings, *turned, *check_plausible(frames)]

    times, time_source = _times(folder, capture, warnings)
    splits = _splits(folder, frames, times)
    check_frames(frames)
    shots = _undistort(capture, shrunk_size(frames[0].image.size, image_size))
    training = [shot for shot, split in zip(shots, splits, strict=True) if split == "train"]
    training_cameras = list(dict.fromkeys(shot.camera for shot in training))
    warnings += _check_cloud(capture, shots, training_cameras)
    placement = place(capture, [shot.frame for shot in training], training_cameras, normalize=normalize)
    warnings += placement.warnings
    order = _film_order(frames, times, warnings) if capture.own_footage else range(len(frames))
    ignored = _ignored(None if masks is None else Path(masks), frames, splits, warnings)

    fit = placement.normalization
    cameras = dict.fromkeys(shot.camera for shot in shots)
    placed = {camera: camera if fit is None else fit.camera(camera) for camera in cameras}

    def views(split: Split) -> tuple[View, ...]:
        chosen = [i for i in order if splits[i] == split]
        return tuple(
            _view(split, n, shots[i], placed[shots[i].camera], times[i], ignored) for n, i in enumerate(chosen)
        )

    return Dataset(
        folder.resolve().name,
        views("train"),
        views("test"),
        val=views("val"),
        cloud=placement.cloud,
        depths=placement.depths,
        normalization=fit if fit is None or capture.moved is None else capture.moved.then(fit),
        scale=1.0 if fit is None else fit.scale,
        warnings=tuple(warnings),
        time_source=time_source,
        own_footage=capture.own_footage,
        summary=_summary(reader.name, shots, times, time_source, splits)
        + (f"; {capture.left_out} left out" if capture.left_out else ""),
    )


def _summary(
    layout: str, shots: Sequence[_Shot], times: Sequence[float], time_source: str, splits: Sequence[Split]
) -> str:
    """Say how a capture was understood: layout, cameras, times and their source, what is held out."""
    films = {shot.frame.name.camera for shot in shots}
    held = [shot.frame.name.camera for shot, split in zip(shots, splits, strict=True) if split != "train"]
    places = len({shot.camera for shot in shots})
    still = len(shots) >= 2 * places
    count = places if still else len(films)
    cameras = f"{count} {'still' if still else 'moving'} camera{'s' * (count > 1)}"
    whole = len(films) > 1 and len(set(held)) == 1 and sum(shot.frame.name.camera == held[0] for shot in shots)
    out = f"{held[0]} is" if whole == len(held) else f"{len(held)} of {len(shots)} images are"
    return f"{layout}, {cameras}, {len(set(times))} times from {time_source}; {out} held out"


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


def _times(folder: Path, capture: Capture, warnings: list[str]) -> tuple[list[float], str]:
    """Return the times of all frames in [0, 1], and their source. Appends warnings about own footage."""
    names = [frame.name for frame in capture.frames]
    times, source = [frame.time for frame in capture.frames if frame.time is not None], capture.time_source
    if not times:
        times, source = read_times(names, folder)
    if capture.own_footage:
        warnings += disorder(names, times)
        times = in_step(names, times)
    return to_unit_range(times, *(capture.time_range or (min(times), max(times)))), source


def _splits(folder: Path, frames: Sequence[Frame], times: Sequence[float]) -> list[Split]:
    """Return the split of each frame, as the files state it, or by the rule for own footage. Raises InputError."""
    splits: list[Split] = [frame.split for frame in frames if frame.split is not None]
    if not splits:
        tested = held_out([frame.name for frame in frames], times)
        splits = ["test" if i in tested else "train" for i in range(len(frames))]
    if "train" not in splits:
        raise InputError(f"{folder}: all {len(frames)} images are held out for testing; none is left to train on.")
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

    def measured(self, mask: Path) -> Mask:
        """Decode, undistort and shrink a test mask. Raises InputError."""
        return read_measured(mask, self.undistortion, self.frame.image.size, self.size)

    def ignored(self, mask: Path, *, black: bool) -> Mask:
        """Decode, undistort and shrink a training mask. Raises InputError."""
        return read_ignored(mask, self.undistortion, self.frame.image.size, self.size, black=black)


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


def _check_cloud(capture: Capture, shots: Sequence[_Shot], training: Sequence[Camera]) -> list[str]:
    """Check a cloud against the cameras: return warnings, or raise InputError."""
    if capture.cloud is None:
        return []
    warnings = []
    if capture.own_footage:
        cameras, names = [shot.camera for shot in shots], [shot.frame.name.file for shot in shots]
        warnings = check_views(capture.cloud, cameras, names, capture.source)
    check_cloud(capture.cloud, training, capture.source)
    return warnings


def _film_order(frames: Sequence[Frame], times: Sequence[float], warnings: list[str]) -> list[int]:
    """Return the frames by camera, then time. Appends warnings about blurred and repeated images of each camera."""
    films: dict[str, list[int]] = {}
    for i in sorted(range(len(frames)), key=lambda i: (times[i], natural_key(frames[i].name.file))):
        films.setdefault(frames[i].name.camera, []).append(i)
    for film in films.values():
        warnings += check_film([Path(str(frames[i].image)) for i in film])
    return [i for camera in sorted(films, key=natural_key) for i in films[camera]]


class _IgnoredMasks(NamedTuple):
    """Masks of training images by the images' names. black: whether black pixels are ignored, or white ones."""

    paths: Mapping[str, Path]
    black: bool


def _ignored(
    folder: Path | None, frames: Sequence[Frame], splits: Sequence[Split], warnings: list[str]
) -> _IgnoredMasks:
    """Find and check the masks in the user's folder, or else those that the capture names. Appends warnings."""
    if folder is None:
        paths = {frame.name.file: frame.black for frame in frames if frame.black is not None}
    else:
        names = [frame.name.file for frame, split in zip(frames, splits, strict=True) if split == "train"]
        paths = find_masks(folder, names, "each training image, named as the image")
    warnings += check_ignored(paths, frames[0].image.size, black=folder is None)
    return _IgnoredMasks(paths, folder is None)


def _view(split: Split, number: int, shot: _Shot, camera: Camera, time: float, ignored: _IgnoredMasks) -> View:
    """Make the view of a frame. number: within its split, for its name. camera: in the world's coordinates."""
    frame = shot.frame
    path = ignored.paths.get(frame.name.file) if split == "train" else None
    return View(
        name=f"{split}_{frame.label or f'{number:05d}'}",
        camera=camera,
        time=time,
        source=str(frame.image),
        pixels=shot.pixels,
        mask=None if frame.mask is None else partial(shot.measured, frame.mask),
        ignored=None if path is None else partial(shot.ignored, path, black=ignored.black),
    )
