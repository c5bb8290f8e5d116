"""Training for a long time takes no more memory than training for a short one.

LAPGS_SOAK_MINUTES (make soak: 30) says for how long; without it the test is skipped. The same short training, with
changes of density and resets of the opacities, runs again and again in one process, each time from a new `Trainer`:
at the same step of each round the memory must be the same, once caches and allocators have warmed up. The figures go
into LAPGS_SOAK_OUT (soak.json).
"""

import gc
import json
import os
import time
from pathlib import Path
from typing import Any

import pytest
from helpers.training import configure
from synthetic import write_synthetic

from lapgs_wgpu.data import load_dataset
from lapgs_wgpu.gpu.array import BufferPool
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.train.host import keep_freed_memory
from lapgs_wgpu.train.trainer import Trainer

MINUTES = float(os.environ.get("LAPGS_SOAK_MINUTES", "0"))
STEPS = 40  # of a round: three changes of density, a reset of the opacities
WARM_UP = 0.3  # share of the time
MOST_GROWTH = 0.02  # of the resident memory, from the middle of what is left to its end
LEAST_ROUNDS = 8


def resident_bytes() -> int:
    """Memory of this process, as the system counts it."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def buffer_bytes() -> int:
    """On the device, in all pools that are alive."""
    return sum(pool.nbytes for pool in gc.get_objects() if type(pool) is BufferPool)


def verdict(samples: list[dict[str, Any]], seconds: float) -> list[str]:
    """What is wrong with the samples taken at the ends of rounds; nothing where the memory is flat."""
    warm = [sample for sample in samples if sample["seconds"] >= WARM_UP * seconds]
    if len(warm) < LEAST_ROUNDS:
        return [f"only {len(warm)} rounds after the warm-up; {LEAST_ROUNDS} are needed"]
    faults = []
    buffers = {sample["buffers"] for sample in warm}
    if len(buffers) > 1:
        faults.append(f"buffers on the device went from {min(buffers)} to {max(buffers)} bytes")
    half = len(warm) // 2
    before, after = (max(sample["resident"] for sample in part) for part in (warm[:half], warm[half:]))
    if after > before * (1 + MOST_GROWTH):
        faults.append(f"resident memory grew from {before} to {after} bytes")
    if len({sample["gaussians"] for sample in samples}) > 1:
        faults.append("the rounds ended with different numbers of Gaussians")
    return faults


def samples_of(resident: list[float], buffers: list[int]) -> list[dict[str, Any]]:
    return [
        {"seconds": float(i), "resident": r, "buffers": b, "gaussians": 9}
        for i, (r, b) in enumerate(zip(resident, buffers, strict=True))
    ]


def test_growth_is_noticed() -> None:
    """The verdict on made-up samples: flat ones, a leak of 1 MB a round, a pool that is not given back."""
    flat = [1e9 + 1e6 * (i % 3) for i in range(40)]
    assert verdict(samples_of(flat, [7] * 40), 40) == []
    assert verdict(samples_of([2e9] * 5 + flat[5:], [9] * 5 + [7] * 35), 40) == []  # while it warms up
    assert "resident memory grew" in verdict(samples_of([1e8 + 1e6 * i for i in range(40)], [7] * 40), 40)[0]
    assert "buffers" in verdict(samples_of(flat, [7] * 30 + [8] * 10), 40)[0]
    assert "rounds" in verdict(samples_of(flat[:5], [7] * 5), 5)[0]


@pytest.mark.skipif(MINUTES == 0, reason="takes LAPGS_SOAK_MINUTES; make soak sets it")
def test_memory_is_flat(device: Device, tmp_path: Path) -> None:
    dataset = load_dataset(write_synthetic(tmp_path / "scene", size=32, train_views=8, test_views=2))
    config = configure(schedule__steps=str(STEPS), density__stop=str(STEPS))
    keep_freed_memory()
    samples: list[dict[str, Any]] = []
    start = time.monotonic()
    while time.monotonic() - start < 60 * MINUTES:
        training = Trainer(config, dataset, device)
        counts = {len(training.scene)}
        for _ in range(STEPS):
            training.step()
            counts.add(len(training.scene))
        training.close()
        assert len(counts) > 3  # the density did change
        gc.collect()
        samples.append(
            {
                "seconds": round(time.monotonic() - start, 3),
                "gaussians": len(training.scene),
                "resident": resident_bytes(),
                "buffers": buffer_bytes(),
            }
        )
        del training
    faults = verdict(samples, 60 * MINUTES)
    result = {"minutes": MINUTES, "steps": STEPS * len(samples), "faults": faults, "samples": samples}
    Path(os.environ.get("LAPGS_SOAK_OUT", "soak.json")).write_text(json.dumps(result, indent=1) + "\n")
    assert not faults
