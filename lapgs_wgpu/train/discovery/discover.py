"""What a training starts from: the static fit, and what it loses of the things that move."""

from __future__ import annotations

import time
from typing import NamedTuple, TextIO

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import nn

from lapgs_wgpu.data.initial_gaussians import initial_scales
from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.progress import Progress
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.splat.morton import morton_order
from lapgs_wgpu.splat.rotation import rotation_matrices
from lapgs_wgpu.train.camera_refinement import Corrections
from lapgs_wgpu.train.config import Config

from .field_fit import fit_field
from .residual import Floats
from .static_fit import MakeTrainer, static_fit
from .surface_points import PointClouds, surface_points
from .tracks import Tracks, find_tracks

OPACITY = 0.3  # of a discovered Gaussian
SCALE = 0.8  # of it, in mean distances to its nearest neighbours
DYNAMICS = 0.5  # standard deviation of its dynamics attribute, which it shares with its part
EMPTY = 0.1  # opacity of the static fit, below which a place counts as empty
LOST = 0.5  # share of the times at which a part is seen that it is where the static fit is empty, at least
PROBES = 24  # of a part's points that are looked at, about
BLOCK = 256  # points whose densities are computed together
OPAQUE = 0.1  # least opacity of a Gaussian of the static fit that is looked at
NEAR = 0.1  # box half sides; distance within which a track explains a surface point
NEARLY_ALL = 0.8  # share of the surface points that tracks explain, above which the field has little left to learn
SHOWN = 2.0 / 255  # least difference from the background of an image that shows something


class Discovery(NamedTuple):
    """scene: to start from. fitted: whether its field knows nearly all that moves. summary: what was found, a line.
    corrections: of the dataset's cameras; None where they are kept."""

    scene: Scene4D
    fitted: bool
    summary: str
    corrections: Corrections | None


def discover(
    config: Config,
    dataset: Dataset,
    device: Device,
    trainer: MakeTrainer,
    terminal: TextIO | None = None,
    own_field: nn.Module | None = None,
) -> Discovery:
    """Find what moves, and build the scene that a training starts from.

    It holds the Gaussians of the static fit and those of the tracks, if there are any, and a field that moves the
    latter. trainer: makes the training of the static fit. own_field: of Scene4D.

    The same configuration and capture give the same scene. Raises InputError where the images show nothing at all.
    """
    started = time.perf_counter()
    steps = config.discovery.steps
    fit_steps = config.discovery.field_steps
    meter = Progress(steps + fit_steps, "steps of motion discovery", terminal)
    static, images, corrections = static_fit(config, dataset, device, trainer, meter.at)
    background = 1.0 if config.data.background == "white" else 0.0
    if all(float(np.abs(image.image - background).max()) < SHOWN for image in images):
        raise InputError(
            f"{dataset.train[0].source} and the other {len(dataset.train) - 1} training images show nothing but the "
            f"{config.data.background} background; check the images and data.background."
        )
    half_side = config.points.box
    clouds = surface_points(images, half_side)
    tracks = find_tracks(clouds, half_side)
    tracks = None if tracks is None else lost_tracks(tracks, static)
    share = 0.0 if tracks is None else explained_share(clouds, tracks, half_side)
    if share < config.discovery.least:
        tracks = None
    generator = torch.Generator().manual_seed(config.seed)
    scene = scene_with(static, tracks, config, device, generator, own_field)
    found = f"{share:.1%} of what it lacks can be followed: nothing is added"
    if tracks is not None:
        error = fit_field(scene, tracks, clouds.times, len(static), fit_steps, generator, lambda s: meter.at(steps + s))
        found = (
            f"{len(np.unique(tracks.part))} moving parts with {len(tracks.part)} Gaussians, {share:.0%} of what it "
            f"lacks, followed within {error:.3f} world units"
        )
    order = morton_order(scene.parameters["means"].detach())
    for name, values in scene.parameters.items():
        scene.parameters[name] = torch.nn.Parameter(values.detach()[order])
    meter.clear()
    seconds = time.perf_counter() - started
    summary = f"discovery: a static fit of {len(static)} Gaussians; {found}; {seconds:.0f} s"
    return Discovery(scene, tracks is not None and share >= NEARLY_ALL, summary, corrections)


def lost_tracks(tracks: Tracks, static: Scene4D) -> Tracks | None:
    """The parts that are, mostly, where the static fit is empty; None where there are none."""
    lost = np.zeros(int(tracks.part.max()) + 1, bool)
    for k in range(len(lost)):
        members = np.flatnonzero(tracks.part == k)
        probes = members[:: -(-len(members) // PROBES)]
        seen = tracks.paths[:, probes][tracks.supported[:, probes]]
        lost[k] = (density_at(static, seen) < EMPTY).mean() > LOST if len(seen) else False
    return tracks.of_parts(lost)


def density_at(static: Scene4D, points: Floats) -> NDArray[np.float32]:
    """(n,) density of the static fit at points (n, 3): the sum over its Gaussians of opacity times falloff."""
    with torch.no_grad():
        gaussians = static.canonical()
        opaque = gaussians.opacities.cpu() > OPAQUE
        means, opacities = gaussians.means.cpu()[opaque], gaussians.opacities.cpu()[opaque]
        # Gaussian axes in columns, divided by the scales: a point times these is its distance in standard deviations.
        axes = rotation_matrices(gaussians.quats.cpu()[opaque]) / gaussians.scales.cpu()[opaque, None]
        at_means = torch.einsum("gi,gij->gj", means, axes)
        total = [
            (
                opacities * torch.exp(-0.5 * (torch.einsum("ni,gij->ngj", some, axes) - at_means).square().sum(dim=2))
            ).sum(dim=1)
            for some in torch.from_numpy(points).float().split(BLOCK)
        ]
    return torch.cat(total).numpy()


def explained_share(clouds: PointClouds, tracks: Tracks, half_side: float) -> float:
    """Of the surface points, those that lie on a track."""
    near = 0
    for cloud, path in zip(clouds.clouds, tracks.paths, strict=True):
        if len(cloud.scores):
            near += int((cKDTree(path).query(cloud.positions)[0] < NEAR * half_side).sum())
    return near / max(clouds.total, 1)


def scene_with(
    static: Scene4D,
    tracks: Tracks | None,
    config: Config,
    device: Device,
    generator: torch.Generator,
    own_field: nn.Module | None = None,
) -> Scene4D:
    """The static fit's Gaussians, then one for each track; the field does not move them yet."""
    size = config.field.dynamics_size
    rows = {name: values.detach().cpu() for name, values in static.parameters.items()}
    rows["dynamics"] = torch.zeros(len(static), size)
    if tracks is not None:
        count = len(tracks.part)
        scales = SCALE * initial_scales(tracks.positions)
        of_part = DYNAMICS * torch.randn(int(tracks.part.max()) + 1, size, generator=generator)
        new = {
            "means": torch.from_numpy(tracks.positions),
            "log_scales": torch.from_numpy(np.log(scales))[:, None].repeat(1, 3),
            "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
            "opacity_logits": torch.full((count,), float(np.log(OPACITY / (1 - OPACITY)))),
            "sh_dc": (torch.from_numpy(tracks.colors) - 0.5)[:, None] / CONSTANTS["SH_C0"],
            "sh_rest": torch.zeros(count, 15, 3),
            "dynamics": of_part[torch.from_numpy(tracks.part)],
        }
        rows = {name: torch.cat([rows[name], values.float()]) for name, values in new.items()}
    return Scene4D(rows, config.field, device, sh_degree=static.sh_degree, seed=config.seed, own_field=own_field)
