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
    """What is trained on."""

    size: int = described("longer side in pixels to which larger pictures are shrunk; 0 keeps them as they are")
    background: Background = described(
        "what transparent pictures are laid on; random is another colour at each step, and black when measuring"
    )
    cache_gb: float = described(
        "bound on decoded pictures kept in memory, and on those on the device, in gigabytes; on both together where "
        "the device shares the memory"
    )
    path: str = described(
        'folder of the scene, or a built-in scene, "synthetic" or "motion:path=4,cycles=2", written beside the run', ""
    )


@dataclass(frozen=True)
class PointsConfig:
    """The Gaussians at the start."""

    count: int = described("how many; of a cloud that the capture brings, at most")
    box: float = described(
        "half side of the cube around the origin in which they lie at random, world units, where the capture brings "
        "neither a cloud nor the depths that its cameras see"
    )
    opacity: float = described("of each, between 0 and 1")

    def __post_init__(self) -> None:
        if self.count < 1 or self.box <= 0 or not 0 < self.opacity < 1:
            raise ValueError(
                "count must be at least 1, box above 0 and opacity between 0 and 1, "
                f"got {self.count}, {self.box:g} and {self.opacity:g}"
            )


@dataclass(frozen=True)
class ScheduleConfig:
    """When things happen."""

    steps: int = described("length of the training")
    batch: int = described("pictures a step, whose gradients are averaged")
    warm_up: int = described("steps at the start during which nothing moves")
    sh_interval: int = described("steps after which the degree of the spherical harmonics grows by one, up to 3")
    save_interval: int = described("steps from one saved state, from which --resume goes on, to the next; 0 for none")

    def __post_init__(self) -> None:
        if min(self.steps, self.batch, self.sh_interval) < 1:
            given = f"{self.steps}, {self.batch} and {self.sh_interval}"
            raise ValueError(f"steps, batch and sh_interval must be at least 1, got {given}")


@dataclass(frozen=True)
class Rate:
    """A learning rate that goes from start to end exponentially and then stays there."""

    start: float = described("at the beginning")
    end: float = described("at the end")
    steps: int = described("steps from start to end, counted from the beginning of the training")

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

    means: Rate = described("learning rate of the positions, world units a step")
    log_scales: float = described("learning rate of the logarithms of the scales")
    quats: float = described("learning rate of the quaternions")
    opacity_logits: float = described("learning rate of the opacities' logits")
    sh_dc: float = described("learning rate of the colours' constant part")
    sh_rest: float = described("learning rate of the colours' other spherical harmonics")
    dynamics: float = described("learning rate of the dynamics attributes")
    hash: Rate = described("learning rate of the field's hash tables, or planes")
    mlp: Rate = described("learning rate of the field's other weights")
    frequencies: Rate = described("learning rate of the spectrum's frequencies, cycles over the clip a step")

    def __post_init__(self) -> None:
        self.schedules()

    def schedules(self) -> dict[str, Rate]:
        """Parameter name, or group of the field -> schedule."""
        rates = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: rate if isinstance(rate, Rate) else Rate(rate, rate, 1) for name, rate in rates.items()}


