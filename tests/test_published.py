# ruff: noqa: E501  the table of published settings
"""The presets of single scenes against the settings that Grid4D (Xu et al. 2024) published for each, in the units of
their captures; and D-NeRF's."""

import dataclasses
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from lapgs_wgpu.train.config import Config, Rate
from lapgs_wgpu.train.optimizer import rate_at
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.setup import resolve_for_dataset

POSITION_RATE = (8e-4, 8e-6)  # 1.6e-4 to 1.6e-6, times Grid4D's spatial_lr_scale of 5
SCALES = (0.09, 1.0, 2.4)  # world units per unit of a capture


class Published(NamedTuple):
    """A scene's settings. reach: of the spatial and of the space-time grids. rates: factors of 1.6e-4 for tables and
    layers. weights: of the smoothness, spatial and temporal."""

    bound: float
    static_finest: int
    base: tuple[int, int, int]
    finest: tuple[int, int, int]
    rates: tuple[float, float]
    weights: float
    reach: tuple[float, float]
    warm_up: int
    reset: int
    densify_until: int
    steps: int
    field_rate_steps: int
    position_rate_steps: int
    depth: int = 1
    dssim: float = 0.2
    interval: int = 100
    world_size_prune: bool = True
    smooth_after_densify: bool = False


B16, B8 = (16, 16, 16), (16, 16, 8)
STEAK = Published(
    30.0, 2048, B16, (512, 512, 128), (50, 1), 0.5, (5e-3, 5e-3), 3000, 6000, 15_000, 20_000, 45_000, 35_000,
    depth=0, interval=400, world_size_prune=False, smooth_after_densify=True,
)  # fmt: skip
COFFEE = STEAK._replace(finest=(64, 64, 128), weights=0.0, reach=(1e-3, 1e-3), steps=50_000, dssim=0.0)
# fmt: off
PUBLISHED = {
    "hypernerf-3dprinter": Published(1.0, 256, B8, (512, 512, 32), (50, 1), 1.0, (1e-2, 1e-2), 1000, 3000, 15_000, 40_000, 40_000, 35_000),
    "hypernerf-broom": Published(0.8, 2048, B16, (256, 256, 64), (50, 1), 1.0, (1e-3, 1e-2), 0, 3000, 12_000, 30_000, 30_000, 30_000),
    "hypernerf-chicken": Published(1.6, 2048, B8, (512, 512, 32), (50, 1), 1.0, (1e-3, 1e-2), 1000, 1000, 10_000, 40_000, 25_000, 25_000),
    "hypernerf-peel-banana": Published(1.0, 2048, B16, (256, 256, 256), (10, 1), 1.0, (1e-2, 1e-2), 0, 1000, 7000, 30_000, 30_000, 25_000),
    "hypernerf-aleks-teapot": Published(0.8, 2048, B16, (256, 256, 128), (5, 0.5), 1.0, (1e-3, 1e-3), 3000, 1000, 12_000, 40_000, 30_000, 30_000),
    "hypernerf-chickchicken": Published(1.6, 2048, B8, (128, 128, 32), (50, 1), 1.0, (1e-3, 1e-2), 0, 1000, 10_000, 25_000, 25_000, 20_000),
    "hypernerf-cut-lemon": Published(0.8, 2048, B16, (128, 128, 128), (10, 1), 0.1, (1e-3, 1e-3), 3000, 3000, 15_000, 50_000, 45_000, 35_000),
    "hypernerf-hand": Published(1.3, 2048, B16, (512, 512, 256), (10, 1), 0.5, (1e-3, 1e-3), 3000, 1000, 10_000, 40_000, 35_000, 35_000),
    "hypernerf-slice-banana": Published(1.0, 2048, B16, (512, 512, 64), (10, 1), 0.5, (1e-3, 1e-3), 1000, 1000, 10_000, 20_000, 20_000, 20_000),
    "hypernerf-torchocolate": Published(2.0, 2048, B16, (512, 512, 128), (5, 0.5), 0.1, (1e-3, 1e-3), 3000, 3000, 15_000, 50_000, 45_000, 35_000),
    "neu3d-coffee_martini": COFFEE,
    "neu3d-flame_salmon": COFFEE,
    "neu3d-cook_spinach": STEAK,
    "neu3d-cut_roasted_beef": STEAK,
    "neu3d-flame_steak": STEAK,
    "neu3d-sear_steak": STEAK,
}
# fmt: on


