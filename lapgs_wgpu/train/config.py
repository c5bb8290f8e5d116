"""The configuration of a training: frozen dataclasses without defaults, whose values stand in the presets (configs/),
but for keys that the config.toml of older runs lacks.

Each key carries the text that lapgs-train --help shows of it. No torch here, which takes seconds to import.
"""

# ruff: noqa: RUF009 (described() makes a dataclass field)

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from lapgs_wgpu.motion.fields.config import DynamicsMode, FieldConfig
from lapgs_wgpu.motion.fields.hash_grid_config import option

Background = Literal["black", "white", "random"]
Split = Literal["plain", "adaptive"]
Precision = Literal["float32", "bfloat16"]
DecoderPlace = Literal["auto", "torch", "device"]


def described(text: str, default: Any = dataclasses.MISSING) -> Any:
    """A key of the configuration with its help text; one without a default must stand in every preset."""
    return option(default, text)


@dataclass(frozen=True)
class DataConfig:
    """The capture."""

    size: int = described("longer side of the images, pixels; larger images are downscaled; 0 keeps the original size")
    background: Background = described(
        "background behind transparent images; random: a new color in each step, black during evaluation"
    )
    cache_gb: float = described(
        "memory limit for decoded images, gigabytes: one limit for host memory and one for device memory; a "
        "single limit for both where the device shares host memory"
    )
    path: str = described(
        'folder of the capture, or a built-in scene: "synthetic", or "motion:path=4,cycles=2"; a built-in '
        "scene is generated next to the run folder",
        "",
    )


@dataclass(frozen=True)
class PointsConfig:
    """The initial Gaussians."""

    count: int = described(
        "number of initial Gaussians; if the capture has a point cloud, the maximum number taken from it"
    )
    box: float = described(
        "half side length of the cube around the origin in which initial Gaussians are placed at random, "
        "world units; used only if the capture has neither a point cloud nor depth maps"
    )
    opacity: float = described("initial opacity of each Gaussian, between 0 and 1")

    def __post_init__(self) -> None:
        if self.count < 1 or self.box <= 0 or not 0 < self.opacity < 1:
            raise ValueError(
                "count must be at least 1, box above 0 and opacity between 0 and 1, "
                f"got {self.count}, {self.box:g} and {self.opacity:g}"
            )


@dataclass(frozen=True)
class ScheduleConfig:
    """Lengths and intervals, in steps."""

    steps: int = described("number of training steps")
    batch: int = described("images per step; their gradients are averaged")
    warm_up: int = described(
        "number of initial steps without motion: the deformation field is off, and only the static Gaussians "
        "are trained"
    )
    sh_interval: int = described(
        "the degree of the spherical harmonics starts at 0 and increases by one every this many steps, up to 3"
    )
    save_interval: int = described("save the training state every this many steps, for --resume; 0: never")

    def __post_init__(self) -> None:
        if min(self.steps, self.batch, self.sh_interval) < 1:
            given = f"{self.steps}, {self.batch} and {self.sh_interval}"
            raise ValueError(f"steps, batch and sh_interval must be at least 1, got {given}")


@dataclass(frozen=True)
class Rate:
    """A learning rate that goes from start to end exponentially and then stays there."""

    start: float = described("initial value")
    end: float = described("final value")
    steps: int = described("steps of the exponential decay from the initial to the final value; constant afterwards")

    def __post_init__(self) -> None:
        if not (0 < self.start < math.inf and 0 < self.end < math.inf and self.steps >= 1):
            raise ValueError(
                "a learning rate needs start and end above 0 and steps of at least 1, "
                f"got {self.start:g}, {self.end:g} and {self.steps}"
            )

    def at(self, step: int) -> float:
        """The rate of a step, which are counted from 1."""
        share = min(step / self.steps, 1.0)
        return self.start ** (1 - share) * self.end**share


@dataclass(frozen=True)
class RatesConfig:
    """Adam's learning rates, for each parameter of the Gaussians and for the field's hash tables and its MLP."""

    means: Rate = described("learning rate of the means, world units per step")
    log_scales: float = described("learning rate of the log-scales")
    quats: float = described("learning rate of the rotations (quaternions)")
    opacity_logits: float = described("learning rate of the opacities (logits)")
    sh_dc: float = described("learning rate of the base colors (spherical harmonics of degree 0)")
    sh_rest: float = described("learning rate of the view-dependent colors (spherical harmonics of degree 1 to 3)")
    dynamics: float = described("learning rate of the per-Gaussian dynamics attributes")
    hash: Rate = described("learning rate of the field's hash tables or feature planes")
    mlp: Rate = described("learning rate of the field's MLP weights")
    frequencies: Rate = described("learning rate of the motion spectrum's frequencies, cycles per clip per step")

    def __post_init__(self) -> None:
        self.schedules()

    def schedules(self) -> dict[str, Rate]:
        """Parameter name, or group of the field -> schedule."""
        rates = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: rate if isinstance(rate, Rate) else Rate(rate, rate, 1) for name, rate in rates.items()}


