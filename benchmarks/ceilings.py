"""What the device can do at most, measured by small kernels of our own beside what is timed: bytes copied,
multiply-adds and powers of two in a second."""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from measure import Timing
from timestamps import Profile
from work import Work

from lapgs_wgpu.gpu import shader
from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.splat.raster_config import raster_config

COPY, FMA, EXP = KERNELS = ("ceiling_copy", "ceiling_fma", "ceiling_exp")
COPIED = 64 << 20  # bytes: more than what the caches of processors and GPUs hold
CHAINS, STEPS, TURNS = 8, 32, 64  # of the two others: eight chains keep the units busy and fit into the registers
package_text = shader.shader_text
LONG = 20.0  # milliseconds of a kernel: about those of the longest passes, so that other work slows all alike


@dataclass(frozen=True)
class Ceilings:
    """Rates a second. together: exponentials keep the same units busy as all other operations, as on processors."""

    copied_bytes: float
    operations: float
    exponentials: float
    together: bool

    def milliseconds(self, work: Work) -> float:
        """The least time for it: moving its bytes, or computing, whichever takes longer."""
        operations, exponentials = work.operations / self.operations, work.exponentials / self.exponentials
        computing = operations + exponentials if self.together else max(operations, exponentials)
        return 1e3 * max(work.bytes / self.copied_bytes, computing)


class CeilingKernels:
    """The three kernels; those that compute are so large that the device needs `shortest` milliseconds for each."""

    def __init__(self, device: Device, shortest: float = LONG) -> None:
        self._device = device
        shape = raster_config(device)
        defines = shape.raster_defines(depth=False) | {"CHAINS": CHAINS, "STEPS": STEPS}
        with mock.patch.object(shader, "shader_text", _shader_text):
            copy = Kernel.get(device, COPY)
            computing = {name: Kernel.get(device, name, **defines) for name in (FMA, EXP)}
        self._target = DeviceArray.empty(device, "copied to", (COPIED // 4,))
        values = np.random.default_rng(0).random(COPIED // 4, np.float32)
        self._source = DeviceArray.upload(device, "copied from", values)
        content = computing[FMA].uniform("Factors", multiply=0.999, add=0.001, turns=TURNS)
        factors = DeviceArray.upload(device, "factors", np.frombuffer(content, np.uint8))
        self._dispatches: dict[str, Callable[[Commands], None]] = {
            COPY: lambda commands: commands.dispatch(
                copy, COPIED // (16 * 64), source=self._source, copied=self._target
            )
        }
        self._amounts = {COPY: 2 * COPIED}
        for name, kernel in computing.items():
            compute = functools.partial(_compute, kernel, factors, self._target)
            groups = self._long_enough(compute, shortest)
            self._dispatches[name] = compute(groups)
            self._amounts[name] = groups * 64 * CHAINS * STEPS * TURNS

    def _long_enough(self, dispatch: Callable[[int], Callable[[Commands], None]], shortest: float) -> int:
        profile, groups = Profile(self._device), 16
        while True:
            for _ in range(2):  # the first one may wait for the driver's compiler
                with profile.running(), Commands(self._device) as commands:
                    dispatch(groups)(commands)
            if profile.read()[-1][1] > shortest or groups >= 1 << 15:
                return groups
            groups *= 2

    def run(self) -> None:
        """Submit each once."""
        for dispatch in self._dispatches.values():
            with Commands(self._device) as commands:
                dispatch(commands)

    def ceilings(self, milliseconds: dict[str, Timing]) -> Ceilings:
        """From the times of `run`."""
        copied, operations, exponentials = (1e3 * self._amounts[k] / milliseconds[k].median for k in KERNELS)
        return Ceilings(copied, operations, exponentials, self._device.is_cpu)


def _compute(kernel: Kernel, factors: DeviceArray, sums: DeviceArray, groups: int) -> Callable[[Commands], None]:
    return lambda commands: commands.dispatch(kernel, groups, factors=factors, sums=sums)


@functools.cache
def _shader_text(name: str) -> str:
    own = Path(__file__).with_name("shaders") / f"{name}.wgsl"
    return own.read_text(encoding="utf-8") if own.is_file() else package_text(name)


def describe(ceilings: Ceilings) -> str:
    values: dict[str, Any] = {
        "copy": (ceilings.copied_bytes, "GB/s, read and written together"),
        "multiply-add": (ceilings.operations, "billion a second"),
        "power of two": (ceilings.exponentials, "billion a second"),
    }
    return "; ".join(f"{name} {rate / 1e9:.1f} {unit}" for name, (rate, unit) in values.items())
