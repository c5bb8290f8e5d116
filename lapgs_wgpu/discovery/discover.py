"""The start of a training: what stands still, and the things that move, which a fit of it loses; then a Trainer.

Of the parts that were followed it takes those that show where something moves, or, where several cameras see each time,
bring the static fit nearer to the images. Patches of what the static fit only blurs do neither.
"""

import sys
import time
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lapgs_wgpu.data.evenly import evenly
from lapgs_wgpu.data.initial_gaussians import initial_scales
from lapgs_wgpu.data.views import Dataset
from lapgs_wgpu.discovery.cutouts import cutout_tracks
from lapgs_wgpu.discovery.field_fit import SHEET_DYNAMICS, fit_field
from lapgs_wgpu.discovery.residual import Floats, Residual
from lapgs_wgpu.discovery.rigid_fit import rigid_tracks
from lapgs_wgpu.discovery.static_fit import static_fit
from lapgs_wgpu.discovery.surface_points import PointClouds, surface_points
from lapgs_wgpu.discovery.tracks import Tracks, find_tracks
from lapgs_wgpu.discovery.turns import find_turns
from lapgs_wgpu.discovery.visual_hull import hull_points
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.own_field import check_own
from lapgs_wgpu.motion.scene import Scene4D, isotropic_rows
from lapgs_wgpu.progress import Progress
from lapgs_wgpu.splat.morton import morton_order
from lapgs_wgpu.train.camera_refinement import Corrections
from lapgs_wgpu.train.config import BACKGROUND_LEVELS, Config
from lapgs_wgpu.train.host import step_threads, torch_threads
from lapgs_wgpu.train.parts import Parts
from lapgs_wgpu.train.setup import Start, set_up, start_from_points
from lapgs_wgpu.train.trainer import Trainer

DYNAMICS = 0.5  # standard deviation of the dynamics attribute of a discovered Gaussian, which it shares with its part
NEARLY_ALL = 0.8  # share of the surface points that tracks explain, from which on the field may have little to learn
CLOSELY = 0.033  # box half sides; how far it may then be from the tracks, if it has little to learn
ALL_TURN = 0.03  # of the field's highest rates, where all that moves turns: it forgets turns sooner than places
SHEETS = 0.01  # the same of sheets, of which few images show each
FIT_STEPS_PER_TIME = 30  # of `fit_field` on a rig, at least: what flies fast is lost by fewer
RAMP_STEPS = 200  # over which learning rates rise after discovery, where schedule.warm_up is 0
FOLLOWING = "motion discovery: following what moves from one time to the next"  # may take a minute
SHOWN = 2.0 / 255  # of a channel: least difference from the background, and by which a part changes a pixel
SCALE, OPACITY = 0.4, 0.3  # of a track's Gaussian, in distances to its neighbours: low, since more lie behind it
SHEET_SCALE, SHEET_OPACITY = 0.7, 0.9  # the same of parts that are sheets
MOVING = 0.5  # share of the pixels in which a part shows that move, at least
GAIN = 0.05  # or share of the static fit's error there that it takes away: where several images show each time
NEAR = 0.1  # box half sides; distance within which a track explains a surface point


def start_training(
    config: Config, dataset: Dataset | None = None, device: Device | None = None, *, parts: Parts | None = None
) -> Trainer:
    """Do motion discovery as the configuration says, and make the trainer that starts from what it finds.

    Discovery is left out where `discovery.enabled` is false, the field is static, or `schedule.steps` is not larger
    than `discovery.steps`, which a note on stderr tells, as it does where warm-up is all of a training.

    Args:
        config: as `load_config` gives it.
        dataset: None for the one that config.data names; a built-in scene is then written into the folder runs.
        device: None for the default adapter.
        parts: own field, losses, density control, learning rates and callbacks.

    Returns:
        The trainer before its first step.

    Raises:
        InputError: the configuration, the data and the parts do not fit each other, or the images show nothing.
    """
    parts = parts or Parts()
    user_config, resolved, dataset, device = set_up(config, dataset, device, parts)
    check_own(resolved.field, parts.field)
    start, steps, needed = None, resolved.schedule.steps, resolved.discovery.steps
    if resolved.discovery.enabled and resolved.field.kind != "static":
        if steps > needed:
            with torch_threads(step_threads(resolved.field, device)):
                start = discover(resolved, dataset, device, parts.field)
        else:
            reason = f"schedule.steps ({steps}) must be larger than discovery.steps ({needed})"
            print(f"note: motion discovery is left out: {reason}.", file=sys.stderr, flush=True)
    trainer = Trainer(user_config, dataset, device, start=start, parts=parts)
    if trainer.scene.field is not None and trainer.warm_up_steps >= steps:
        reason = f"schedule.steps ({steps}) must be larger than the warm-up ({trainer.warm_up_steps})"
        print(f"note: nothing moves in this training: {reason}.", file=sys.stderr, flush=True)
    return trainer


