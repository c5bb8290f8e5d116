"""What goes wrong with captures of one's own: measured before a training starts, and told with numbers.

Where a training is hopeless, InputError; else a sentence each.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lapgs_wgpu.data.cloud import Cloud, in_view, views_of
from lapgs_wgpu.data.pictures import PICTURE_ERRORS, PICTURE_FORMATS
from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.splat.camera import Camera

THUMBNAIL = 320  # longer side in pixels: what is blurred there is blurred for a training, too
BLURRED = 0.3  # of the sharpness of the pictures before and after
AROUND = 5  # so many pictures before, and after
EQUAL = 3  # levels of 255 by which no pixel of a repeated picture differs: above noise once it is shrunk
NAMED = 5  # pictures that a warning names
STANDING = 0.01  # cameras spread less than this, in distances from the cloud, see no depth
FEW_POINTS = 100
FEW_TIMES = 5  # fewer different times do not show how anything moves
GAP, GAP_FACTOR = 0.1, 4.0  # a gap is longer than so much of the clip, and than so many usual steps


def check_times(dataset: Dataset, *, moving: bool) -> list[str]:
    """Warnings about training times that are few, repeated, or missing from a part of the clip.

    moving: whether the field moves anything; if not, times do not matter. Raises InputError where all times are equal.
    """
    times, count, source = dataset.times, len(dataset.train), f"{dataset.name}: {dataset.time_source}"
    if not moving:
        return []
    if len(times) == 1:
        raise InputError(
            f"{source}: all {count} training pictures have the same time, {times[0]:g}, so "
            "nothing can move: train with --field static, or give each picture its time."
        )
    warnings = []
    if len(times) < FEW_TIMES:
        listed = ", ".join(f"{time:g}" for time in times)
        warnings.append(
            f"{source}: {count} training pictures have only {len(times)} different times ({listed}), so the motion "
            f"between them is a guess; give at least {FEW_TIMES} times, or train with --field static."
        )
    else:
        warnings += _gaps(dataset, source)
    first: dict[tuple[bytes, bytes, float], str] = {}
    repeated = []
    for view in dataset.train:
        camera = view.camera
        before = first.setdefault((camera.K.tobytes(), camera.T_cam_world.tobytes(), view.time), view.name)
        if before != view.name:
            repeated.append((before, view))
    if repeated:
        before, view = repeated[0]
        warnings.append(
            f"{source}: {len(repeated)} of {count} training pictures repeat the time of another picture of the same "
            f"camera, such as {view.name} and {before} at {view.time:g}; the training averages them, so give each "
            "picture its own time, or remove it."
        )
    return warnings


def _gaps(dataset: Dataset, source: str) -> list[str]:
    """A warning about the longest part of the clip [0, 1] without any training view."""
    times = dataset.times
    edges = np.concatenate([[0.0], times, [1.0]])
    gaps = np.diff(edges)
    usual = float(np.median(np.diff(times)))
    found = np.flatnonzero((gaps > GAP) & (gaps > GAP_FACTOR * usual))
    if not len(found):
        return []
    longest = found[np.argmax(gaps[found])]
    low, high = edges[longest], edges[longest + 1]
    tested = sum(low < view.time < high for view in dataset.test)
    others = f" ({len(found) - 1} more such gaps)" if len(found) > 1 else ""
    return [
        f"{source}: no training picture has a time between {low:.4g} and {high:.4g}, though the usual step is "
        f"{usual:.2g}{others}; the motion there, in {tested} test pictures too, is a guess: add pictures, or cut "
        "the clip there."
    ]


def check_in_view(dataset: Dataset, points: NDArray[np.floating]) -> list[str]:
    """A warning about the longest span of time in which no training view shows the scene.

    points: (N, 3) where the first Gaussians lie, world units. Raises InputError where no view ever does.
    """
    seen: dict[int, bool] = {}
    blind: dict[float, bool] = {}  # time -> whether all views of that time are
    for view in dataset.train:
        key = id(view.camera)
        if key not in seen:
            seen[key] = bool(in_view(points, view.camera)[1].any())
        blind[view.time] = blind.get(view.time, True) and not seen[key]
    if not any(seen.values()):
        low, high = points.min(axis=0), points.max(axis=0)
        box = ", ".join(f"{a:.3g} to {b:.3g}" for a, b in zip(low, high, strict=True))
        raise InputError(
            f"{dataset.name}: none of {len(dataset.train)} training cameras sees where the first Gaussians lie ({box} "
            "along x, y, z); check the poses and their axes, or raise points.box and field.bound."
        )
    spans: list[list[float]] = []
    before = False
    for time in sorted(blind):
        if blind[time]:
            if before:
                spans[-1].append(time)
            else:
                spans.append([time])
        before = blind[time]
    if not spans:
        return []
    longest = max(spans, key=len)
    names = [view.name for view in dataset.train if longest[0] <= view.time <= longest[-1]]
    others = f" ({len(spans) - 1} more such spans)" if len(spans) > 1 else ""
    return [
        f"{dataset.name}: all cameras look away from time {longest[0]:.4g} to {longest[-1]:.4g}{others}: "
        f"{_named(names)} show nothing of the scene, so its motion there is a guess; check these poses, or remove "
        "these pictures."
    ]


def check_views(cloud: Cloud, cameras: Sequence[Camera], names: Sequence[str], where: Path, axes: str) -> list[str]:
    """Warnings about cameras that see nothing of the cloud, that hardly move, and of a sparse cloud; InputError where
    more than half of the cameras look away from it.

    All in the same coordinates. names: of the cameras' pictures. axes: advice for cameras that look the wrong way.
    """
    points = cloud.points.astype(np.float64)
    seen = np.array([views_of(points, [camera]).sum() for camera in cameras])
    blind = np.flatnonzero(seen == 0).tolist()
    if 2 * len(blind) > len(cameras):
        back = [Camera(c.K, np.diag([1.0, -1, -1, 1]) @ c.T_cam_world, c.width, c.height) for c in cameras]
        turned = float(np.mean([views_of(points, [camera]).any() for camera in back]))
        hint = f"; turned round, {100 * turned:.0f} % of them would see some: {axes}" if turned > 0.5 else ""
        raise InputError(
            f"{where}: cameras look away from the cloud: {len(blind)} of {len(cameras)} see none of its {len(points)} "
            f"points{hint or '; cloud and cameras have different coordinates or scales'}."
        )
    warnings = []
    if len(blind):
        warnings.append(
            f"cameras look away from the cloud: {_named([names[i] for i in blind])} see none of its {len(points)} "
            f"points ({len(blind)} of {len(cameras)} cameras); their poses may be wrong."
        )
    if len(points) < FEW_POINTS:
        warnings.append(
            f"the cloud is sparse: {where} holds {len(points)} points (at least {FEW_POINTS} are usual); more texture, "
            "more pictures or larger ones give more."
        )
    centres = np.stack([camera.position for camera in cameras])
    spread = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
    distance = float(np.median(np.linalg.norm(np.median(points, axis=0) - centres, axis=1)))
    if spread < STANDING * distance:
        warnings.append(
            f"the cameras hardly move: they lie within {spread:.3g} of each other, {distance:.3g} away from the cloud, "
            "so depth cannot be told; walk around what moves."
        )
    return warnings


def check_film(pictures: Sequence[Path]) -> list[str]:
    """Warnings about pictures, in the order in which one camera took them, that are blurred or repeated."""
    from scipy.ndimage import laplace  # slow to import

    if len(pictures) < 3:
        return []
    with ThreadPoolExecutor(4, thread_name_prefix="thumbnails") as pool:
        thumbnails = list(pool.map(_thumbnail, pictures))
    sharpness = np.array([laplace(image).var() for image in thumbnails])
    warnings = []
    blurred = []
    for i, value in enumerate(sharpness):
        around = np.delete(sharpness[max(i - AROUND, 0) : i + AROUND + 1], min(i, AROUND))
        if value < BLURRED * np.median(around):
            blurred.append((pictures[i].name, value / np.median(around)))
    if blurred:
        name, share = min(blurred, key=lambda entry: entry[1])
        warnings.append(
            f"blurred pictures: {_named([name for name, _ in blurred])} ({len(blurred)} of {len(pictures)}) have less "
            f"than {BLURRED:g} of their neighbours' sharpness, {name} {share:.2g}; leave them out."
        )
    repeated = [
        pictures[i].name
        for i in range(1, len(pictures))
        if thumbnails[i].shape == thumbnails[i - 1].shape and np.abs(thumbnails[i] - thumbnails[i - 1]).max() <= EQUAL
    ]
    if repeated:
        warnings.append(
            f"repeated pictures: {_named(repeated)} ({len(repeated)} of {len(pictures)}) differ by at most {EQUAL} of "
            "255 levels from the picture before; motion stands still there, so leave them out."
        )
    return warnings


def _thumbnail(path: Path) -> NDArray[np.float32]:
    """Grey levels of a small version of a picture; JPEG is decoded at a fraction of its size."""
    try:
        with Image.open(path, formats=PICTURE_FORMATS) as file:
            file.draft("L", (THUMBNAIL, THUMBNAIL))
            picture = file.convert("L")
            picture.thumbnail((THUMBNAIL, THUMBNAIL), Image.Resampling.BOX)
            return np.asarray(picture, dtype=np.float32)
    except PICTURE_ERRORS as error:
        raise InputError(f"{path} cannot be decoded as a picture ({error}); copy or render it again.") from None


def _named(names: Sequence[str]) -> str:
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more
