"""The configuration of a training: frozen dataclasses without defaults, whose values stand in the presets (configs/),
but for keys that the config.toml of older runs lacks.

Each key carries the text that lapgs-train --help shows of it. No torch here, which takes seconds to import.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeVar

from lapgs_wgpu.io.dataclass_table import Options, option
from lapgs_wgpu.motion.fields.config import FieldConfig

BACKGROUND_LEVELS = {"black": 0.0, "white": 1.0}
Table = TypeVar("Table", bound=Options)


@dataclass(frozen=True)
class DataConfig(Options):
    """The capture."""

    size: int = option("longer side of the images, pixels; larger images are downscaled; 0: the original size")
    background: Literal["black", "white"] = option("color behind the Gaussians and behind transparent images")
    cache_gb: float = option("memory limit for the images that are kept on the device, gigabytes")
    undistort: bool = option("undo distortion and skew of lenses; false: ignore them, and the principal point", True)
    vary_background: bool = option("a random, fixed background for each image, opaque or not: closes holes", False)
    units: Literal["world", "capture"] = option(
        "length unit of rates.means, smoothness.reach, field.bound and field.unit; capture: that of its files",
        "world",
    )
    masks: str = option(
        "folder with a mask for each training image; the loss ignores white pixels, so they are not trained", ""
    )
    movers: str = option(
        "folder, absolute or in the capture, with a mask for each image, white where something moves: discovery looks "
        "there alone, evaluation measures it apart, and a point cloud's cube is fitted to it (lapgs-prepare: masks)",
        "",
    )
    path: str = option(
        'folder of the capture (docs/data.md lists the formats), or "synthetic" for the built-in scene', ""
    )


@dataclass(frozen=True)
class PointsConfig(Options):
    """The initial Gaussians."""

    count: int = option("number of initial Gaussians; at most so many points of the capture's point cloud", at_least=1)
    box: float = option(
        "half side length of the cube that discovery searches, and in which initial Gaussians are placed at random if "
        "the capture has neither points nor depth bounds, world units",
        above=0,
    )


@dataclass(frozen=True)
class ScheduleConfig(Options):
    """Lengths and intervals, in steps."""

    steps: int = option(
        "number of training steps; the keys that count steps, rates.KEY.steps among them, stay", at_least=1
    )
    warm_up: int = option(
        "steps in which only static Gaussians are trained; with discovery: over which learning rates rise (0: over 200)"
    )
    sh_interval: int = option("the degree of the spherical harmonics rises by one every N steps, up to 3", at_least=1)
    save_interval: int = option("save the state for --resume every N steps; 0: only if the training is interrupted")
    cool_down: float = option(
        "fraction of the steps, the last, over which the rates of Gaussians, hash and mlp fall to 0", 0.0, at_most=1
    )
    half_size_steps: int = option("number of first steps that see images of half the size; 0: none", 0)

    def halves(self, step: int) -> bool:
        """Whether a step (counted from 1) sees images of half the size."""
        return step <= self.half_size_steps


@dataclass(frozen=True)
class Rate(Options):
    """A learning rate, exponential from start to end, or in a straight line where one of them is 0; then constant."""

    start: float = option("initial value", at_least=0, below=math.inf)
    end: float = option("final value", at_least=0, below=math.inf)
    steps: int = option("step at which the final value is reached", at_least=1)


@dataclass(frozen=True)
class RatesConfig(Options):
    """Adam's learning rates, for each parameter of the Gaussians and for the field's hash tables and its MLP."""

    means: Rate = option("means, world units per step")
    log_scales: float = option("log-scales", at_least=0)
    quats: float = option("rotations (quaternions)", at_least=0)
    opacity_logits: float = option("opacities (logits)", at_least=0)
    sh_dc: float = option("base colors (spherical harmonics of degree 0)", at_least=0)
    sh_rest: float = option("view-dependent colors (spherical harmonics of degree 1 to 3)", at_least=0)
    dynamics: float = option("per-Gaussian dynamics attributes", at_least=0)
    hash: Rate = option("the field's hash tables or feature planes")
    mlp: Rate = option("the field's MLP weights, and the motion spectrum's coefficients")
    frequencies: Rate = option("the motion spectrum's frequencies, cycles per clip per step")

    def schedules(self) -> dict[str, Rate]:
        """Parameter name, or group of the field -> schedule."""
        return {name: rate if isinstance(rate, Rate) else Rate(rate, rate, 1) for name, rate in vars(self).items()}


@dataclass(frozen=True)
class DensityConfig(Options):
    """Densification and pruning."""

    start: int = option("densify, prune and reset opacities only after this step")
    stop: int = option("densify, prune and reset opacities only before this step, except for min_contribution")
    interval: int = option("densify and prune every N steps", at_least=1)
    gradient: float = option(
        "densify Gaussians whose projected center has at least this gradient, its mean length over the images (an "
        "image is 2 units wide)"
    )
    split: Literal["plain", "adaptive"] = option(
        "which large Gaussians split; plain: all; adaptive: the 60 % least like neighbors in shape and dynamics"
    )
    min_opacity: float = option("prune Gaussians with a lower opacity", at_least=0, below=1)
    max_world_size: float = option(
        "prune Gaussians with a larger standard deviation, relative to the cameras' extent, after the first opacity "
        "reset; 0: no limit"
    )
    reset_interval: int = option("reset the opacities every N steps; density.stop or more: never", at_least=1)
    limit: int = option("densification adds no Gaussians beyond this number; 0: no limit", 0)
    min_contribution: float = option(
        "prune Gaussians that contribute less than this to each of 50 training images: blending weights summed over "
        "the pixels, 1 is a whole pixel; 0: off",
        0.0,
        at_least=0,
    )
    contribution_interval: int = option("prune by min_contribution every N steps, until the end", 500, at_least=1)

    def changes_at(self, step: int) -> bool:
        """Whether Gaussians are cloned, split and pruned after this step (counted from 1)."""
        return self.start < step < self.stop and step % self.interval == 0

    def prunes_at(self, step: int, last: int) -> bool:
        """Whether Gaussians that contribute too little are pruned after this step of `last`."""
        return self.min_contribution > 0 and self.start < step < last and step % self.contribution_interval == 0

    def resets_at(self, step: int) -> bool:
        """Whether opacities are lowered after this step."""
        return self.start < step < self.stop and step % self.reset_interval == 0


class LossWeights(NamedTuple):
    """Of the terms in the loss of an image (ssim: of 1 - SSIM); a term of weight 0 is not computed."""

    l1: float
    ssim: float
    pyramid: float = 0.0
    ncc: float = 0.0


@dataclass(frozen=True)
class LossConfig(Options):
    """The training loss."""

    ssim: float = option("weight w of SSIM; the image loss is (1 - w) L1 + w (1 - SSIM)", at_most=1)
    pyramid: float = option("weight of the Laplacian pyramid loss; 0: off")
    ncc: float = option("weight of 1 - local normalized cross-correlation, after the warm-up or discovery; 0: off")
    dynamics: float = option(
        "weight of the dynamics regularization, which pulls outlying dynamics attributes to the mean; 0: off"
    )

    def weights(self, *, warm: bool) -> LossWeights:
        """Of the image losses' terms; warm: whether the warm-up is over."""
        return LossWeights(1 - self.ssim, self.ssim, self.pyramid, self.ncc if warm else 0.0)