def discover(config: Config, dataset: Dataset, device: Device, own_field: nn.Module | None = None) -> Start:
    """Find what moves, and build the scene that a training starts from.

    It holds the Gaussians of the static fit, or initial ones between cameras all around, those of the tracks, if there
    are any, and a field that moves the latter. It moves from the first step on. The rates rise first: Adam's first
    steps, all of the size of the rate, would shake off what the field knows.

    config: resolved for the dataset. own_field: of Scene4D. The same configuration and capture give the same start.
    Raises InputError where the images show nothing at all.
    """
    started = time.perf_counter()
    generator = torch.Generator().manual_seed(config.seed)
    found = _in_hull(config, dataset, device) if dataset.is_surrounded else None
    found = found or _in_residuals(config, dataset, device, generator)
    if found.share < config.discovery.least:
        found = found._replace(tracks=None)
    scene = scene_with(found, config, generator, own_field)
    field_fitted, summary = 0.0, f"{found.share:.1%} of what it lacks can be followed: nothing is added"
    if (tracks := found.tracks) is not None:
        parts, bodies = len(np.unique(tracks.part)), len(found.light)
        steps = max(config.discovery.field_steps, FIT_STEPS_PER_TIME * len(found.times) if dataset.is_surrounded else 0)
        meter = Progress(steps, "steps of motion discovery, part 2 of 2: what moves")
        error = fit_field(scene, tracks, found.times, steps, generator, meter.at, fades=found.sheets, light=found.light)
        meter.clear()
        if error is None:
            summary = "the field cannot move what it lacks: nothing is added"
            scene = scene_with(found._replace(tracks=None), config, generator, own_field)
        else:
            summary = (
                f"{parts} moving parts with {len(tracks.part)} Gaussians, {found.share:.0%} of what it lacks, followed "
                f"within {error:.3f} world units" + (f", {bodies} of them as rigid bodies" if bodies else "")
            )
            if found.share >= NEARLY_ALL and error < CLOSELY * config.points.box:
                field_fitted = ALL_TURN if bodies == parts else SHEETS if found.sheets else 1.0
    order = morton_order(scene.parameters["means"].detach())
    for name, values in scene.parameters.items():
        scene.parameters[name] = nn.Parameter(values.detach()[order])
    return Start(
        scene,
        ramp_steps=config.schedule.warm_up or RAMP_STEPS,
        field_fitted=field_fitted,
        corrections=found.corrections,
        summary=f"{found.origin} of {len(found.static)} Gaussians; {summary}",
        seconds=time.perf_counter() - started,
    )


class Found(NamedTuple):
    """static: what stands still, and origin: in words. tracks: of what moves, over the times (T,), and the share of its
    points that they explain. light: on rigid bodies. sheets: whether parts are sheets. corrections: of cameras."""

    static: Scene4D
    tracks: Tracks | None
    times: NDArray[np.float64]
    share: float
    origin: str
    light: Mapping[int, Floats]
    sheets: bool = False
    corrections: Corrections | None = None


