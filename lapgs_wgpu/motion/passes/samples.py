"""Gaussians that a step looks at more closely, drawn on the device: one of each stretch of neighboring rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.pool import BufferPool


@dataclass(frozen=True)
class Samples:
    """`count` of so many Gaussians, all different (common/samples.wgsl).

    first: row at which the first stretch begins. seed: of 32 bits, of the places within stretches, and of offsets.
    reach: largest offset along each axis, world units.
    """

    count: int
    gaussians: int
    first: int = 0
    seed: int = 0
    reach: float = 0.0

    def uniform(self, kernel: Kernel) -> bytes:
        """The content of the struct Samples of a kernel that has it."""
        stretch = max(1, self.gaussians // max(1, self.count))
        return kernel.uniform("Samples", stretch=stretch, **vars(self))


Sampling = Callable[[], Samples]  # gives the samples of the step that is taken, whose number is the same in each


class SamplePasses:
    """Records the passes that collect what is sampled. name, in the calls: distinguishes samples that are submitted
    together."""

    def __init__(self, device: Device, pool: BufferPool) -> None:
        self._device, self._pool = device, pool

    def places(self, commands: Commands, name: str, sampling: Sampling | None, geometry: DeviceArray) -> DeviceArray:
        """Points (count, 4) at the sampled Gaussians' means, with offsets where they have a reach; None: at all means.

        geometry: (N, 12), as common/geometry.wgsl has it.
        """
        every, n = sampling is None, geometry.shape[0]
        sampling = sampling or partial(Samples, n, n)
        samples = sampling()
        points = self._pool.array(f"points {name}", (samples.count, 4))
        kernel = Kernel.get(self._device, "place_points", SAMPLED=not every, OFFSET=samples.reach > 0)
        uniform = self.uniform(name, sampling)
        groups = -(-samples.count // 64)
        commands.dispatch(kernel, groups, samples=uniform, geometry=geometry, points=points)
        return points

    def rows(
        self, commands: Commands, name: str, sampling: Sampling, every: DeviceArray, chosen: DeviceArray, *, back: bool
    ) -> None:
        """The sampled rows of an array (N, C), copied to (count, C), or with `back` added from there."""
        columns = every.shape[1]
        kernel = Kernel.get(self._device, "sample_rows", BACK=back)
        commands.dispatch(
            kernel,
            -(-chosen.size // 64),
            samples=self.uniform(name, sampling),
            row=self._pool.constant(kernel.uniform("Row", columns=columns)),
            chosen=chosen,
            all=every,
        )

    def uniform(self, name: str, sampling: Sampling) -> DeviceArray:
        """The uniform of the samples."""
        kernel = Kernel.get(self._device, "place_points")
        return self._pool.varying(f"samples {name}", lambda: sampling().uniform(kernel))
