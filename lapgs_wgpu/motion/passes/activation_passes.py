"""From the Gaussians as they are trained to those that are drawn at a time, on the device, and back."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.motion.fields.config import GEOMETRY, FieldConfig
from lapgs_wgpu.motion.passes.grid_field_passes import Decoding
from lapgs_wgpu.motion.passes.samples import SamplePasses, Sampling
from lapgs_wgpu.splat.drawing import GaussianGradients
from lapgs_wgpu.splat.gaussians import Gaussians

GEOMETRY_FLOATS = 12  # of a Gaussian, common/geometry.wgsl
SH_FLOATS = 48


class Line(NamedTuple):
    """Samples before and after the time of a step, which should lie on a line.

    Attributes:
        sampling: gives the samples of the Gaussians.
        before, after: they at these times.
        share: gives that of the way from the one to the other.
        scale: of the gradient: the loss's weight, divided by the number of samples.
    """

    sampling: Sampling
    before: Decoding
    after: Decoding
    share: Callable[[], float]
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
        dead: DeviceArray,
        *,
        antialiased: bool,
    ) -> Gaussians[DeviceArray]:
        """Record the activation of Gaussians; without a decoding they stand still.

        degree: of the harmonics that are drawn. dead: (1,) uint32, zero before: how many scales are at the floor.
        """
        n, floats = geometry.shape[0], 3 * (degree + 1) ** 2
        shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
        arrays = {name: self.pool.array(name, shape) for name, shape in shapes.items()}
        colors = self.pool.array("sh", (n, floats // 3, 3))
        given = self._moving(decoding)
        kernel = Kernel.get(self._device, "activate", **self._defines(decoding))
        commands.dispatch(
            kernel, -(-n // 64), activation=self._uniform(n), geometry=geometry, dead=dead, **given, **arrays
        )
        color = self._color(decoding)
        kernel = Kernel.get(self._device, "activate_sh", COLOR=bool(color))
        uniform = self._harmonics(n, floats)
        commands.dispatch(kernel, -(-n * SH_FLOATS // 64), harmonics=uniform, sh=sh, colors=colors, **color)
        return Gaussians(**arrays, sh=colors, antialiased=antialiased)

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
        n = geometry.shape[0]
        kernel = Kernel.get(self._device, "activate_bwd", **self._defines(decoding))
        commands.dispatch(
            kernel,
            -(-n // 64),
            activation=self._uniform(n),
            geometry=geometry,
            opacities=drawn.opacities,
            d_splats=by_drawn.splats,
            d_means=by_drawn.means,
            d_quats=by_drawn.quats,
            d_scales=by_drawn.scales,
            d_geometry=d_geometry,
            **self._moving(decoding),
        )
        assert by_drawn.sh is not None
        color = {name: array for name, array in self._color(decoding).items() if name == "outputs"}
        kernel = Kernel.get(self._device, "activate_sh", BACK=True, COLOR=bool(color))
        uniform = self._harmonics(n, 3 * by_drawn.sh.shape[1])
        commands.dispatch(kernel, -(-n * SH_FLOATS // 64), harmonics=uniform, sh=d_sh, colors=by_drawn.sh, **color)

    def acceleration(
        self, commands: Commands, line: Line, geometry: DeviceArray, drawn: Gaussians[DeviceArray]
    ) -> DeviceArray:
        """Record the acceleration loss of each sample, without its weight: (count,)."""
        values = self.pool.array("accelerations", (line.before.points.count,))
        kernel = Kernel.get(self._device, "acceleration")
        self._line(commands, kernel, line, geometry, drawn, values=values)
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
        kernel = Kernel.get(self._device, "acceleration_bwd")
        added = {"d_means": by_drawn.means, "d_scales": by_drawn.scales, "d_geometry": d_geometry}
        self._line(commands, kernel, line, geometry, drawn, **added)

    def _line(
        self,
        commands: Commands,
        kernel: Kernel,
        line: Line,
        geometry: DeviceArray,
        drawn: Gaussians[DeviceArray],
        **more: DeviceArray,
    ) -> None:
        def write() -> bytes:
            given = {"outputs": self._outputs, "mirror": self._mirror}
            return kernel.uniform("Acceleration", **given, share=line.share(), scale=line.scale)

        commands.dispatch(
            kernel,
            -(-line.before.points.count // 64),
            samples=self._samples.uniform("line", line.sampling),
            acceleration=self.pool.varying("acceleration", write),
            biases_before=line.before.heads.biases,
            biases_after=line.after.heads.biases,
            geometry=geometry,
            means=drawn.means,
            scales=drawn.scales,
            before=line.before.outputs,
            after=line.after.outputs,
            **more,
        )

    def _defines(self, decoding: Decoding | None) -> dict[str, int]:
        moving = decoding is not None
        return {"MOVING": moving, "OPACITY": moving and self._config.appearance_size > 3}

    def _moving(self, decoding: Decoding | None) -> dict[str, DeviceArray]:
        return {} if decoding is None else {"biases": decoding.heads.biases, "outputs": decoding.outputs}

    def _color(self, decoding: Decoding | None) -> dict[str, DeviceArray]:
        """What the colors are changed by."""
        return self._moving(decoding) if self._config.appearance_size else {}

    def _uniform(self, count: int) -> DeviceArray:
        kernel = Kernel.get(self._device, "activate")
        content = kernel.uniform("Activate", gaussians=count, outputs=self._outputs, mirror=self._mirror)
        return self.pool.constant("activate", content)

    def _harmonics(self, count: int, floats: int) -> DeviceArray:
        kernel = Kernel.get(self._device, "activate_sh")
        content = kernel.uniform("Harmonics", gaussians=count, floats=floats, outputs=self._outputs)
        return self.pool.constant("harmonics", content)
