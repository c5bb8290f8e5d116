"""Load a capture: reader -> times -> splits -> undistort -> normalize -> masks -> views.

A reader knows its file format and nothing else; whatever holds for all formats stands here, once. A new format needs a
file in `readers` and a line in READERS.
"""

import dataclasses
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path

from lapgs_wgpu.data.frames import Capture, Frame, Reader, Split
from lapgs_wgpu.data.images import SUFFIXES, ImageFile, Pixels, Size, check_film, shrink, shrunk_size
from lapgs_wgpu.data.lens import Lens, Undistortion
from lapgs_wgpu.data.masks import MOSTLY, check_masks, find_masks, read_mask
from lapgs_wgpu.data.normalize import Normalization
from lapgs_wgpu.data.placement import mover_cube, place
from lapgs_wgpu.data.poses import place_of
from lapgs_wgpu.data.readers import apps, colmap, hypernerf, panoptic, poses_bounds, transforms
from lapgs_wgpu.data.stamps import by_camera, natural_key
from lapgs_wgpu.data.timestamps import as_one_camera, disorder, held_out, in_step, read_times
from lapgs_wgpu.data.validation import check_frames, check_plausible, check_views, upright, usable_cloud
from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

READERS: tuple[Reader, ...] = tuple(
    reader for module in (transforms, hypernerf, poses_bounds, panoptic, colmap, apps) for reader in module.READERS
)

FILMS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
NEAR_SHARE = 0.5  # of the nearest depth that a capture states, or that its cameras let guess: nothing is drawn before


