"""The training that lapgs-prepare --train chooses: from the adapter, the capture, the time, and a measured step."""

import dataclasses
from pathlib import Path

import pytest
from synthetic import write_synthetic

from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.errors import DeviceMemoryError, InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.plan import WHOLE, Plan, camera_layout, plan_training, scale_schedule, step_seconds
from lapgs_wgpu.train.presets import load_config


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_synthetic(tmp_path_factory.mktemp("scene") / "scene", size=32, train_views=100, test_views=2)


class FakeDevice:
    """As much of a Device as a plan looks at."""

    def __init__(self, kind: str) -> None:
        self.is_cpu = kind == "cpu"
        self.info = dataclasses.make_dataclass("Info", ["name", "kind"])(f"the {kind} device", kind)


def plan(folder: Path, kind: str, seconds: dict[str, float], minutes: float | None = None, **more) -> Plan:
    """Of a device on which a step of a large and of a small preset takes so many seconds."""

    def measure(config: Config, dataset: Dataset, device: Device) -> float:
        step = seconds["large" if config.points.count == 100_000 else "small"]
        if step == 0:
            raise DeviceMemoryError("too large")
        return step

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("lapgs_wgpu.train.plan.step_seconds", measure)
        return plan_training(folder, load_dataset(folder), FakeDevice(kind), minutes=minutes, **more)


def test_a_cpu_device_gets_the_small_preset(folder: Path) -> None:
    found, tiny = plan(folder, "cpu", {"small": 0.1}), load_config("tiny")
    assert found.config.schedule == tiny.schedule
    assert found.seconds == pytest.approx(WHOLE * 0.1 * 2500)
    assert "tiny (cameras all around, 100 images of 100 times), 2500 steps" in found.text
    assert found.config.density.limit == 2 * tiny.points.count
    assert plan(folder, "cpu", {"small": 0.1}, exposure=True).config.exposure.enabled


def test_a_short_time_shortens_the_schedule_then_refuses(folder: Path) -> None:
    found = plan(folder, "cpu", {"small": 0.1}, minutes=3)
    assert found.config.schedule.steps == pytest.approx(1200, abs=1)
    assert found.seconds == pytest.approx(180, abs=1)
    assert found.config.discovery.steps == 384
    for minutes in (0.5, 0, float("nan")):
        with pytest.raises(InputError, match="minutes"):
            plan(folder, "cpu", {"small": 0.1}, minutes=minutes)


def test_graphics_cards_get_the_large_preset_where_it_fits(folder: Path) -> None:
    def points(large: float, small: float, minutes: float | None = None) -> int:
        return plan(folder, "discrete", {"large": large, "small": small}, minutes).config.points.count

    large, small = 100_000, load_config("tiny").points.count
    assert points(0.01, 0.001) == points(0.1, 0.01) == large
    assert plan(folder, "discrete", {"large": 0.1}).seconds == pytest.approx(3600, abs=1)
    assert points(1.0, 0.1) == points(0.01, 0.001, minutes=1) == small
    assert points(0, 0.1) == small, "memory gives out"


def test_many_times_need_more_steps(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = load_dataset(folder)
    views = tuple(dataclasses.replace(view, time=i / 500) for i, view in enumerate(dataset.train * 4))
    many = dataclasses.replace(dataset, train=views)
    monkeypatch.setattr("lapgs_wgpu.train.plan.open_data", lambda config: (config, many))
    assert plan(folder, "cpu", {"small": 0.01}).config.schedule.steps == 20 * 400


def test_camera_layouts(folder: Path) -> None:
    dataset = load_dataset(folder)
    assert camera_layout(dataset) == "cameras all around"
    assert camera_layout(dataclasses.replace(dataset, own_footage=True)) == "one moving camera"
    static = tuple(dataclasses.replace(view, camera=dataset.train[0].camera) for view in dataset.train)
    assert camera_layout(dataclasses.replace(dataset, train=static)) == "static cameras"


def test_all_schedules_are_scaled() -> None:
    config = load_config("tiny")
    half = scale_schedule(config, 1250)
    assert (half.schedule.steps, half.schedule.warm_up, half.cameras.start) == (1250, 125, 150)
    assert half.rates.means.steps == half.rates.hash.steps == half.rates.mlp.steps == 1250
    assert half.rates.means.start == config.rates.means.start
    assert (half.density.start, half.density.stop, half.density.interval) == (82, 832, 40)
    assert half.discovery.field_steps == 750
    assert list(half.timing.corrections(1250)) == [850, 1000, 1150]
    assert scale_schedule(config, 2500) == config
    assert scale_schedule(config, 1).density.interval == 1


def test_a_step_is_measured_and_nothing_written(folder: Path, device: Device) -> None:
    config = load_config("tiny", {"data.path": str(folder), "points.count": 300, "field.width": 8})
    before = sorted(folder.rglob("*"))
    assert step_seconds(config, load_dataset(folder), device) > 0
    assert sorted(folder.rglob("*")) == before