def on_capture(config: Config, scale: float, times: int = 300) -> Config:
    """The configuration as a training takes it, on a capture of which a unit becomes `scale` world units."""
    dataset: Any = SimpleNamespace(scale=scale, times=np.linspace(0, 1, times))
    return resolve_for_dataset(config, dataset)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize("name", PUBLISHED)
def test_a_preset_is_what_was_published_times_the_captures_scale(name: str, scale: float) -> None:
    known, config = PUBLISHED[name], on_capture(load_config(name), scale)
    field, density, smoothness, rates = config.field, config.density, config.smoothness, config.rates
    # Lengths.
    assert config.data.units == "world"
    assert field.bound == pytest.approx(scale * known.bound)
    assert field.unit == scale, "the heads' outputs are lengths of the capture"
    start, end = (scale * rate for rate in POSITION_RATE)
    assert dataclasses.astuple(rates.means) == pytest.approx((start, end, known.position_rate_steps))
    assert smoothness.reach == pytest.approx(scale * known.reach[1])
    # A spatial reach of its own is folded into the weight, which features' squared differences grow with.
    ratio = (known.reach[0] / known.reach[1]) ** 2
    assert (smoothness.static, smoothness.temporal) == pytest.approx((known.weights * ratio, known.weights))
    assert (smoothness.share, smoothness.time_reach) == (1.0, 0.0)
    assert smoothness.start == (known.densify_until if known.smooth_after_densify else 0)
    # The grids cover the published cube, so their resolutions stay.
    assert (field.static.base, field.static.finest) == (B16, (known.static_finest,) * 3)
    assert (field.temporal.base, field.temporal.finest) == (known.base, known.finest)
    assert (field.static.levels, field.temporal.levels) == (16, 32)
    assert (field.static.table_log2, field.temporal.table_log2, field.width, field.depth) == (19, 19, 256, known.depth)
    # Numbers without a length.
    of_tables, of_layers = known.rates
    tables = (1.6e-4 * of_tables, 1.6e-6 * of_tables, known.field_rate_steps)
    assert dataclasses.astuple(rates.hash) == pytest.approx(tables)
    assert dataclasses.astuple(rates.mlp) == pytest.approx((1.6e-4 * of_layers, 1.6e-6, known.field_rate_steps))
    assert (config.schedule.steps, config.schedule.warm_up) == (known.steps, known.warm_up)
    assert (density.stop, density.reset_interval) == (known.densify_until, known.reset)
    assert (density.interval, density.max_world_size) == (known.interval, 0.1 if known.world_size_prune else 0)
    assert (density.gradient, density.min_opacity) == (2e-4, 0.005)
    assert config.loss.ssim == known.dssim
    assert config.data.undistort == (not name.startswith("hypernerf"))
    assert config.data.size == (960 if name.startswith("hypernerf") else 1352)


def test_presets_of_dnerf() -> None:
    full = load_config("dnerf")
    assert on_capture(full, 0.1) == full, "lengths in world units are left alone"
    assert full.field.negative_scales == "mirror"


def test_the_short_schedule_of_dnerf() -> None:
    """`dnerf-400` has the losses and the method of `dnerf`; every falling rate ends with its steps."""
    full, short = load_config("dnerf"), load_config("dnerf-400")
    assert (full.data.size, short.data.size) == (0, 400)
    for part in ("loss", "smoothness", "exposure", "cameras", "eval"):
        assert getattr(short, part) == getattr(full, part), part
    assert short.discovery == dataclasses.replace(full.discovery, least=load_config("tiny").discovery.least)
    smaller = {name: getattr(short.field, name) for name in ("static", "temporal", "width")}
    assert short.field == dataclasses.replace(full.field, **smaller)
    assert all(rate.steps in (1, short.schedule.steps) for rate in short.rates.schedules().values())
    assert short.density.stop < short.schedule.steps < short.density.reset_interval


def test_no_more_frequencies_than_the_times_can_tell_apart() -> None:
    config = load_config("dnerf")
    for times, step, count in ((300, 1.0, 16), (31, 1.0, 16), (20, 1.0, 10), (20, 0.5, 16), (1, 1.0, 1)):
        half = dataclasses.replace(config, field=dataclasses.replace(config.field, frequency_step=step))
        assert on_capture(half, 1.0, times).field.components == count


def test_a_rate_of_zero_freezes() -> None:
    assert [rate_at(Rate(0.0, 0.0, 10), step) for step in (1, 10, 99)] == [0, 0, 0]
    assert [rate_at(Rate(1e-3, 0.0, 10), step) for step in (5, 10, 99)] == pytest.approx([5e-4, 0, 0])
    assert load_config("tiny", {"rates.means.start": 0, "rates.quats": 0}).rates.quats == 0
