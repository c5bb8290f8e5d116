"""The configuration of a training: frozen dataclasses without defaults, whose values stand in the presets (configs/),
but for keys that the config.toml of older runs lacks.

Each key carries the text that lapgs-train --help shows of it. No torch here, which takes seconds to import.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal, NamedTuple

from lapgs_wgpu.io.dataclass_table import Options, option
from lapgs_wgpu.motion.fields.config import DynamicsMode, FieldConfig
from lapgs_wgpu.train.learning_rate import Rate, RatesConfig

Background = Literal["black", "white", "random"]
BACKGROUND_LEVELS = {"black": 0.0, "white": 1.0, "random": 0.0}  # under views that are measured
Split = Literal["plain", "adaptive"]
HeldOut = Literal["test", "val"]
Units = Literal["world", "capture"]
DecoderPlace = Literal["auto", "torch", "device"]
RefineCameras = Literal["auto", "on", "off"]


@dataclass(frozen=True)
class DataConfig(Options):
    """The capture."""

    size: int = option("longer side of the images, pixels; larger images are downscaled; 0 keeps the original size")
    background: Background = option(
        "color behind the Gaussians and behind transparent images; random: a new color in each step, black during "
        "evaluation"
    )
    cache_gb: float = option(
        "memory limit for decoded images, gigabytes, beyond which images are decoded again: one limit for host memory "
        "and one for device memory; a single limit for both where the device shares host memory"
    )
    split: HeldOut = option(
        "held-out views that are evaluated at the end; val: those of a D-NeRF scene's transforms_val.json, for "
        "choosing settings without looking at the test views",
        "test",
    )
    undistort: bool = option(
        "resample images of lenses with distortion or skew to those of a pinhole camera; false: ignore distortion, "
        "skew and principal point, as the published code that trains on HyperNeRF's captures does",
        True,
    )
    units: Units = option(
        "units of rates.means, smoothness.reach, field.bound and field.unit; world: those of the scene in the presets' "
        "cube; capture: those of the capture's files, as in published settings; the training multiplies these values "
        "by the scale of the cube when it starts; all other lengths are in world units",
        "world",
    )
    masks: str = option(
        "folder with a mask for every training image (of a.jpg: a.png or a.jpg.png); the training loss ignores white "
        "pixels; such as the folder masks of lapgs-prepare; empty: none",
        "",
    )
    path: str = option(
        "folder of the capture (docs/data.md lists the formats), or a built-in scene, generated next to the run "
        'folder: "synthetic", or "motion:path=4,cycles=2" (paths 4 object diameters wide, travelled twice; more keys: '
        "docs/metrics.md)",
        "",
    )


@dataclass(frozen=True)
class PointsConfig(Options):
    """The initial Gaussians."""

    count: int = option(
        "number of initial Gaussians; if the capture has a point cloud, the maximum number taken from it; with "
        "discovery, of those at the start of its static fit",
        at_least=1,
    )
    box: float = option(
        "half side length of the cube around the origin that discovery searches, world units; initial Gaussians are "
        "placed in it at random if the capture has neither a point cloud nor depth bounds",
        above=0,
    )
    opacity: float = option(
        "initial opacity of each Gaussian, between 0 and 1; with discovery, of those at the start of its static fit",
        above=0,
        below=1,
    )


@dataclass(frozen=True)
class ScheduleConfig(Options):
    """Lengths and intervals, in steps."""

    steps: int = option(
        "number of training steps; no other key changes with it, such as rates.*.steps, schedule.warm_up, "
        "density.* and timing.*",
        at_least=1,
    )
    batch: int = option("images per step; their gradients are averaged", at_least=1)
    warm_up: int = option(
        "without discovery: number of initial steps without motion, in which the deformation field is off and only the "
        "static Gaussians are trained; with discovery: number of initial steps over which rates.*, except "
        "rates.frequencies, rise linearly from 0"
    )
    sh_interval: int = option(
        "the degree of the spherical harmonics increases by one every this many steps, up to 3; it starts at 0, with "
        "discovery at the degree of its static fit (2)",
        at_least=1,
    )
    save_interval: int = option(
        "save the training state every this many steps, for --resume; 0: only if the training is interrupted or fails"
    )


@dataclass(frozen=True)
class DensityConfig(Options):
    """Densification and pruning."""

    start: int = option("densify, prune (by min_contribution, too) and reset opacities only after this step")
    stop: int = option("densify, prune and reset opacities only before this step; pruning by min_contribution goes on")
    interval: int = option("densify and prune every this many steps", at_least=1)
    gradient: float = option(
        "densify (clone or split) Gaussians whose gradient norm reaches this value; the gradient is that of the whole "
        "loss by the 2-D mean, in normalized device coordinates, where the image is 2 units wide; its norm is averaged "
        "over the images that showed the Gaussian since the last densification"
    )
    split_size: float = option(
        "largest standard deviation of a Gaussian that is cloned; larger ones are split; relative to the "
        "extent of the cameras (1.1 times the largest distance of a training camera from their mean)",
        above=0,
    )
    split: Split = option(
        "which large Gaussians above the gradient threshold are split; plain: all; adaptive (the paper's): "
        "those that differ most from their neighbors in shape, or most unevenly in dynamics, and outliers in dynamics "
        "(loss.dynamics)"
    )
    neighbours: int = option(
        "adaptive split: number of nearest neighbors that each Gaussian is compared with", at_least=1
    )
    divergence_weight: float = option(
        "adaptive split: weight of the dynamics term relative to the difference in shape; the term, from 0 to 1, says "
        "how unevenly the neighbors' dynamics attributes differ from the Gaussian's own; 0 if all differ alike; for "
        "fields without dynamics attributes: distances of the means instead",
        at_least=0,
        below=math.inf,
    )
    split_quantile: float = option(
        "adaptive split: fraction of the candidates that are not split: those with the lowest score (difference in "
        "shape plus divergence_weight times dynamics term), except outliers in dynamics (loss.dynamics)",
        at_least=0,
        at_most=1,
    )
    min_opacity: float = option(
        "prune Gaussians with an opacity below this value, between 0 and 1; the most opaque ones stay: 256, or a "
        "quarter of all if that is fewer, unless max_screen_radius or max_world_size prunes them",
        at_least=0,
        below=1,
    )
    max_screen_radius: float = option(
        "prune Gaussians that had a larger radius (to where alpha falls to 1/255) in an image since the last "
        "densification, pixels; applies after the first opacity reset (step density.reset_interval); 0: no limit"
    )
    max_world_size: float = option(
        "prune Gaussians with a larger standard deviation, relative to the extent of the cameras; applies "
        "after the first opacity reset (step density.reset_interval); 0: no limit"
    )
    reset_interval: int = option(
        "reset the opacities every this many steps; density.stop or more: never, which also turns off "
        "max_screen_radius and max_world_size",
        at_least=1,
    )
    reset_opacity: float = option("an opacity reset lowers all larger opacities to this value", above=0, below=1)
    limit: int = option(
        "densification adds none beyond this number, and densifies those with the largest gradients first; 0: no limit",
        0,
    )
    min_contribution: float = option(
        "prune Gaussians whose blending weights sum to less than this in every training image that is tried, pixels; "
        "at most 50 images are tried, evenly chosen over the clip; the 256 Gaussians with the largest sums stay; 0: no "
        "such pruning",
        0.0,
        at_least=0,
    )
    contribution_interval: int = option(
        "prune by min_contribution every this many steps, from density.start to the end of the training",
        500,
        at_least=1,
    )

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
    """Of each term in the loss of an image; a term of weight 0 is not computed.

    l1, ssim (of 1 - SSIM), pyramid and ncc multiply the terms as they are.
    """

    l1: float
    ssim: float
    pyramid: float = 0.0
    ncc: float = 0.0


@dataclass(frozen=True)
class LossConfig(Options):
    """The training loss."""

    ssim: float = option(
        "weight w of the structural similarity; the image loss is (1 - w) L1 + w (1 - SSIM)", at_most=1
    )
    pyramid: float = option(
        "weight of the Laplacian pyramid loss (L1 between the pyramids of the two images), added to the image "
        "loss; 0: off"
    )
    ncc: float = option(
        "weight of 1 - local normalized cross-correlation, added to the image loss after schedule.warm_up, with "
        "discovery from step 1; 0: off"
    )
    dynamics: float = option(
        "weight of the dynamics regularization: squared distance of outlying dynamics attributes from the mean "
        "attribute, averaged over all Gaussians (paper eq. 12); outliers are more than one standard deviation farther "
        "from it than the average Gaussian; added after schedule.warm_up, with discovery from step 1"
    )
    dynamics_mode: DynamicsMode = option(
        "sign of the dynamics regularization; literal: pulls outliers towards the mean, as in the paper's "
        "equation; promote: pushes outliers away, as in the paper's text, by -log(1 + squared distance / variance of "
        "the distances) instead of the squared distance; off: no regularization, as loss.dynamics 0"
    )

    def weights(self, *, warm: bool) -> LossWeights:
        """Of the image losses' terms; warm: whether the warm-up is over."""
        return LossWeights(1 - self.ssim, self.ssim, self.pyramid, self.ncc if warm else 0.0)