@dataclass(frozen=True)
class DensityConfig:
    """Densification and pruning."""

    start: int = described("densify and prune only after this step")
    stop: int = described("densify, prune and reset opacities only before this step")
    interval: int = described("densify and prune every this many steps")
    gradient: float = described(
        "densify (clone or split) Gaussians whose mean gradient norm of the 2-D mean exceeds this value; "
        "normalized device coordinates, where the image is 2 units wide"
    )
    split_size: float = described(
        "largest standard deviation of a Gaussian that is cloned; larger ones are split; relative to the "
        "extent of the cameras"
    )
    split: Split = described(
        "which large Gaussians above the gradient threshold are split; plain: all; adaptive (the paper's): "
        "those that differ most from their neighbors in shape and dynamics"
    )
    neighbours: int = described("adaptive split: number of nearest neighbors that each Gaussian is compared with")
    divergence_weight: float = described(
        "adaptive split: weight of the difference in dynamics relative to the difference in shape"
    )
    split_quantile: float = described(
        "adaptive split: fraction of the candidates, those with the lowest scores, that are not split unless "
        "their dynamics differ strongly"
    )
    min_opacity: float = described(
        "prune Gaussians with an opacity below this value; the 256 most opaque ones always stay"
    )
    max_screen_radius: float = described(
        "prune Gaussians that had a larger radius in a rendered image, pixels; applies after the first "
        "opacity reset; 0: no limit"
    )
    max_world_size: float = described(
        "prune Gaussians with a larger standard deviation, relative to the extent of the cameras; applies "
        "after the first opacity reset; 0: no limit"
    )
    reset_interval: int = described("reset the opacities every this many steps")
    reset_opacity: float = described("an opacity reset lowers all larger opacities to this value")
    limit: int = described(
        "maximum number of Gaussians; at the limit, those with the largest gradients are densified first; 0: no limit",
        0,
    )
    min_contribution: float = described(
        "prune Gaussians whose blending weights sum to less than this in every training image that is tried, pixels; "
        "at most 50 images are tried, evenly chosen over the clip; 0: no such pruning",
        0.0,
    )
    contribution_interval: int = described("prune by min_contribution every this many steps", 500)

    def __post_init__(self) -> None:
        if min(self.interval, self.reset_interval, self.contribution_interval) < 1:
            raise ValueError(
                "interval, reset_interval and contribution_interval must be at least 1 step, got "
                f"{self.interval}, {self.reset_interval} and {self.contribution_interval}"
            )
        if self.min_contribution < 0:
            raise ValueError(f"min_contribution must be at least 0 pixels, got {self.min_contribution:g}")
        if self.split_size <= 0 or not (0 < self.reset_opacity < 1 and 0 <= self.min_opacity < 1):
            raise ValueError(
                "split_size must be above 0, reset_opacity and min_opacity between 0 and 1, "
                f"got {self.split_size:g}, {self.reset_opacity:g} and {self.min_opacity:g}"
            )
        if self.neighbours < 1 or not (0 <= self.divergence_weight < math.inf and 0 <= self.split_quantile <= 1):
            raise ValueError(
                "neighbours must be at least 1, divergence_weight at least 0, and split_quantile between 0 and 1, "
                f"got {self.neighbours}, {self.divergence_weight:g} and {self.split_quantile:g}"
            )

    def changes_at(self, step: int) -> bool:
        """Whether Gaussians are cloned, split and pruned after this step (counted from 1)."""
        return self.start < step < self.stop and step % self.interval == 0

    def prunes_at(self, step: int, last: int) -> bool:
        """Whether Gaussians that contribute too little are pruned after this step of `last`."""
        return self.min_contribution > 0 and self.start < step < last and step % self.contribution_interval == 0

    def resets_at(self, step: int) -> bool:
        """Whether opacities are lowered after this step."""
        return step < self.stop and step % self.reset_interval == 0


class LossWeights(NamedTuple):
    """Of each term in the loss of an image; a term of weight 0 is not computed.

    l1, ssim (of 1 - SSIM), pyramid and ncc multiply the terms as they are.
    """

    l1: float
    ssim: float
    pyramid: float = 0.0
    ncc: float = 0.0