@dataclass(frozen=True)
class DensityConfig:
    """When and how the number of Gaussians changes."""

    start: int = described("step after which it changes")
    stop: int = described("step from which on it stays, and opacities are not reset any more")
    interval: int = described("steps from one change to the next")
    gradient: float = described(
        "mean length of the loss's gradient by the place on the image from which on a Gaussian is cloned or split; "
        "in normalised device coordinates, in which an image is 2 wide and 2 high"
    )
    split_size: float = described(
        "largest standard deviation up to which a Gaussian is cloned, beyond which split; in extents of the cameras"
    )
    split: Split = described(
        "which of the large Gaussians of a large gradient are split: plain, all of them; adaptive, those that differ "
        "most from their neighbours in shape and dynamics"
    )
    neighbours: int = described("how many nearest Gaussians the adaptive split compares one with")
    divergence_weight: float = described(
        "weight of the differences in dynamics against those in shape in the score of the adaptive split"
    )
    split_quantile: float = described(
        "share of these Gaussians, those of the lowest scores, that the adaptive split leaves as they are, unless "
        "their dynamics stand out"
    )
    min_opacity: float = described("Gaussians below it are removed, but for the 256 most opaque ones")
    max_screen_radius: float = described(
        "Gaussians that were larger on an image are removed, in pixels, from the first reset on; 0 for no bound"
    )
    max_world_size: float = described(
        "Gaussians of a larger standard deviation are removed, in extents of the cameras, from the first reset on; "
        "0 for no bound"
    )
    reset_interval: int = described("steps from one reset of the opacities to the next")
    reset_opacity: float = described("what opacities are lowered to")
    limit: int = described(
        "no more Gaussians than this: those of the largest gradients are cloned or split first; 0 for no bound", 0
    )

    def __post_init__(self) -> None:
        if self.interval < 1 or self.reset_interval < 1:
            raise ValueError(
                f"interval and reset_interval must be at least 1 step, got {self.interval} and {self.reset_interval}"
            )
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
    """What is minimised."""

    ssim: float = described("share w of the structural similarity in (1 - w) L1 + w (1 - SSIM)")
    pyramid: float = described("weight of the Laplacian pyramids' difference, which is added; 0 leaves it out")
    ncc: float = described("weight of 1 - local cross-correlation, added once the warm-up is over; 0 leaves it out")
    dynamics: float = described("weight of the regularisation of the dynamics attributes (paper eq. 12)")
    dynamics_mode: DynamicsMode = described(
        "what it does to outliers: literal (pulls them in, as the paper's equation), promote (pushes them out, as its "
        "text) or off"
    )

    def __post_init__(self) -> None:
        if self.ssim > 1:
            raise ValueError(f"ssim is a share and must be at most 1, got {self.ssim:g}")

    def weights(self, *, warm: bool) -> LossWeights:
        """Of the image losses' terms; warm: whether the warm-up is over."""
        return LossWeights(1 - self.ssim, self.ssim, self.pyramid, self.ncc if warm else 0.0)


@dataclass(frozen=True)
class SmoothnessConfig:
    """The loss that keeps the field smooth: squared differences of its features at near places (Grid4D)."""

    static: float = described("weight for features of place")
    temporal: float = described("weight for features of place and time")
    share: float = described("of the Gaussians that are compared in a step, between 0 and 1; 0 leaves the loss out")
    reach: float = described("how far away the other place is at most along each axis, world units")
    time_reach: float = described("how far away the other time is at most, in clips")

    def __post_init__(self) -> None:
        if self.share > 1:
            raise ValueError(f"share must be at most 1, got {self.share:g}")


@dataclass(frozen=True)
class DiscoveryConfig:
    """Search for what moves before the training (train/discovery). With defaults: older runs lack it."""

    enabled: bool = described(
        "whether things that move far are searched for before the first step, and start with Gaussians of their own; "
        "left out by the field static and by trainings that are no longer than discovery.steps",
        False,
    )
    steps: int = described("steps of the static fit that shows what stands still", 800)
    size: int = described("longer side in pixels of the images that the static fit and the search see", 100)
    field_steps: int = described("steps in which the field learns the motion that was found", 500)
    least: float = described(
        "share of the moving surface points that the static fit must lack, below which nothing is added", 0.05
    )

    def __post_init__(self) -> None:
        if min(self.steps, self.field_steps) < 1 or self.size < 16 or self.least > 1:
            raise ValueError(
                "steps and field_steps must be at least 1, size at least 16 and least at most 1, "
                f"got {self.steps}, {self.field_steps}, {self.size} and {self.least:g}"
            )


@dataclass(frozen=True)
class ExposureConfig:
    """Colours of cameras that do not keep their exposure or their white balance. With defaults: older runs lack it."""

    enabled: bool = described(
        "whether each training picture has an affine correction of its colours, which is learnt; a correction is never "
        "applied to the pictures that are measured",
        False,
    )
    rate: Rate = dataclasses.field(
        default=Rate(2e-2, 2e-3, 20_000), metadata={"help": "learning rate of a picture's correction"}
    )


@dataclass(frozen=True)
class Config:
    """All that a training depends on, besides the pictures."""

    data: DataConfig
    points: PointsConfig
    field: FieldConfig
    schedule: ScheduleConfig
    rates: RatesConfig
    density: DensityConfig
    loss: LossConfig
    smoothness: SmoothnessConfig
    seed: int = described("of every random draw")
    exposure: ExposureConfig = dataclasses.field(default=ExposureConfig())
    discovery: DiscoveryConfig = dataclasses.field(default=DiscoveryConfig())
    precision: Precision = described(
        "of the field's features, and of its decoder's products and their gradients; bfloat16 is faster on processors "
        "that have instructions for it; parameters, sums, images and everything after the training are float32",
        "float32",
    )
    decoder: DecoderPlace = described(
        "where the decoder of the fields grid4d and laplacian works while training: torch, device (by kernels, which "
        "changes the last bits), or auto: on the device where it is no CPU and a trial at the start finds it faster; "
        "config.toml then says which it was",
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
