"""From the Gaussians as they are trained to those that are drawn at a time, on the device, and back."""

from __future__ import annotations

from typing import NamedTuple

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.motion.fields.config import GEOMETRY, FieldConfig
from lapgs_wgpu.motion.passes.grid_field_passes import Decoding
from lapgs_wgpu.motion.passes.samples import SamplePasses
from lapgs_wgpu.splat.drawing import GaussianGradients
from lapgs_wgpu.splat.gaussians import Gaussians

GEOMETRY_FLOATS = 12  # of a Gaussian, common/geometry.wgsl
SH_FLOATS = 48


class Line(NamedTuple):
    """Samples before and after the time of a step, which should lie on a line with all Gaussians `now`.

    scale: of the gradient: the loss's weight, divided by the number of samples.
    """

    now: Decoding
    before: Decoding
    after: Decoding
    scale: float


class ActivationPasses:
    """Records the passes on one device. geometry: (N, 12) and sh (N, 48), as they are trained, see
    common/geometry.wgsl."""

    def __init__(self, device: Device, config: FieldConfig) -> None:
        self._device, self._config = device, config
        self.pool = BufferPool(device)
        self._samples = SamplePasses(device, self.pool)
        self._outputs = sum(GEOMETRY) + config.appearance_size
        self._mirror = float(config.negative_scales == "mirror")

    def activate(
        self,
        commands: Commands,
        geometry: DeviceArray,
        sh: DeviceArray,
        degree: int,
        decoding: Decoding | None,
        *,
        antialiased: bool,
    ) -> Gaussians[DeviceArray]:
        """Record the activation of Gaussians; without a decoding they stand still.

        degree: of the harmonics that are drawn.
        """
        n, floats = geometry.shape[0], 3 * (degree + 1) ** 2
        shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
        drawn = {name: self.pool.array(name, shape) for name, shape in shapes.items()}
        colors = self.pool.array("sh", (n, floats // 3, 3))
        arrays = drawn | self._moving(decoding) | {"geometry": geometry, "sh": sh, "colors": colors}
        self._dispatch(commands, "activate", n, floats, decoding, arrays)
        self._dispatch(commands, "activate_sh", n, floats, decoding, arrays)
        return Gaussians(**drawn, sh=colors, antialiased=antialiased)

    def activate_bwd(
        self,
        commands: Commands,
        geometry: DeviceArray,
        drawn: Gaussians[DeviceArray],
        by_drawn: GaussianGradients,
        decoding: Decoding | None,
        d_geometry: DeviceArray,
        d_sh: DeviceArray,
    ) -> None:
        """Record the gradients: d_geometry is added to, d_sh written, and the decoding's outputs become theirs."""
        assert by_drawn.sh is not None
        n, floats = geometry.shape[0], 3 * by_drawn.sh.shape[1]
        arrays = self._moving(decoding) | {"geometry": geometry, "opacities": drawn.opacities, "d_geometry": d_geometry}
        arrays |= {"d_splats": by_drawn.splats, "d_means": by_drawn.means, "d_quats": by_drawn.quats}
        arrays |= {"d_scales": by_drawn.scales, "sh": d_sh, "colors": by_drawn.sh}
        self._dispatch(commands, "activate_bwd", n, floats, decoding, arrays)
        self._dispatch(commands, "activate_sh", n, floats, decoding, arrays, BACK=True)

    def acceleration(
        self, commands: Commands, line: Line, geometry: DeviceArray, drawn: Gaussians[DeviceArray]
    ) -> DeviceArray:
        """Record the acceleration loss of each sample, without its weight: (count,)."""
        values = self.pool.array("accelerations", (line.before.points.count,))
        self._line(commands, "acceleration", line, {"geometry": geometry, "values": values}, drawn)
        return values

    def acceleration_bwd(
        self,
        commands: Commands,
        line: Line,
        geometry: DeviceArray,
        drawn: Gaussians[DeviceArray],
        by_drawn: GaussianGradients,
        d_geometry: DeviceArray,
    ) -> None:
        """Record its gradients: added to those of the Gaussians; the outputs of both decodings become theirs."""
        arrays = {"geometry": geometry, "d_geometry": d_geometry}
        arrays |= {"d_means": by_drawn.means, "d_scales": by_drawn.scales}
        self._line(commands, "acceleration_bwd", line, arrays, drawn)

    def _line(
        self,
        commands: Commands,
        name: str,
        line: Line,
        arrays: dict[str, DeviceArray],
        drawn: Gaussians[DeviceArray],
    ) -> None:
        kernel, (now, before, after, scale) = Kernel.get(self._device, name), line
        assert before.sampling is not None

        def write() -> bytes:
            share = (now.time() - before.time()) / (after.time() - before.time())
            return kernel.uniform("Acceleration", outputs=self._outputs, mirror=self._mirror, share=share, scale=scale)

        arrays |= {"means": drawn.means, "scales": drawn.scales, "before": before.outputs, "after": after.outputs}
        arrays |= {"biases_before": before.heads.biases, "biases_after": after.heads.biases}
        arrays["samples"] = self._samples.uniform("line", before.sampling)
        arrays["acceleration"] = self.pool.varying("acceleration", write)
        commands.run(kernel, -(-before.points.count // 64), arrays)

    def _dispatch(
        self,
        commands: Commands,
        name: str,
        count: int,
        floats: int,
        decoding: Decoding | None,
        arrays: dict[str, DeviceArray],
        **defines: int,
    ) -> None:
        """Record one of the passes. floats: of the harmonics that are drawn."""
        harmonics, appearance = name == "activate_sh", self._config.appearance_size if decoding is not None else 0
        sizes = {"gaussians": count, "outputs": self._outputs}
        if harmonics:
            kernel = Kernel.get(self._device, name, COLOR=appearance > 0, **defines)
            uniform = {"harmonics": kernel.uniform("Harmonics", floats=floats, **sizes)}
        else:
            kernel = Kernel.get(self._device, name, MOVING=decoding is not None, OPACITY=appearance > 3)
            uniform = {"activation": kernel.uniform("Activate", mirror=self._mirror, **sizes)}
        given = arrays | {key: self.pool.constant(content) for key, content in uniform.items()}
        commands.run(kernel, -(-count * (SH_FLOATS if harmonics else 1) // 64), given)

    def _moving(self, decoding: Decoding | None) -> dict[str, DeviceArray]:
        return {} if decoding is None else {"biases": decoding.heads.biases, "outputs": decoding.outputs}
