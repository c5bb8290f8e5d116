"""What crosses between host and device in a training step, by purpose, and what that takes on a graphics card's bus."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from measure import recording

from lapgs_wgpu import Trainer
from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.data.synthetic import write_synthetic
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.train.presets import load_config

BUSES = (12, 25)  # gigabytes a second: PCIe 3 and 4 with 16 lanes, as copies reach them
VIEWS = 2
PURPOSES = (  # of buffers whose names, without "input" and "d", begin so
    ("hash tables, and their gradients", ("table",)),
    ("features, and their gradients", ("encoding",)),
    ("Gaussians to draw, and their gradients", ("means", "quats", "scales", "opacities", "sh")),
    ("splats and their gradients, for density control", ("splats",)),
    ("points to encode", ("points",)),
    ("decoder: inputs, weights, outputs, gradients", ("beside", "weights", "outputs", "sums")),
)
REST = "all else"


@dataclass(frozen=True)
class Crossing:
    """Bytes of a step. up: from the host to the device."""

    up: int
    down: int

    def milliseconds(self, gigabytes: float) -> float:
        """On a bus of so many gigabytes a second, one direction after the other."""
        return (self.up + self.down) / (1e6 * gigabytes)


def bench_crossings(device: Device, preset: str, gaussians: int, size: int, decoder: str) -> dict[str, Crossing]:
    """The bytes of a step in which everything moves, by purpose; under "step" all of them.

    size: of the images, pixels. decoder: where it runs, torch or device.
    """
    keys = {"schedule.warm_up": "0", "points.count": str(gaussians), "discovery.enabled": "false", "decoder": decoder}
    config = load_config(preset, keys)
    with TemporaryDirectory() as folder:
        dataset = load_dataset(write_synthetic(Path(folder), size=size, train_views=VIEWS, test_views=1))
        with Trainer(config, dataset, device) as trainer:
            for _ in range(VIEWS):  # in which the images cross, too
                trainer.step()
            with recording() as events:
                trainer.step()
    found = {name: [0, 0] for name in (*(name for name, _ in PURPOSES), REST, "step")}
    for event in events:
        if event.nbytes:
            for name in (_purpose(event.name), "step"):
                found[name][event.kind == "read"] += event.nbytes
    return {name: Crossing(*both) for name, both in found.items() if any(both)}


def _purpose(buffer: str) -> str:
    value = buffer.removeprefix("input ").removeprefix("d_").removeprefix("d ")
    return next((name for name, prefixes in PURPOSES if value.startswith(prefixes)), REST)
