"""The presets of D-NeRF: their schedules, and what the times of a capture change in them."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lapgs_wgpu.train.config import Config, Rate
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.setup import resolve_for_dataset


def on_capture(config: Config, times: int) -> Config:
    """The configuration as a training takes it, on a capture of so many times."""
    dataset: Any = SimpleNamespace(times=np.linspace(0, 1, times))
    return resolve_for_dataset(config, dataset)


def test_the_short_schedule_of_dnerf() -> None:
    """`dnerf-400` has the losses and the method of `dnerf`; every falling rate ends with its steps."""
    full, short = load_config("dnerf"), load_config("dnerf-400")
    assert (full.data.size, short.data.size) == (0, 400)
    for part in ("loss", "smoothness", "discovery", "exposure", "cameras", "eval"):
        assert getattr(short, part) == getattr(full, part), part
    smaller = {name: getattr(short.field, name) for name in ("static", "temporal", "width")}
    assert short.field == dataclasses.replace(full.field, **smaller)
    assert all(rate.steps in (1, short.schedule.steps) for rate in short.rates.schedules().values())
    assert short.density.stop < short.schedule.steps < short.density.reset_interval


def test_no_more_frequencies_than_the_times_can_tell_apart() -> None:
    config = load_config("dnerf")
    for times, step, count in ((300, 1.0, 16), (31, 1.0, 16), (20, 1.0, 10), (20, 0.5, 16), (1, 1.0, 1)):
        half = dataclasses.replace(config, field=dataclasses.replace(config.field, frequency_step=step))
        assert on_capture(half, times).field.components == count


def test_a_rate_of_zero_freezes() -> None:
    assert [Rate(0.0, 0.0, 10).at(step) for step in (1, 10, 99)] == [0, 0, 0]
    assert [Rate(1e-3, 0.0, 10).at(step) for step in (5, 10, 99)] == pytest.approx([5e-4, 0, 0])
    assert load_config("tiny", {"rates.means.start": 0, "rates.quats": 0}).rates.quats == 0