@dataclass(frozen=True)
class SmoothnessConfig(Options):
    """The smoothness loss: squared differences of the field's features at nearby points (Grid4D)."""

    static: float = option("weight of squared feature differences at nearby points, spatial grid")
    temporal: float = option(
        "weight of squared feature differences at nearby points and times, space-time grids; both weights 0: no "
        "smoothness loss, that of hexplane's planes included"
    )
    share: float = option("fraction of the Gaussians that are sampled in each step; 0: off", at_most=1)
    reach: float = option("largest offset between the two sampled positions along each axis, world units")
    time_reach: float = option("largest offset between the two sampled times, as a fraction of the clip")
    start: int = option("compute it and the acceleration loss only after this step", 0)


@dataclass(frozen=True)
class AccelerationConfig(Options):
    """The acceleration loss (train/motion_losses.py). Has defaults, since older config.toml files lack it."""

    weight: float = option(
        "weight of the acceleration loss: distance of means and scales from the line between before and after; 0, "
        "or discovery found nearly all motion: off",
        0.0,
    )
    share: float = option("fraction of the Gaussians that are sampled each time", 0.25, at_most=1)
    interval: int = option("compute it every N steps with N times the weight", 1, at_least=1)


@dataclass(frozen=True)
class DiscoveryConfig(Options):
    """Motion discovery before the training (docs/method.md). Has defaults, since older config.toml files lack it."""

    enabled: bool = option(
        "search for objects that move farther than their own size, and start from them; not for the field static, nor "
        "if schedule.steps is at most discovery.steps. Limits rates.hash and rates.mlp where it finds nearly all",
        False,
    )
    steps: int = option("steps of the static fit, before step 1; cameras all around: none", 800, at_least=1)
    size: int = option("longer side of the images for discovery, pixels; cameras all around: 160", 100, at_least=16)
    field_steps: int = option("steps that fit a field to what was found; all around: >= 30 a time", 1500, at_least=1)
    least: float = option(
        "start from the static fit alone if less than this fraction of what moves was found",
        0.05,
        at_most=1,
    )


