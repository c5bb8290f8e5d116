"""Which of the parts that were followed a training starts with.

A part must bring the static fit nearer to the images, or at least change it in the right direction or largely where
something moves: patches of what the static fit only blurs do not, though they can be followed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from lapgs_wgpu.data.initial_gaussians import initial_scales
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.constants import CONSTANTS

from .residual import Residual
from .surface_points import PointClouds
from .tracks import Tracks

OPACITY = 0.3  # of the Gaussian of a track
SCALE = 0.8  # of it, in mean distances to its nearest neighbours
IMAGES = 60  # by which a part is judged, at most
CHANGED = 2.0 / 255  # of a pixel's channel, from which on a part changes it
RIGHT = 0.75  # share of a part's change that is right, from which on it needs no gain
RIGHT_TOGETHER = 0.5  # the same where several images show each time: their depths agree, whatever moves
LARGELY = 0.42  # share of the pixels that a part changes that move, from which on it needs no gain
NEAR = 0.1  # box half sides; distance within which a track explains a surface point


def track_gaussians(tracks: Tracks) -> dict[str, Tensor]:
    """A Gaussian for each track, at its place at the key time: the parameters of a scene without a field, float32."""
    count = len(tracks.part)
    scales = SCALE * initial_scales(tracks.positions)
    rows = {
        "means": torch.from_numpy(tracks.positions),
        "log_scales": torch.from_numpy(np.log(scales))[:, None].repeat(1, 3),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        "opacity_logits": torch.full((count,), float(np.log(OPACITY / (1 - OPACITY)))),
        "sh_dc": (torch.from_numpy(tracks.colors) - 0.5)[:, None] / CONSTANTS["SH_C0"],
        "sh_rest": torch.zeros(count, 15, 3),
    }
    return {name: values.float() for name, values in rows.items()}


def rows_with(static: Scene4D, tracks: Tracks) -> dict[str, Tensor]:
    """The Gaussians of the static fit, then those of the tracks, in host memory."""
    new = track_gaussians(tracks)
    return {name: torch.cat([static.parameters[name].detach().cpu(), values]) for name, values in new.items()}


def tracks_in_images(
    tracks: Tracks, times: NDArray[np.float64], images: Sequence[Residual], static: Scene4D, background: float
) -> Tracks | None:
    """The parts that, each by itself, bring the static fit nearer to the images; None where there are none.

    The soft rims of a part's Gaussians may cost more than the part gains: around a pale shadow, or in front of texture.
    So a part is kept, too, whose change of the images is right by RIGHT or RIGHT_TOGETHER at least (that much of it
    brings them nearest, by squared differences), or which changes largely moving pixels.

    times: (T,), of the tracks. background: level of its channels.
    """
    judges = [images[i] for i in np.linspace(0, len(images) - 1, min(len(images), IMAGES)).astype(np.int64)]
    least_right = RIGHT if 2 * len(times) > len(images) else RIGHT_TOGETHER
    kept = np.zeros(int(tracks.part.max()) + 1, bool)
    for k in range(len(kept)):
        part = tracks.of_parts(np.arange(len(kept)) == k)
        assert part is not None
        kept[k] = _improves(part, times, judges, static, background, least_right)
    return tracks.of_parts(kept)


def _improves(
    part: Tracks,
    times: NDArray[np.float64],
    images: Sequence[Residual],
    static: Scene4D,
    background: float,
    least_right: float,
) -> bool:
    """Whether a part, beside the static fit, gains, is right by least_right, or changes largely what moves."""
    scene = Scene4D(
        rows_with(static, part),
        static.field_config,
        static.device,
        sh_degree=static.sh_degree,
        antialiased=static.antialiased,
    )
    level = torch.full((3,), background)
    gain, agreeing, change, changed, moving = 0.0, 0.0, 0.0, 0, 0
    for image in images:
        with torch.no_grad():
            path = torch.from_numpy(part.paths[np.searchsorted(times, image.time)])
            scene.parameters["means"][len(static) :] = path
            rendered = scene.render(image.camera, image.time, level, depth=False).image.numpy(force=True)
        gain += image.error - image.error_of(rendered)
        difference = rendered - image.still
        agreeing += float((difference * (image.image - image.still)).sum())
        change += float(np.square(difference).sum())
        where = np.abs(difference).max(axis=2) > CHANGED
        changed, moving = changed + int(where.sum()), moving + int((where & image.mask).sum())
    right, largely = 0 < least_right * change <= agreeing, 0 < LARGELY * changed <= moving
    return gain > 0 or right or largely


def explained_share(clouds: PointClouds, tracks: Tracks, half_side: float) -> float:
    """Of the surface points, those that lie on a track."""
    near = 0
    for cloud, path in zip(clouds.clouds, tracks.paths, strict=True):
        if len(cloud.scores):
            near += int((cKDTree(path).query(cloud.positions)[0] < NEAR * half_side).sum())
    return near / max(clouds.total, 1)