@dataclass(frozen=True)
class SmoothnessConfig(Options):
    """The smoothness loss: squared differences of the field's features at nearby points (Grid4D)."""

    static: float = option(
        "fields grid4d and laplacian: weight of the smoothness loss (squared differences between features at nearby "
        "points), spatial grid"
    )
    temporal: float = option(
        "fields grid4d and laplacian: weight of the smoothness loss, space-time grids; if both weights are 0, the "
        "field hexplane's own smoothness loss, whose weights are fixed, is off, too"
    )
    share: float = option(
        "fraction of the Gaussians that the smoothness loss samples in each step, between 0 and 1; 0: off, which also "
        "turns off the field hexplane's own smoothness loss",
        at_most=1,
    )
    reach: float = option("largest offset between the two sampled positions along each axis, world units")
    time_reach: float = option("largest offset between the two sampled times, as a fraction of the clip")
    start: int = option(
        "compute the smoothness loss (hexplane's, too) only after this step, such as density.stop; without discovery, "
        "it begins after schedule.warm_up at the earliest",
        0,
    )


@dataclass(frozen=True)
class AccelerationConfig(Options):
    """The acceleration loss (train/acceleration.py). Has defaults, since older config.toml files lack it."""

    weight: float = option(
        "weight of the acceleration loss: how far means and scales are from the straight line between those shortly "
        "before and after, world units; a distance l counts as l / (1 + 100 l), so that fast motion is not held back; "
        "begins as the smoothness loss does, and is left out where discovery explains at least 80% of what moves; "
        "0: off",
        0.0,
    )
    share: float = option("fraction of the Gaussians that it samples each time, between 0 and 1", 0.25, at_most=1)
    interval: int = option(
        "compute it every N steps with N times the weight; its cost hardly depends on the number of Gaussians",
        1,
        at_least=1,
    )
    frames: float = option(
        "largest distance in time from the view's; 1: that between two training images, if they are evenly spaced; "
        "drawn between half of it and all",
        2.0,
        at_least=0.1,
    )