@dataclass(frozen=True)
class ExposureConfig(Options):
    """Per-image color correction. Has defaults, since older config.toml files lack it."""

    enabled: bool = option(
        "learn an affine color correction for each training image, or for each camera of a rig that stands still; "
        "never applied in evaluation",
        False,
    )
    rate: Rate = option("color corrections", Rate(2e-2, 2e-3, 20_000))


@dataclass(frozen=True)
class CamerasConfig(Options):
    """Correction of the training cameras. Has defaults, since older config.toml files lack it."""

    refine: Literal["auto", "on", "off"] = option(
        "correct the training cameras while training; auto: if their poses were estimated from images (COLMAP, "
        "nerfstudio, Polycam, Record3D)",
        "off",
    )
    rate: Rate = option(
        "how far a step moves a camera, as the angle by which its image then moves, radians", Rate(4e-3, 2e-4, 3_000)
    )
    pull: float = option("weight decay of the corrections, relative to the learning rate", 0.1, at_least=0)
    start: int = option("first step that corrects cameras; if discovery did: 1, all at rate.end", 300, at_least=1)


@dataclass(frozen=True)
class TimingConfig(Options):
    """Correction of the training images' times. Has defaults, since older config.toml files lack it."""

    refine: bool = option(
        "correct the times of the training images while training, for captures with lost, repeated or unevenly timed "
        "images",
        False,
    )
    start: int = option("first step after which times are corrected", 3000, at_least=1)
    interval: int = option("correct them every N steps", 1000, at_least=1)

    def corrections(self, steps: int) -> range:
        """After which of `steps` steps times are corrected."""
        return range(self.start, steps, self.interval) if self.refine else range(0)


@dataclass(frozen=True)
class EvalConfig(Options):
    """Evaluation during the training. Has defaults, since older config.toml files lack it."""

    interval: int = option(
        "every N steps, write the PSNR of the validation views (of 8 training views if there are none) to log.jsonl; "
        "0: off",
        0,
        at_least=0,
    )


@dataclass(frozen=True)
class Config(Options):
    """The configuration of a training."""

    data: DataConfig
    points: PointsConfig
    field: FieldConfig
    schedule: ScheduleConfig
    rates: RatesConfig
    density: DensityConfig
    loss: LossConfig
    smoothness: SmoothnessConfig
    seed: int = option("seed of the random numbers, but for data.vary_background's colors")
    acceleration: AccelerationConfig = option("", AccelerationConfig())
    exposure: ExposureConfig = option("", ExposureConfig())
    cameras: CamerasConfig = option("", CamerasConfig())
    timing: TimingConfig = option("", TimingConfig())
    discovery: DiscoveryConfig = option("", DiscoveryConfig())
    eval: EvalConfig = option("", EvalConfig())
    antialiased: bool | float = option(
        "lower the opacity of thin Gaussians by the factor by which the low-pass filter enlarges them (as in gsplat); "
        "a number is the filter's variance, px^2, otherwise 0.3",
        False,
    )
    step_place: Literal["auto", "exchange", "resident"] = option(
        "where a training step is computed; resident: on the device from end to end, where its parameters stay; "
        "exchange: by torch, which exchanges buffers with the device; auto: exchange on CPU devices and for what only "
        "torch computes (mlp, hexplane, own; field.motion mlp, field.depth > 0), else resident",
        "auto",
    )


def changed(table: Table, values: Mapping[str, Any]) -> Table:
    """A copy of a configuration, or of a table of it, with other values by dotted key, such as `schedule.steps`."""
    for key, value in values.items():
        name, _, rest = key.partition(".")
        new = changed(getattr(table, name), {rest: value}) if rest else value
        table = dataclasses.replace(table, **{name: new})  # type: ignore[type-var]
    return table
