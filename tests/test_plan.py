"""The training that lapgs-prepare --train chooses: from the adapter, the capture, the time, and measured steps."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from lapgs_wgpu.data import Dataset, load_dataset
from lapgs_wgpu.data.builtin import write_builtin
from lapgs_wgpu.errors import DeviceMemoryError, InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train import step_costs
from lapgs_wgpu.train.config import Config
from lapgs_wgpu.train.plan import LEAST_STEPS, Plan, layout_of, plan_training, scaled
from lapgs_wgpu.train.presets import load_config
from lapgs_wgpu.train.step_costs import GROWTH, USUAL, Costs, measure_costs


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_builtin("synthetic", tmp_path_factory.mktemp("scene"))


class FakeDevice:
    """As much of a Device as a plan looks at."""

    def __init__(self, kind: str) -> None:
        self.is_cpu = kind == "cpu"
        self.info = dataclasses.make_dataclass("Info", ["name", "kind"])(f"the {kind} device", kind)


def plan(folder: Path, kind: str, seconds: dict[str, float], minutes: float | None = None, **more) -> Plan:
    """Of a device on which a step takes so many seconds, by the preset's largest size."""
    tried: list[int] = []

    def measure(config: Config, dataset: Dataset, device: Device) -> Costs:
        tried.append(config.data.size)
        step = seconds["large" if config.points.count == 100_000 else "small"]
        if step == 0:
            raise DeviceMemoryError("too large")
        return Costs(step * 2 / 3, step * 4 / 3, step / 4, step / 10, step)

    return plan_training(folder, load_dataset(folder), FakeDevice(kind), minutes=minutes, measure=measure, **more)


def test_a_cpu_device_gets_the_small_preset(folder: Path) -> None:
    found = plan(folder, "cpu", {"small": 0.1})
    assert found.preset == "tiny"
    assert found.config.schedule.steps == load_config("tiny").schedule.steps
    # 800 steps of discovery at a quarter of the time, 2,500 steps, three corrections of the times with three pictures
    # of 100 moments at a tenth of the time, 20 test views; at most: a third more a step, and 1,500 steps of the field.
    assert found.seconds == pytest.approx(0.1 * (200 + 2500 + 90 + 20))
    assert found.at_most == pytest.approx(0.1 * (200 + 1500 + 4 / 3 * 2500 + 90 + 20))
    assert "tiny (cameras all around, 100 images of 100 moments)" in found.text
    assert "(the cpu device, a CPU device), 2500 steps (its schedule)" in found.text
    assert "67 to 133 ms a step, measured here: it will take about 4:41, at most 8:34." in found.text
    assert found.config.density.limit == GROWTH * found.config.points.count


def test_a_short_time_shortens_the_schedule(folder: Path) -> None:
    found = plan(folder, "cpu", {"small": 0.1}, minutes=3)
    assert 3 * 60 - 0.2 < found.seconds <= 3 * 60
    assert found.config.data.size == 128  # the scene's own
    assert found.config.schedule.steps == 1564
    assert found.config.discovery.steps == round(800 * 1564 / 2500)
    assert "1564 steps (of 2500: what the time allows)" in found.text


def test_a_very_short_time_takes_smaller_images_then_refuses(folder: Path) -> None:
    found = plan(folder, "cpu", {"small": 0.1}, minutes=1)
    assert found.config.data.size == 77  # 0.6 of 128
    assert LEAST_STEPS <= found.config.schedule.steps < 1000
    with pytest.raises(InputError, match=r"^0\.2 minutes are enough for \d+ steps .* give --minutes 0\.7 or more"):
        plan(folder, "cpu", {"small": 0.1}, minutes=0.2)
    plan(folder, "cpu", {"small": 0.1}, minutes=0.7)