@dataclass(frozen=True)
class DiscoveryConfig(Options):
    """Motion discovery before the training (docs/method.md). Has defaults, since older config.toml files lack it."""

    enabled: bool = option(
        "before training, fit a static fit, search for objects that move farther than their own size, and start from "
        "both; skipped for the field static and if schedule.steps is at most discovery.steps. If what it finds "
        "explains at least 80% of what moves, the field's rates stay at 0.005 (hash) and 0.001 (mlp) or less",
        False,
    )
    steps: int = option(
        "training steps of the static fit, which also separates what moves from what does not", 800, at_least=1
    )
    size: int = option("longer side of the images for the static fit and the search, pixels", 100, at_least=16)
    field_steps: int = option("steps that fit the deformation field to the motion that was found", 1500, at_least=1)
    least: float = option(
        "add moving Gaussians only if their tracks explain at least this fraction, between 0 and 1, of the surface "
        "points at which images differ from the static fit",
        0.05,
        at_most=1,
    )


@dataclass(frozen=True)
class ExposureConfig(Options):
    """Per-image color correction. Has defaults, since older config.toml files lack it."""

    enabled: bool = option(
        "learn an affine color correction for each training image, for cameras with varying exposure or white "
        "balance; never applied in evaluation",
        False,
    )
    rate: Rate = option("learning rate of the color corrections", Rate(2e-2, 2e-3, 20_000))


