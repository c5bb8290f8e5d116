"""Gaussians that a step looks at more closely, drawn on the device."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel


@dataclass(frozen=True)
class Samples:
    """`count` of so many Gaussians, at random, all different (common/samples.wgsl).

    seed: of 32 bits, of the rows and of offsets. reach: largest offset along each axis, world units.
    """

    count: int
    gaussians: int
    seed: int = 0
    reach: float = 0.0

    @property
    def half_bits(self) -> int:
        """Half of the bits that number the Gaussians, rounded up."""
        return -(-(self.gaussians - 1).bit_length() // 2)


NO_SAMPLES = Samples(0, 0)
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
        sampled, n = sampling is not None, geometry.shape[0]
        sampling = sampling or partial(Samples, n, n)
        samples = sampling()
        points = self._pool.array(f"points {name}", (samples.count, 4))
        kernel = Kernel.get(self._device, "place_points", SAMPLED=sampled, OFFSET=samples.reach > 0)
        arrays = {"samples": self.uniform(name, sampling), "geometry": geometry, "points": points}
        commands.dispatch(kernel, -(-samples.count // 64), **arrays)
        return points

    def rows(
        self, commands: Commands, name: str, sampling: Sampling, every: DeviceArray, chosen: DeviceArray, *, back: bool
    ) -> None:
        """The sampled rows of an array (N, C), copied to (count, C), or with `back` added from there."""
        kernel = Kernel.get(self._device, "sample_rows", BACK=back)
        row = self._pool.constant(kernel.uniform("Row", columns=every.shape[1]))
        arrays = {"samples": self.uniform(name, sampling), "row": row, "chosen": chosen, "all": every}
        commands.dispatch(kernel, -(-chosen.size // 64), **arrays)

    def uniform(self, name: str, sampling: Sampling) -> DeviceArray:
        """The uniform of the samples."""
        kernel = Kernel.get(self._device, "place_points")

        def write() -> bytes:
            samples = sampling()
            return kernel.uniform("Samples", half_bits=samples.half_bits, **vars(samples))

        return self._pool.varying(f"samples {name}", write)
