"""How many threads torch uses in a training step."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.motion.fields.config import FieldConfig

SMALL_WIDTH = 64  # of a decoder whose operators are too short to share


def step_threads(field: FieldConfig, device: Device) -> int | None:
    """The number of threads; None for torch's own, which the environment variable OMP_NUM_THREADS sets.

    On a CPU device a step alternates between torch and the driver, and a thread of torch that waits for its next
    operator keeps the driver's from a core. The decoder of a GridField has threads of its own; another that is small
    gains less by a second thread of torch than the driver loses (docs/notes/speed.md).
    """
    own = field.kind in ("grid4d", "laplacian") and not field.depth
    single = own or field.kind == "static" or field.width <= SMALL_WIDTH
    return 1 if device.is_cpu and single and "OMP_NUM_THREADS" not in os.environ else None


@contextmanager
def torch_threads(count: int | None) -> Iterator[None]:
    """Let torch use so many threads in the `with` block; None: no change."""
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)