@dataclass(frozen=True)
class CamerasConfig(Options):
    """Correction of the training cameras. Has defaults, since older config.toml files lack it."""

    refine: RefineCameras = option(
        "correct the training cameras while training, never those of test views; auto: only captures with estimated "
        "poses (COLMAP, nerfstudio, Polycam, Record3D)",
        "off",
    )
    rate: Rate = option(
        "learning rate of the corrections, radians of image motion per step (with discovery, its static fit goes "
        "from .start to .end in discovery.steps, the training stays at .end, and .steps has no effect)",
        Rate(4e-3, 2e-4, 3_000),
    )
    pull: float = option(
        "weight decay of the corrections: each step multiplies those of the cameras it uses by 1 - pull x learning "
        "rate",
        0.1,
        at_least=0,
    )
    focal: bool = option("correct the focal length, too: one factor for all training cameras", True)
    start: int = option(
        "first step that moves cameras; the scene forms before it; with discovery: the first step of its static fit "
        "that does, an eighth of discovery.steps at the latest; the training then moves cameras from step 1 on",
        300,
        at_least=1,
    )

    def refines(self, *, own_footage: bool) -> bool:
        """Whether the training cameras of such a capture are corrected."""
        return self.refine == "on" or (self.refine == "auto" and own_footage)


@dataclass(frozen=True)
class TimingConfig(Options):
    """Correction of the training images' times. Has defaults, since older config.toml files lack it."""

    refine: bool = option(
        "correct the times of the training images while training, by up to 1.5 of their distance, for captures with "
        "lost, repeated or unevenly timed images; test views get the corrections of the training images around them; "
        "not of the paper",
        False,
    )
    start: int = option("first step after which times are corrected; the motion forms before it", 3000, at_least=1)
    interval: int = option(
        "correct them every this many steps from timing.start on; each time takes as long as rendering all training "
        "images (of a rig: one for each time) three times",
        1000,
        at_least=1,
    )

    def corrections(self, steps: int) -> range:
        """After which of `steps` steps times are corrected."""
        return range(self.start, steps, self.interval) if self.refine else range(0)


@dataclass(frozen=True)
class EvalConfig(Options):
    """Evaluation during the training. Has defaults, since older config.toml files lack it."""

    interval: int = option(
        "every this many steps, measure the PSNR of some views (eval.views) and write it to log.jsonl; 0: off",
        0,
        at_least=0,
    )
    views: str = option(
        "views for eval.interval; auto: the validation views (a D-NeRF scene's transforms_val.json) or, if there are "
        "none, 8 training views; val; train: 8 training views; or names, comma-separated, such as train_003,train_010",
        "auto",
    )
    snapshots: str = option(
        "steps, comma-separated, such as 500,1000, after which the scene is saved to snapshots/step_NNNNNN.ply in the "
        "run folder, for lapgs-view; empty: none",
        "",
    )
    tensorboard: bool = option(
        "also write the figures of log.jsonl for TensorBoard, to the folder tensorboard of the run (pip install "
        "'lapgs-wgpu[tensorboard]')",
        False,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not re.fullmatch(r"\s*(\d{1,9}(\s*,\s*\d{1,9})*)?\s*", self.snapshots, re.ASCII):
            raise ValueError(f"snapshots must be whole numbers, separated by commas, got {self.snapshots!r}")

    @property
    def snapshot_steps(self) -> set[int]:
        """The steps of `snapshots`."""
        return {int(step) for step in self.snapshots.split(",") if step.strip()}


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
    seed: int = option("seed of all random numbers")
    acceleration: AccelerationConfig = option("", AccelerationConfig())
    exposure: ExposureConfig = option("", ExposureConfig())
    cameras: CamerasConfig = option("", CamerasConfig())
    timing: TimingConfig = option("", TimingConfig())
    discovery: DiscoveryConfig = option("", DiscoveryConfig())
    eval: EvalConfig = option("", EvalConfig())
    antialiased: bool = option(
        "scale each Gaussian's opacity by the ratio of its areas in the image before and after the rasterizer's "
        "low-pass filter (gsplat's antialiased), so that what is thin stays thin at every distance; not of the paper; "
        "viewers that draw without it show the scene a little thicker",
        False,
    )
    decoder: DecoderPlace = option(
        "where the decoder of the fields grid4d and laplacian runs during training; torch: on the CPU; "
        "device: as kernels on the device, which changes the last bits and needs field.depth 0 and, "
        "for the field laplacian, field.motion laplacian; auto: torch on CPU devices, device on others where it can; "
        "config.toml records which",
        "torch",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.decoder == "device" and not self.field.decodes_on_device:
            raise ValueError(
                "decoder device is for the fields grid4d and laplacian with field.depth 0, and for laplacian only with "
                f"field.motion laplacian, not for {self.field.kind} with depth {self.field.depth} and motion "
                f"{self.field.motion}"
            )
