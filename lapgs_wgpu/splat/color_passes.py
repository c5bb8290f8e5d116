"""The colors of Gaussians as a camera sees them, from spherical harmonics or plain ones, and back."""

import math
from collections.abc import Iterator

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.splat.drawing import Drawing, sh_defines


class ColorPasses:
    """Records the passes, one for each range of Gaussians whose colors fit into one binding."""

    def __init__(self, device: Device, pool: BufferPool) -> None:
        self._device, self._pool = device, pool

    def record(self, commands: Commands, drawing: Drawing, frame: DeviceArray, tile_counts: DeviceArray) -> None:
        """Record the colors of the splats that have a tile. tile_counts: (N,)."""
        kernel = Kernel.get(self._device, "color", **sh_defines(drawing.gaussians.sh_degree))
        arrays = {"frame": frame, "means": drawing.gaussians.means, "tile_counts": tile_counts}
        arrays["splats"] = drawing.splats
        for part, groups, colors in self._parts(kernel, drawing.gaussians.sh):
            commands.run(kernel, groups, arrays | {"part": part, "colors": colors})

    def record_bwd(
        self, commands: Commands, drawing: Drawing, d_splats: DeviceArray, d_means: DeviceArray, d_sh: DeviceArray
    ) -> None:
        """Record the gradients by harmonics d_sh (N, K, 3), and those by the means, which are added to d_means."""
        kernel = Kernel.get(self._device, "color_bwd", **sh_defines(drawing.gaussians.sh_degree))
        arrays = {"frame": drawing.frames[0], "means": drawing.gaussians.means}
        arrays |= {"d_splats": d_splats, "d_means": d_means}
        both = zip(self._parts(kernel, drawing.gaussians.sh), self._parts(kernel, d_sh), strict=True)
        for (part, groups, colors), (_, _, d_colors) in both:
            commands.run(kernel, groups, arrays | {"part": part, "colors": colors, "d_colors": d_colors})

    def _parts(self, kernel: Kernel, colors: DeviceArray) -> Iterator[tuple[DeviceArray, int, DeviceArray]]:
        """For each range: the kernel's uniform, the number of workgroups, and the rows of colors."""
        count = colors.shape[0]
        most = self._device.max_binding // (4 * math.prod(colors.shape[1:])) // 64 * 64  # ranges begin at 256 bytes
        for first in range(0, count, most):
            rows = colors.rows(first, min(most, count - first))
            content = kernel.uniform("Part", first=first, count=rows.shape[0])
            yield self._pool.constant(content), -(-rows.shape[0] // 64), rows