def _in_hull(config: Config, dataset: Dataset, device: Device) -> Found | None:
    """What moves between cameras all around, before initial points; None where nothing can be followed."""
    clouds = hull_points(dataset, config.points.box)
    meter = Progress(1, "")
    meter.at(1, lambda: FOLLOWING)
    tracks = find_tracks(clouds)
    meter.clear()
    share = explained_share(clouds, tracks)
    if share < config.discovery.least:
        return None
    return Found(start_from_points(config, dataset, device).scene, tracks, clouds.times, share, "a start", {})


def _in_residuals(config: Config, dataset: Dataset, device: Device, generator: torch.Generator) -> Found:
    """What moves where the training images differ from a static fit. Raises InputError where they show nothing."""
    half_side, steps = config.points.box, config.discovery.steps
    meter = Progress(steps, "steps of motion discovery, part 1 of 2: what stands still")
    static, images, depths, corrections = static_fit(config, dataset, device, meter.at)
    meter.at(steps, lambda: FOLLOWING)
    background = BACKGROUND_LEVELS[config.data.background]
    if all(float(np.abs(image.image - background).max()) < SHOWN for image in images):
        raise InputError(
            f"{dataset.train[0].source} and the other {len(dataset.train) - 1} training images show nothing but the "
            f"{config.data.background} background; check the images and data.background."
        )
    if depths is not None and not dataset.is_rig:  # a cut-out is of one camera
        tracks, share = cutout_tracks(images, depths, half_side)
        meter.clear()
        times = np.array([image.time for image in images])
        return Found(static, tracks, times, share, "a static fit", {}, sheets=True, corrections=corrections)
    clouds = surface_points(images, half_side)
    times, tracks, light = clouds.times, find_tracks(clouds), dict[int, Floats]()
    if tracks is not None:
        together = 2 * len(dataset.times) <= len(dataset.train)
        tracks = tracks_in_images(tracks, times, images, static, background, together=together)
    share = explained_share(clouds, tracks)
    if tracks is not None and share >= config.discovery.least:
        stands, turns = find_turns(tracks, times, images)
        if turns:
            tracks, light = rigid_tracks(tracks, stands, turns, times, images, device, generator)
    meter.clear()
    return Found(static, tracks, times, share, "a static fit", light, corrections=corrections)


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
    each time. Their depths then agree whatever moves, and a part is kept that brings the static fit nearer to images.
    """
    kept, level = np.zeros(tracks.parts, bool), torch.full((3,), background)
    for k in range(len(kept)):
        part = tracks.rows(tracks.part == k)
        scene = Scene4D(rows_with(static, part), static.field_config, static.device, sh_degree=static.sh_degree)
        scene.antialiased = static.antialiased
        means, sums = scene.parameters["means"].detach()[len(static) :], np.zeros(4)
        for image in evenly(images, 60):
            means[:] = torch.from_numpy(part.paths[np.searchsorted(times, image.time)])
            rendered = scene.render(image.camera, image.time, level, depth=False).image.numpy(force=True)
            shows = np.abs(rendered - image.still).max(axis=2) > SHOWN
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


def scene_with(found: Found, config: Config, generator: torch.Generator, own_field: nn.Module | None) -> Scene4D:
    """The Gaussians of what stands still, then one for each track; the field does not move them yet."""
    static, tracks, size = found.static, found.tracks, config.field.dynamics_size
    rows: dict[str, Tensor] = dict(static.parameters)
    dynamics = torch.zeros(len(static), size)
    if tracks is not None:
        rows = rows_with(static, tracks, sheets=found.sheets)
        of_part = DYNAMICS * torch.randn(tracks.parts, size, generator=generator)
        if found.sheets and size > 1:  # shown one after another, which the field can tell by these
            for k in range(tracks.parts):
                seen = tracks.supported[:, tracks.part == k][:, 0]
                middle = float(np.average(np.linspace(-1, 1, len(seen)), weights=seen))
                of_part[k, :2] = SHEET_DYNAMICS * torch.tensor([1.0, middle])
        dynamics = torch.cat([dynamics, of_part[torch.from_numpy(tracks.part)]])
    return Scene4D(
        rows | {"dynamics": dynamics},
        config.field,
        static.device,
        sh_degree=static.sh_degree,
        antialiased=static.antialiased,
        seed=config.seed,
        own_field=own_field,
    )