@dataclass(frozen=True)
class LossConfig:
    """The training loss."""

    ssim: float = described("weight w of the structural similarity; the image loss is (1 - w) L1 + w (1 - SSIM)")
    pyramid: float = described(
        "weight of the Laplacian pyramid loss (L1 between the pyramids of the two images), added to the image "
        "loss; 0: off"
    )
    ncc: float = described(
        "weight of 1 - local normalized cross-correlation, added to the image loss after the warm-up; 0: off"
    )
    dynamics: float = described("weight of the regularization of the dynamics attributes (paper eq. 12)")
    dynamics_mode: DynamicsMode = described(
        "sign of the dynamics regularization; literal: pulls outliers towards the mean, as in the paper's "
        "equation; promote: pushes outliers away, as in the paper's text; off: no regularization"
    )

    def __post_init__(self) -> None:
        if self.ssim > 1:
            raise ValueError(f"ssim is a share and must be at most 1, got {self.ssim:g}")

    def weights(self, *, warm: bool) -> LossWeights:
        """Of the image losses' terms; warm: whether the warm-up is over."""
        return LossWeights(1 - self.ssim, self.ssim, self.pyramid, self.ncc if warm else 0.0)


@dataclass(frozen=True)
class SmoothnessConfig:
    """The smoothness loss: squared differences of the field's features at nearby points (Grid4D)."""

    static: float = described("weight of the smoothness loss on the features of the spatial grid")
    temporal: float = described("weight of the smoothness loss on the features of the space-time grids")
    share: float = described(
        "fraction of the Gaussians that the smoothness loss samples in each step, between 0 and 1; 0: off"
    )
    reach: float = described("largest offset between the two sampled positions along each axis, world units")
    time_reach: float = described("largest offset between the two sampled times, as a fraction of the clip")

    def __post_init__(self) -> None:
        if self.share > 1:
            raise ValueError(f"share must be at most 1, got {self.share:g}")


@dataclass(frozen=True)
class DiscoveryConfig:
    """Motion discovery before the training (train/discovery). Has defaults, since older config.toml files lack it."""

    enabled: bool = described(
        "before training, search for objects that move far, and initialize Gaussians on them; skipped for the "
        "field static and if schedule.steps is at most discovery.steps",
        False,
    )
    steps: int = described("training steps of the static model that separates what moves from what does not", 800)
    size: int = described("longer side of the images for this search, pixels", 100)
    field_steps: int = described("steps that fit the deformation field to the motion that was found", 500)
    least: float = described(
        "minimum fraction of the moving surface points that the static model must miss; below it, no "
        "Gaussians are added",
        0.05,
    )

    def __post_init__(self) -> None:
        if min(self.steps, self.field_steps) < 1 or self.size < 16 or self.least > 1:
            raise ValueError(
                "steps and field_steps must be at least 1, size at least 16 and least at most 1, "
                f"got {self.steps}, {self.field_steps}, {self.size} and {self.least:g}"
            )


@dataclass(frozen=True)
class ExposureConfig:
    """Per-image color correction. Has defaults, since older config.toml files lack it."""

    enabled: bool = described(
        "learn an affine color correction for each training image, for cameras with varying exposure or white "
        "balance; never applied in evaluation",
        False,
    )
    rate: Rate = dataclasses.field(
        default=Rate(2e-2, 2e-3, 20_000), metadata={"help": "learning rate of the color corrections"}
    )


@dataclass(frozen=True)
class Config:
    """The configuration of a training."""

    data: DataConfig
    points: PointsConfig
    field: FieldConfig
    schedule: ScheduleConfig
    rates: RatesConfig
    density: DensityConfig
    loss: LossConfig
    smoothness: SmoothnessConfig
    seed: int = described("seed of all random numbers")
    exposure: ExposureConfig = dataclasses.field(default=ExposureConfig())
    discovery: DiscoveryConfig = dataclasses.field(default=DiscoveryConfig())
    precision: Precision = described(
        "data type of the field's features and of its decoder's matrix products and their gradients; bfloat16 "
        "is faster on processors with bfloat16 instructions; everything else is float32",
        "float32",
    )
    decoder: DecoderPlace = described(
        "where the decoder of the fields grid4d and laplacian runs during training; torch: on the CPU; "
        "device: as kernels on the device, which changes the last bits; auto: torch on CPU devices, otherwise "
        "the faster of the two in a trial at the start, recorded in config.toml",
        "torch",
    )

    def __post_init__(self) -> None:
        if self.decoder == "device" and not self.field.decodes_on_device:
            raise ValueError(
                "decoder device is for the fields grid4d and laplacian with field.depth 0 and field.motion laplacian, "
                f"not for {self.field.kind} with depth {self.field.depth} and motion {self.field.motion}"
            )
        if self.decoder == "device" and self.precision != "float32":
            raise ValueError(f"decoder device works in float32: precision {self.precision} needs decoder torch")
        if self.precision != "float32" and self.field.kind not in ("grid4d", "laplacian"):
            raise ValueError(
                f"precision {self.precision} is for the fields grid4d and laplacian, not for {self.field.kind}"
            )
