"""Validate a capture before training: what prevents it raises InputError, other problems are warnings."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.cloud import Cloud, in_view, views_of
from lapgs_wgpu.data.evenly import evenly, some
from lapgs_wgpu.data.focus import FAR_APART, degrees_apart, spread
from lapgs_wgpu.data.frames import Frame
from lapgs_wgpu.data.images import ImageFile, decode, scales_to, size_text
from lapgs_wgpu.data.placement import near_focus
from lapgs_wgpu.data.poses import AXES_HINT
from lapgs_wgpu.data.views import Dataset, View
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

MIN_FOCAL, MAX_FOCAL = 0.05, 1000.0  # of an image's longer side: 169 and 0.06 degrees of view
# A triangulated point was seen by cameras. If most points are not, cloud and cameras use different coordinates.
MIN_SEEN = 0.5
OFF_CENTER = 0.15  # of a side: intrinsics of images half or twice as large lie 0.25 or 0.5 away from the middle
LOOKED_AT, DARK = 8, 64  # images of 16 bits or with alpha that are decoded, and the level that one of them reaches
BLACK_AT, BLACK = 3, 16  # the same for the images of a camera
MIN_SPREAD = 1e-3  # of the cloud, relative to its distance from the cameras: a smaller one covers less than a pixel
STANDING = 0.01  # cameras with a spread below this, relative to their distance from the cloud, have no parallax
FEW_POINTS = 100
FEW_TIMES = 5  # fewer distinct times do not constrain motion
GAP, GAP_FACTOR = 0.1, 4.0  # a gap is longer than this share of the clip, and than this multiple of the usual step


def upright(frames: Sequence[Frame], warnings: list[str]) -> list[Frame]:
    """Turn images as their EXIF orientation says where only that fits their camera. Appends a warning where both do."""
    turned, unclear = [], []
    for frame in frames:
        image = frame.image
        if image.orientation > 1:
            stored, shown = (scales_to(size, frame.lens.size) for size in (image.size, image.turned.size))
            if shown and not stored:
                frame = dataclasses.replace(frame, image=image.turned)
            elif shown == stored or not frame.states_size:
                unclear.append(image)
        turned.append(frame)
    if unclear:
        warnings.append(
            f"{len(unclear)} of {len(frames)} images, such as {unclear[0]}, have an EXIF orientation "
            f"({unclear[0].orientation}), and no size or principal point tells whether the poses are those of the "
            "turned images: they are taken as they are stored; else, turn the files and remove the orientation."
        )
    return turned


def check_plausible(frames: Sequence[Frame]) -> list[str]:
    """Warn about principal points far from the middle, about images that are nearly black, as 16 bits that use fewer
    are, or nearly transparent, and about cameras whose images are black."""
    warnings = []
    by_lens = {frame.lens: frame for frame in reversed(frames)}
    sides = {lens: (lens.cx / lens.width, lens.cy / lens.height) for lens in by_lens}
    off = [lens for lens, (x, y) in sides.items() if max(abs(x - 0.5), abs(y - 0.5)) > OFF_CENTER]
    if off:
        lens = off[-1]
        warnings.append(
            f"{by_lens[lens].where}: the principal point ({lens.cx:.5g}, {lens.cy:.5g}) is far from the middle of "
            f"images of {size_text(lens.size)}, in {len(off)} cameras; unless the images were cut out of larger ones, "
            "the intrinsics are those of another size, or in other units than pixels."
        )
    highest, told = _highest([frame.image for frame in frames if frame.image.deep])
    if highest < DARK:
        bits = highest.bit_length()
        warnings.append(
            f"images of 16 bits are nearly black: {told}, as of {8 + bits} bits; multiply them by {2 ** (8 - bits)}."
        )
    highest, told = _highest([frame.image for frame in frames if frame.image.alpha], "alpha")
    if highest < DARK:
        warnings.append(
            f"images are nearly transparent: {told}, and such pixels count as background; save them without alpha."
        )
    films: dict[str, list[ImageFile]] = {}
    for frame in frames:
        if frame.name.camera and not frame.image.deep:
            films.setdefault(frame.name.camera, []).append(frame.image)
    found = {name: _highest(images, most=BLACK_AT) for name, images in films.items() if len(images) > 1}
    black = [f"{name}: {told}" for name, (highest, told) in found.items() if highest < BLACK]
    if black:
        advice = "leave them out" if len(found) > len(black) else "give brighter images"
        warnings.append(f"{len(black)} of {len(found)} cameras are black, such as {black[0]}: {advice}.")
    return warnings


def _highest(images: Sequence[ImageFile], of: str = "level", most: int = LOOKED_AT) -> tuple[int, str]:
    """The highest level (or alpha) in some of the images, 255 where there are none, and a text that says it."""
    looked_at = evenly(images, most)
    channels = slice(3) if of == "level" else slice(3, 4)
    highest = max((int(decode(image.path)[..., channels].max()) for image in looked_at), default=255)
    such = f"in {len(looked_at)} of {len(images)}, such as {looked_at[0]}, " if looked_at else ""
    return highest, f"{such}no {of} is above {highest} of 255"


def check_frames(frames: Sequence[Frame]) -> None:
    """Raise InputError unless all images have one size, and all lenses its proportions and plausible focal lengths."""
    for lens, frame in {frame.lens: frame for frame in reversed(frames)}.items():
        longer, stated, size = max(lens.size), size_text(lens.size), frame.image.size
        for focal in (lens.fx, lens.fy):
            if not MIN_FOCAL * longer <= focal <= MAX_FOCAL * longer:
                raise InputError(
                    f"{frame.where}: a focal length of {focal:.4g} pixels does not fit images of {stated}; it must be "
                    f"{MIN_FOCAL:g} to {MAX_FOCAL:g} times the longer side, in pixels of that size."
                )
        if not scales_to(size, lens.size):
            sideways = scales_to(size[::-1], lens.size)
            advice = "turn it, or give the camera of the turned image" if sideways else "give the camera of this image"
            raise InputError(
                f"{frame.image} is {size_text(size)} pixels, but {frame.where} states {stated}, which has other "
                f"proportions{', those of the image on its side' if sideways else ''}; {advice}."
            )
    first = frames[0].image
    for image in (frame.image for frame in frames):
        if image.size != first.size:
            raise InputError(
                f"{image} is {size_text(image.size)} pixels and {first} is {size_text(first.size)}; all images must "
                "have one size: crop or leave out those that differ."
            )


def usable_cloud(cloud: Cloud, cameras: Sequence[Camera], path: Path, warnings: list[str]) -> Cloud:
    """Check that a cloud and the training cameras use the same coordinates and scale. Raises InputError.

    Returns the cloud; of a scan that reaches far beyond what the cameras see, only what they see, with a warning.
    """
    points = cloud.points.astype(np.float64)
    centres = np.stack([camera.position for camera in cameras])
    middle = np.median(points, axis=0)
    spread = float(np.percentile(np.linalg.norm(points - middle, axis=1), 90))
    distance = float(np.median(np.linalg.norm(centres - middle, axis=1)))
    seen = views_of(points, cameras) > 0
    numbers = f"the cloud has a radius of {spread:.3g}, and the cameras stand {distance:.3g} away from it"
    if seen.mean() < MIN_SEEN:
        told = f"{path}: the training cameras see {100 * seen.mean():.0f} % of its points"
        if near_focus(points, cameras).sum() < FEW_POINTS:
            raise InputError(
                f"{told} (at least {100 * MIN_SEEN:.0f} % are expected), and hardly any where they look: {numbers}; it "
                "is in other coordinates than the cameras: transform it to theirs, or remove it."
            )
        warnings.append(f"{told}: of {len(points)}, {len(points) - seen.sum()} are left out.")
        return Cloud(cloud.points[seen], cloud.colors[seen])
    if len(points) > 1 and spread < MIN_SPREAD * distance:
        raise InputError(f"{path} is a speck: {numbers}; scale it to the cameras, or remove it.")
    return cloud


def check_times(dataset: Dataset, *, moving: bool) -> list[str]:
    """Warn about training times that are few, repeated, or missing from a part of the clip.

    moving: whether the field models motion; if not, times are ignored. Raises InputError if all times are equal.
    """
    times, count, source = dataset.times, len(dataset.train), f"{dataset.name}: {dataset.time_source}"
    if not moving:
        return []
    if len(times) == 1:
        raise InputError(
            f"{source}: all {count} training images have the same time, {times[0]:g}, so "
            "nothing can move: train with --field static, or give each image its time."
        )
    warnings = []
    if len(times) < FEW_TIMES:
        listed = ", ".join(f"{time:g}" for time in times)
        warnings.append(
            f"{source}: {count} training images have only {len(times)} different times ({listed}), so the motion "
            f"between them is a guess; give at least {FEW_TIMES} times, or train with --field static."
        )
    else:
        edges = np.concatenate([[0.0], times, [1.0]])
        gaps, usual = np.diff(edges), float(np.median(np.diff(times)))
        longest = int(np.argmax(gaps))
        if gaps[longest] > max(GAP, GAP_FACTOR * usual):
            low, high = edges[longest : longest + 2]
            tested = sum(low < view.time < high for view in dataset.test)
            warnings.append(
                f"{source}: no training image has a time between {low:.4g} and {high:.4g}, though the usual step is "
                f"{usual:.2g}; the motion of {tested} test images there is unconstrained: add images, or cut the clip."
            )
    first: dict[tuple[bytes, bytes, float], View] = {}
    keys = [(view.camera.K.tobytes(), view.camera.T_cam_world.tobytes(), view.time) for view in dataset.train]
    pairs = [(first.setdefault(key, view), view) for key, view in zip(keys, dataset.train, strict=True)]
    repeated = [(before, view) for before, view in pairs if before is not view]
    if repeated:
        before, view = repeated[0]
        warnings.append(
            f"{source}: {len(repeated)} of {count} training images repeat the time of another image of their camera, "
            f"such as {view.name} and {before.name} at {view.time:g}, and are averaged; correct times, or remove them."
        )
    return warnings


def check_in_view(dataset: Dataset, points: NDArray[np.floating]) -> list[str]:
    """Warn about times at which no training view shows the scene.

    points: (N, 3) means of the initial Gaussians, world units. Raises InputError if no view shows any.
    """
    seeing = {camera for camera in dataset.cameras if in_view(points, camera)[1].any()}
    if not seeing:
        box = ", ".join(f"{along.min():.3g} to {along.max():.3g}" for along in points.T)
        raise InputError(
            f"{dataset.name}: none of {len(dataset.train)} training cameras sees where the first Gaussians lie ({box} "
            "along x, y, z); check the poses and their axes, or raise points.box and field.bound."
        )
    shown = {view.time for view in dataset.train if view.camera in seeing}
    blind = [view for view in dataset.train if view.time not in shown]
    if not blind:
        return []
    return [
        f"{dataset.name}: all cameras look away at {len({view.time for view in blind})} of {len(dataset.times)} times: "
        f"{some([view.name for view in blind])} show nothing of the scene, so its motion there is a guess; check "
        "these poses, or remove these images."
    ]


def check_spacing(dataset: Dataset) -> list[str]:
    """Warn about still cameras too far apart for views between them."""
    apart = degrees_apart(dataset.cameras, dataset.focus) if dataset.is_rig else 0.0
    told = (
        f"{dataset.name}: {len(dataset.cameras)} still cameras are {apart:.0f} degrees apart, seen from what they look "
        f"at, over {FAR_APART:g}: none confirms another one's depths, and views between show blobs; add cameras there."
    )
    return [told] if apart > FAR_APART else []


def check_views(cloud: Cloud, named: Mapping[Camera, str], where: Path) -> list[str]:
    """Warn about cameras that see no point of the cloud or hardly move, and about a sparse cloud.

    named: an image of each camera, in the coordinates of the cloud. Raises InputError if more than half see no point.
    """
    points, cameras = cloud.points.astype(np.float64), list(named)
    blind = [name for camera, name in named.items() if not in_view(points, camera)[1].any()]
    if 2 * len(blind) > len(cameras):
        raise InputError(
            f"{where}: cameras look away from the cloud: {len(blind)} of {len(cameras)} see none of its {len(points)} "
            f"points; {AXES_HINT}, or cloud and cameras have different coordinates or scales."
        )
    warnings = []
    if blind:
        warnings.append(
            f"cameras look away from the cloud: {some(blind)} see none of its {len(points)} points ({len(blind)} of "
            f"{len(cameras)} cameras); their poses may be wrong."
        )
    if len(points) < FEW_POINTS:
        warnings.append(
            f"the cloud is sparse: {where} holds {len(points)} points (at least {FEW_POINTS} are usual); more texture, "
            "more images or larger ones give more."
        )
    centres = np.stack([camera.position for camera in cameras])
    reach = spread(cameras)
    distance = float(np.median(np.linalg.norm(np.median(points, axis=0) - centres, axis=1)))
    if reach < STANDING * distance:
        warnings.append(
            f"the cameras hardly move: they lie within {reach:.3g} of each other, {distance:.3g} away from the cloud, "
            "so depth cannot be told; walk around what moves."
        )
    return warnings
