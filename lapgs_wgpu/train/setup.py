"""What a training begins with: what it is given, opened and checked; what its configuration leaves to the data and the
device; and its first Gaussians, initial points or what motion discovery found (lapgs_wgpu/discovery)."""

import dataclasses
import math
import operator
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.data.built_in import SYNTHETIC, write_built_in
from lapgs_wgpu.data.initial_gaussians import first_points, initial_scales, limit_optical_depth
from lapgs_wgpu.data.plane_sweep import still_surface
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device, open_device
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.motion.timing import MOST_TIMES
from lapgs_wgpu.splat.morton import morton_order
from lapgs_wgpu.train.camera_refinement import Corrections
from lapgs_wgpu.train.config import Config, PointsConfig, changed
from lapgs_wgpu.train.parts import Parts

INITIAL_OPACITY = 0.1
MOST_PIXELS = 0.5  # share from which on random points would only be a fog before the surfaces
# Learning rates at which a field keeps what discovery fitted; at higher ones Adam's noise undoes the fit.
MAX_HASH_RATE, MAX_MLP_RATE = 5e-3, 1e-3


def set_up(
    config: Config, dataset: Dataset | None, device: Device | None, parts: Parts, scene: Scene4D | None = None
) -> tuple[Config, Config, Dataset, Device]:
    """Check the arguments of a `Trainer`, open what they leave out, and resolve the configuration.

    Returns the configuration with its field, that of the scene or of the parts where they bring one, and the place of
    its steps decided, as config.toml holds it; the same resolved for the data, too; the capture; the device. Raises
    InputError where the arguments do not fit each other.
    """
    for name, kind, value in (("config", Config, config), ("dataset", Dataset | None, dataset)):
        if not isinstance(value, kind):
            raise InputError(f"Trainer takes as {name} what load_{name} gives, got a {type(value).__name__}.")
    if scene is not None and parts.field is not None:
        raise InputError("the scene to start from keeps its own field; leave out Parts(field=...).")
    if scene is not None and scene.antialiased != config.antialiased:
        raise InputError(
            f"the scene to start from is drawn with antialiased = {scene.antialiased}, and the configuration says "
            f"{config.antialiased}; give the configuration the scene's."
        )
    if dataset is None:
        config, dataset = open_data(config)
    device = device or open_device()
    if scene is not None:
        config = dataclasses.replace(config, field=scene.field_config)
    elif parts.field is not None:
        config = changed(config, {"field.kind": "own"})
    user_config = resolve_step(config, device, parts)
    resolved = resolve_for_dataset(user_config, dataset)
    if scene is not None:  # whose field does not change its shape any more
        resolved = dataclasses.replace(resolved, field=scene.field_config)
    return user_config, resolved, dataset, device


def open_data(config: Config, scenes: Path = Path("runs")) -> tuple[Config, Dataset]:
    """The configuration with the absolute paths of its data, and the dataset. scenes: folder into which the built-in
    scene is written, unless it is there. Raises InputError."""
    data = config.data
    if not data.path:
        raise InputError(f"the configuration names no data; give --data DIR (in Python data.path), or {SYNTHETIC}.")
    folder = write_built_in(scenes / SYNTHETIC) if data.path == SYNTHETIC else Path(data.path)
    masks = data.masks and str(Path(data.masks).resolve())
    config = changed(config, {"data.path": str(folder.resolve()), "data.masks": masks})
    given = {"masks": masks or None, "movers": data.movers or None}
    size = data.size or None
    return config, load_dataset(config.data.path, image_size=size, undistort=data.undistort, **given)


def resolve_for_dataset(config: Config, dataset: Dataset) -> Config:
    """The configuration with lengths in world units, and no more frequencies than the training times can tell apart.
    Raises InputError where these are too many to be refined."""
    if config.timing.refine and len(dataset.times) > MOST_TIMES:
        raise InputError(
            f"{dataset.name} has {len(dataset.times)} times, and timing.refine takes {MOST_TIMES} at most; give "
            "--timing.refine false."
        )
    if config.data.units == "capture":
        lengths = ("field.bound", "field.unit", "rates.means.start", "rates.means.end", "smoothness.reach")
        scaled = {key: dataset.scale * operator.attrgetter(key)(config) for key in lengths}
        config = changed(config, {**scaled, "data.units": "world"})
    # All frequencies above the limit would end there.
    most = 1 + math.floor(nyquist_frequency(dataset) / config.field.frequency_step + 1e-9)
    return changed(config, {"field.components": min(config.field.components, most)})


