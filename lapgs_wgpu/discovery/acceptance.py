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
    judges = evenly(images, IMAGES)
    parts = (tracks.rows(tracks.part == k) for k in range(tracks.parts))
    shares = [_shares(part, times, judges, static, background) for part in parts]
    return tracks.of_parts(np.array([moving >= MOVING or (together and gain >= GAIN) for moving, gain in shares]))


def _shares(
    part: Tracks, times: NDArray[np.float64], images: Sequence[Residual], static: Scene4D, background: float
) -> tuple[float, float]:
    """Of the pixels in which a part shows, those that move; and of the static fit's error there (sum of absolute
    differences), what it takes away."""
    scene = Scene4D(
        rows_with(static, part),
        static.field_config,
        static.device,
        sh_degree=static.sh_degree,
        antialiased=static.antialiased,
    )
    level = torch.full((3,), background)
    pixels, moving, before, after = 0, 0, 0.0, 0.0
    for image in images:
        with torch.no_grad():
            path = torch.from_numpy(part.paths[np.searchsorted(times, image.time)])
            scene.parameters["means"][len(static) :] = path
            rendered = scene.render(image.camera, image.time, level, depth=False).image.numpy(force=True)
        shows = np.abs(rendered - image.still).max(axis=2) > CHANGED
        pixels, moving = pixels + int(shows.sum()), moving + int((shows & image.mask).sum())
        before += float(np.abs(image.still - image.image)[shows].sum())
        after += float(np.abs(rendered - image.image)[shows].sum())
    return moving / max(pixels, 1), 1.0 - after / max(before, 1e-6)


def explained_share(clouds: PointClouds, tracks: Tracks | None) -> float:
    """Of the surface points, those that lie on a track."""
    if tracks is None:
        return 0.0
    near = sum(int((distances < NEAR * clouds.half_side).sum()) for distances, _ in clouds.nearest(tracks.paths))
    return near / max(clouds.total, 1)