def load_dataset(
    folder: str | Path,
    *,
    image_size: int | None = None,
    undistort: bool = True,
    masks: str | Path | None = None,
    movers: str | Path | None = None,
) -> Dataset:
    """Open a capture; its files determine the format (docs/data.md). Images are decoded later, view by view.

    Args:
        folder: of the capture.
        image_size: longer side in pixels, 1 or more, to which larger images are shrunk; None keeps their size.
        undistort: False takes images as they are, and cameras as pinholes that look at the center of the image,
            whatever the files say of distortion, skew and principal point, as published code on HyperNeRF does.
        masks: folder with a PNG for each training image, under its name, white where the training loss ignores it.
        movers: the same for each image, white where something moves; a name is one in the capture's folder.

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
    frames, warnings = list(capture.frames), list(capture.warnings)
    if not undistort:
        frames = [dataclasses.replace(frame, lens=frame.lens.idealized) for frame in frames]
    frames = upright(frames, warnings)
    warnings += check_plausible(frames)
    frames, time_source = _timed(folder, capture, frames, warnings)
    check_frames(frames)
    frames = _masked(folder, frames, masks, movers, warnings)

    views = _views(frames, shrunk_size(frames[0].image.size, image_size), shared=capture.shares_cameras)
    training = [view for view, frame in zip(views, frames, strict=True) if frame.split == "train"]
    cameras = list(dict.fromkeys(view.camera for view in training))
    cloud, cube = capture.cloud, None
    if cloud is not None:
        if capture.own_footage:
            named = {view.camera: frame.name.file for view, frame in zip(views, frames, strict=True)}
            warnings += check_views(cloud, named, capture.source)
        cloud = usable_cloud(cloud, cameras, capture.source, warnings)
        cube = mover_cube(cloud, training)
    capture = dataclasses.replace(capture, frames=frames, cloud=cloud)
    fit, cloud, depths = place(capture, cameras, cube, warnings)
    whole = fit if fit is None or capture.moved is None else capture.moved.then(fit)
    # Without a cloud, what stands just before one camera would explain its images alone, and block those beside it.
    near = NEAR_SHARE * depths[0] if depths is not None and cloud is None else 0.0

    @cache
    def placed(camera: Camera) -> Camera:
        return dataclasses.replace(camera if fit is None else fit.camera(camera), near=near)

    found: dict[Split | None, list[View]] = {"train": [], "test": [], "val": []}
    for i in _by_film(frames, warnings) if capture.own_footage else range(len(frames)):
        mine = found[frames[i].split]
        name = f"{frames[i].split}_{frames[i].label or f'{len(mine):05d}'}"
        mine.append(dataclasses.replace(views[i], name=name, camera=placed(views[i].camera)))

    return Dataset(
        folder.resolve().name,
        tuple(found["train"]),
        tuple(found["test"]),
        val=tuple(found["val"]),
        cloud=cloud,
        depths=depths,
        normalization=whole,
        scale=1.0 if fit is None else fit.scale,
        warnings=tuple(warnings),
        time_source=time_source,
        own_footage=capture.own_footage,
        summary=_summary(reader.name, capture, len({view.camera for view in views}), time_source, whole),
    )


def _summary(layout: str, capture: Capture, cameras: int, time_source: str, whole: Normalization | None) -> str:
    """Say how a capture was understood: layout, cameras, times and their source, what is held out, its scale."""
    frames = capture.frames
    still = len(frames) >= 2 * cameras
    number = cameras if still else len({frame.name.camera for frame in frames})
    cameras_text = f"{number} {'still' if still else 'moving'} camera{'s' * (number > 1)}"
    times = len({frame.time for frame in frames})
    held = [frame.name.camera for frame in frames if frame.split != "train"]
    trained = {frame.name.camera for frame in frames if frame.split == "train"}
    whole_camera = len({*held}) == 1 and held[0] not in trained
    held_out = f"{held[0]} is" if whole_camera else f"{len(held)} of {len(frames)} images are"
    scale = "coordinates are kept" if whole is None else f"1 unit of the files becomes {whole.scale:.4g}"
    left_out = f"; {capture.left_out} left out" if capture.left_out else ""
    return f"{layout}, {cameras_text}, {times} times from {time_source}; {held_out} held out; {scale}{left_out}"


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
    held = {path.suffix.lower() for pattern in ("*.*", "*/*.*") for path in folder.glob(pattern)}
    if not inside and not held.isdisjoint((*SUFFIXES, *FILMS)):
        what = "films" if held.isdisjoint(SUFFIXES) else "images"
        inside = f"; it holds {what} without poses, which lapgs-prepare finds"
    expected = ", or ".join(f"{reader.files} ({reader.name})" for reader in READERS)
    raise InputError(f"{folder} is no scene in a known format: expected {expected}{inside}.")


def _timed(folder: Path, capture: Capture, frames: Sequence[Frame], warnings: list[str]) -> tuple[list[Frame], str]:
    """Give the frames their times in [0, 1] and, by the rule for own footage, splits where the files state none.

    Returns them, and the source of the times. Appends warnings about own footage. Raises InputError.
    """
    names = [frame.name for frame in frames]
    times, source = [frame.time for frame in frames if frame.time is not None], capture.time_source
    if not times:
        times, source = read_times(names, folder)
    if capture.own_footage:
        names = as_one_camera(names, times, [place_of(frame.T_cam_world) for frame in frames])
        warnings += disorder(names, times)
        times = in_step(names, times)
    first, last = capture.time_range or (min(times), max(times))
    times = [(time - first) / (last - first) if last > first else 0.0 for time in times]
    splits: list[Split] = [frame.split for frame in frames if frame.split is not None]
    if not splits:
        tested = held_out(names, times)
        splits = ["test" if i in tested else "train" for i in range(len(names))]
    if "train" not in splits:
        raise InputError(f"{folder}: all {len(names)} images are held out; name fewer in its lists of test images.")
    found = zip(frames, names, times, splits, strict=True)
    return [dataclasses.replace(f, name=name, time=time, split=split) for f, name, time, split in found], source


def _masked(
    folder: Path, frames: list[Frame], masks: str | Path | None, movers: str | Path | None, warnings: list[str]
) -> list[Frame]:
    """Give training frames the masks in the user's folder, in place of those that the capture names, and all frames
    those of what moves. Appends warnings. Raises InputError."""
    if masks is not None:
        names = [frame.name.file for frame in frames if frame.split == "train"]
        found = find_masks(Path(masks), names, "each training image, named as the image")
        frames = [dataclasses.replace(f, mask=found.get(f.name.file), mask_kind="white") for f in frames]
    if movers is not None:
        found = find_masks(folder / movers, [frame.name.file for frame in frames], "each image, white where it moves")
        frames = [dataclasses.replace(frame, moving=found[frame.name.file]) for frame in frames]
    size, kind = frames[0].image.size, frames[0].mask_kind
    ignored = [frame.mask for frame in frames if frame.split == "train" and frame.mask is not None]
    moving = [frame.moving for frame in frames if frame.moving is not None]
    warnings += check_masks(ignored, size, kind, "is left out") + check_masks(moving, size, "white", "moves")
    return frames


def _views(frames: Sequence[Frame], size: Size, *, shared: bool) -> list[View]:
    """Return the view of each frame for images of `size`, (width, height), without its name, and with the pinhole
    camera in the capture's coordinates. Raises InputError.

    shared: whether frames of equal lens and pose share the camera.
    """
    stored = frames[0].image.size
    undistortions: dict[Lens, Undistortion] = {}
    cameras: dict[tuple[Lens, bytes], Camera] = {}
    views = []
    for frame in frames:
        assert frame.time is not None
        lens = frame.lens
        if lens not in undistortions:
            resized = lens.resized(*stored)
            undistortions[lens] = Undistortion(resized, resized.pinhole(frame.where))
        undistortion = undistortions[lens]
        key = lens, frame.T_cam_world.tobytes()
        if not (shared and key in cameras):
            K, taken = (lens.K, lens.size) if lens.is_pinhole else (undistortion.K, stored)
            cameras[key] = Camera(K, frame.T_cam_world, *taken).resized(*size)
        load = partial(_pixels, frame.image, undistortion, size)
        mask = partial(read_mask, undistortion=undistortion, size=size)
        ignored = partial(mask, frame.mask, frame.mask_kind) if frame.mask and frame.split == "train" else None
        moving = partial(mask, frame.moving, "white", above=MOSTLY) if frame.moving else None
        views.append(View("", cameras[key], frame.time, str(frame.image), load, ignored, moving))
    return views


def _pixels(image: ImageFile, undistortion: Undistortion, size: Size) -> Pixels:
    return shrink(undistortion.apply(image.read(undistortion.lens.size)), size)


def _by_film(frames: Sequence[Frame], warnings: list[str]) -> list[int]:
    """Return the indices of frames by camera, then time. Appends warnings about blurred and repeated images."""
    ordered = list[int]()
    for mine in by_camera([frame.name for frame in frames]).values():
        film = sorted(mine, key=lambda i: (frames[i].time, natural_key(frames[i].name.file)))
        warnings += check_film([frames[i].image.path for i in film])
        ordered += film
    return ordered