def nyquist_frequency(dataset: Dataset) -> float:
    """Half the rate of the training times, cycles over the clip: above it a frequency looks like one below."""
    times = dataset.times
    return (len(times) - 1) / 2 / float(times[-1] - times[0]) if len(times) > 1 else 0.0


def resolve_step(config: Config, device: Device, parts: Parts) -> Config:
    """The configuration with the place of the step, which "auto" leaves open, decided.

    No trial decides, since the place changes the last bits, and near a tie two runs would differ. Raises InputError
    where it is to be resident and cannot be.
    """
    reason = why_exchange(config, parts)
    if config.step_place == "resident" and reason:
        raise InputError(f"the step cannot be resident: {reason}; give --step_place auto.")
    if config.step_place != "auto":
        return config
    return dataclasses.replace(config, step_place="exchange" if reason or device.is_cpu else "resident")


def why_exchange(config: Config, parts: Parts) -> str:
    """What of a training only torch can compute; "" where there is nothing."""
    if config.field.kind != "static" and not config.field.decodes_on_device:
        return f"there are no kernels for the field {config.field.kind} in this shape"
    return "losses of one's own are torch's" if parts.losses else ""


@dataclass(frozen=True)
class Start:
    """What a training starts with: the first Gaussians, and the field.

    warm_up_steps: number of the first steps without motion. ramp_steps: of those over which the learning rates rise
    from 0. field_fitted: 0, or the field knows nearly all that moves: its rates then stay below this share of the
    highest (`max_field_rates`), and the acceleration loss is left out. corrections: of the training cameras; None where
    they are as given. summary: what discovery found, a sentence; None without discovery. seconds: that discovery took.
    """

    scene: Scene4D
    warm_up_steps: int = 0
    ramp_steps: int = 0
    field_fitted: float = 0.0
    corrections: Corrections | None = None
    summary: str | None = None
    seconds: float = 0.0


def start_from_points(config: Config, dataset: Dataset, device: Device, own_field: nn.Module | None = None) -> Start:
    """Start from initial points, and without motion in the first `schedule.warm_up` steps. config: resolved for the
    dataset. Raises InputError where its field is `own`, and there is no module."""
    scene = Scene4D.from_points(
        *initial_points(config.points, dataset, config.seed),
        config.field,
        opacity=INITIAL_OPACITY,
        antialiased=config.antialiased,
        device=device,
        seed=config.seed,
        own_field=own_field,
    )
    return Start(scene, warm_up_steps=config.schedule.warm_up)


def initial_points(
    config: PointsConfig, dataset: Dataset, seed: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """The first Gaussians, along a Morton curve: points (N, 3), colors (N, 3) and scales (N,).

    Without a cloud, the cameras tell where what stands still is (data/plane_sweep). All points lie there if most pixels
    show it, else as large a share as of the pixels. The others lie as data/initial_gaussians says.
    """
    points, colors = first_points(dataset, config.count, config.box, seed)
    if dataset.cloud is None and (surface := still_surface(dataset)) is not None:
        share = 1.0 if surface.share > MOST_PIXELS else surface.share
        known = min(round(share * len(points)), len(surface.points))
        chosen = np.random.default_rng(seed).choice(len(surface.points), known, replace=False)
        points[:known], colors[:known] = surface.points[chosen], surface.colors[chosen]
    scales = initial_scales(points)
    # Published figures of D-NeRF start from a fog, which the empty background there soon lifts.
    if dataset.cloud is not None or dataset.depths is not None:
        scales = limit_optical_depth(points, scales, INITIAL_OPACITY, dataset.cameras)
    order = morton_order(torch.from_numpy(points)).numpy()
    return points[order], colors[order], scales[order]


def max_field_rates(groups: Iterable[str], share: float = 1.0) -> dict[str, float]:
    """A share of the highest rate of each group of a field's parameters at which it keeps what discovery fitted."""
    return {name: share * (MAX_HASH_RATE if name == "hash" else MAX_MLP_RATE) for name in groups}