def test_graphics_cards_get_the_large_preset_where_it_fits(folder: Path) -> None:
    fast, slow = {"large": 0.01, "small": 0.001}, {"large": 1.0, "small": 0.1}
    assert plan(folder, "discrete", fast).preset == "dnerf"
    assert plan(folder, "discrete", fast).config.schedule.steps == 50_000
    hour = plan(folder, "discrete", {"large": 0.1, "small": 0.01})
    assert hour.preset == "dnerf"
    assert 0.99 * 3600 < hour.seconds <= 3600
    assert plan(folder, "integrated", slow).preset == "tiny"
    assert plan(folder, "discrete", fast, minutes=1).preset == "tiny"
    assert plan(folder, "discrete", {"large": 0, "small": 0.1}).preset == "tiny"  # memory gives out


def test_many_moments_need_more_steps(folder: Path) -> None:
    dataset = load_dataset(folder)
    views = tuple(dataclasses.replace(view, time=i / 500) for i, view in enumerate(dataset.train * 4))
    many = dataclasses.replace(dataset, train=views)
    import lapgs_wgpu.train.plan as module

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "open_dataset", lambda config: many)
        found = plan(folder, "cpu", {"small": 0.01})
    assert found.config.schedule.steps == 20 * 400
    assert "8000 steps (its schedule has 2500; 20 for each moment)" in found.text


def test_layouts(folder: Path) -> None:
    dataset = load_dataset(folder)
    assert layout_of(dataset) == "cameras all around"
    assert layout_of(dataclasses.replace(dataset, own_footage=True)) == "one camera that moves"
    first = dataset.train[0].camera
    still = tuple(dataclasses.replace(view, camera=first) for view in dataset.train)
    assert layout_of(dataclasses.replace(dataset, train=still)) == "still cameras"


def test_all_schedules_are_scaled() -> None:
    config = load_config("tiny")
    half = scaled(config, 1250)
    assert half.schedule.steps == 1250
    assert half.schedule.warm_up == 125
    assert half.rates.means.steps == half.rates.hash.steps == half.rates.mlp.steps == 1250
    assert half.rates.means.start == config.rates.means.start
    assert (half.density.start, half.density.stop, half.density.interval) == (82, 832, 40)
    assert half.cameras.start == 150
    assert half.discovery.field_steps == 750
    assert list(half.timing.corrections(1250)) == [850, 1000, 1150]
    assert scaled(config, 2500) == config
    assert scaled(config, 1).density.interval == 1


def test_exposure(folder: Path) -> None:
    found = plan(folder, "cpu", {"small": 0.1}, exposure=True)
    assert found.config.exposure.enabled
    assert "colors of each image corrected" in found.text


def test_steps_with_a_further_loss_count(folder: Path, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The acceleration loss of every fourth step."""
    clock = [0.0]

    class Slow(step_costs.Trainer):
        def step(self) -> None:  # type: ignore[override]
            self.done += 1
            clock[0] += 1.0 if self.done % 4 else 5.0

    monkeypatch.setattr(step_costs, "Trainer", Slow)
    monkeypatch.setattr(step_costs.time, "perf_counter", lambda: clock[0])
    config = load_config("tiny", {"data.path": str(folder), "data.size": 64, "points.count": 400})
    costs = measure_costs(config, load_dataset(folder, image_size=64), device)
    assert config.acceleration.interval == 4
    assert (costs.few, costs.many) == (2.0, 2.0)


def test_steps_are_measured(folder: Path, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the numbers of Gaussians that a training begins with and grows to; nothing is written."""
    counts: list[int] = []
    scene = step_costs._scene

    def counted(config: Config, dataset: Dataset, device: Device, count: int) -> Scene4D:
        counts.append(count)
        return scene(config, dataset, device, count)

    monkeypatch.setattr(step_costs, "_scene", counted)
    config = load_config("tiny", {"data.path": str(folder), "data.size": 64, "points.count": 4000})
    before = sorted(folder.rglob("*"))
    costs = measure_costs(config, load_dataset(folder, image_size=64), device)
    assert counts == [4000 * growth for growth in (USUAL, USUAL, GROWTH)]
    assert min(costs.still, costs.few, costs.many, costs.picture, costs.view) > 0
    assert costs.step == (costs.few + costs.many) / 2
    assert sorted(folder.rglob("*")) == before
