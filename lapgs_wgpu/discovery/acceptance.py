"""Which of the parts that were followed a training starts with.

A part must show where something moves, or, where several cameras see each time, bring the static fit nearer to the
images. Patches of what the static fit only blurs do neither, though they can be followed.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.initial_gaussians import initial_scales
from lapgs_wgpu.discovery.residual import Residual
from lapgs_wgpu.discovery.surface_points import PointClouds
from lapgs_wgpu.discovery.tracks import Tracks
from lapgs_wgpu.motion.scene import Scene4D, isotropic_rows

OPACITY = 0.3  # of the Gaussian of a track
SCALE = 0.4  # of it, in mean distances to its nearest neighbours; more of them lie behind one another
SHEET_SCALE, SHEET_OPACITY = 1.2, 0.9  # the same of parts that are sheets
IMAGES = 60  # by which a part is judged, at most
CHANGED = 2.0 / 255  # of a pixel's channel, from which on a part shows there
MOVING = 0.5  # share of the pixels in which a part shows that move, at least
GAIN = 0.05  # or share of the static fit's error there that it takes away: where several images show each time
NEAR = 0.1  # box half sides; distance within which a track explains a surface point


def rows_with(static: Scene4D, tracks: Tracks, *, sheets: bool = False) -> dict[str, Tensor]:
    """The Gaussians of the static fit, then one for each track at its place at the key time: the parameters of a scene
    without a field, float32. sheets: whether each part is a sheet of its own, which nothing lies behind."""
    scale, opacity = (SHEET_SCALE, SHEET_OPACITY) if sheets else (SCALE, OPACITY)
    apart = tracks.part if sheets else np.zeros_like(tracks.part)
    scales = np.empty(len(apart), np.float32)
    for k in np.unique(apart):
        scales[apart == k] = scale * initial_scales(tracks.positions[apart == k])
    new = isotropic_rows(tracks.positions, tracks.colors, scales, opacity)
    return {name: torch.cat([static.parameters[name].detach(), values]) for name, values in new.items()}


def tracks_in_images(
    tracks: Tracks,
    times: NDArray[np.float64],
    images: Sequence[Residual],
    static: Scene4D,
    background: float,
    *,
    together: bool,
) -> Tracks | None:
    """The parts that, each by itself, show where something moves; None where there are none.

    times: (T,), of the tracks. background: level of its channels. together: whether several images of the capture show
    each time. Their depths then agree whatever moves, and a part that brings the static fit nearer to the images is
    kept, too.
    """
    kept, level = np.zeros(tracks.parts, bool), torch.full((3,), background)
    for k in range(len(kept)):
        part = tracks.rows(tracks.part == k)
        scene = Scene4D(rows_with(static, part), static.field_config, static.device, sh_degree=static.sh_degree)
        scene.antialiased = static.antialiased
        means, sums = scene.parameters["means"].detach()[len(static) :], np.zeros(4)
        for image in evenly(images, IMAGES):
            means[:] = torch.from_numpy(part.paths[np.searchsorted(times, image.time)])
            rendered = scene.render(image.camera, image.time, level, depth=False).image.numpy(force=True)
            shows = np.abs(rendered - image.still).max(axis=2) > CHANGED
            errors = (np.abs(each - image.image)[shows].sum() for each in (image.still, rendered))
            sums += shows.sum(), (shows & image.mask).sum(), *errors
        pixels, moving, before, after = sums
        gain = 1.0 - after / max(before, 1e-6)
        kept[k] = moving / max(pixels, 1) >= MOVING or (together and gain >= GAIN)
    return tracks.of_parts(kept)


def explained_share(clouds: PointClouds, tracks: Tracks | None) -> float:
    """Of the surface points, those that lie on a track."""
    if tracks is None:
        return 0.0
    near = sum(int((distances < NEAR * clouds.half_side).sum()) for distances, _ in clouds.nearest(tracks.paths))
    return near / max(clouds.total, 1)
