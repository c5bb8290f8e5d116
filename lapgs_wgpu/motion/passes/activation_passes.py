"""From the Gaussians as they are trained to those that are drawn at a time, on the device, and back."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.motion.fields.config import GEOMETRY, FieldConfig
from lapgs_wgpu.motion.passes.decoder_passes import Decoding
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
        self._pool = BufferPool(device)
        self._samples = SamplePasses(device, self._pool)
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
        n = geometry.shape[0]
        shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
        drawn = {name: self._pool.array(name, shape) for name, shape in shapes.items()}
        colors = self._pool.array("sh", (n, (degree + 1) ** 2, 3))
        arrays = drawn | self._moving(decoding) | {"geometry": geometry, "sh": sh, "colors": colors}
        self._geometry(commands, "activate", decoding, arrays)
        self._colors(commands, decoding, arrays, back=False)
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
        arrays = self._moving(decoding) | {"geometry": geometry, "opacities": drawn.opacities, "d_geometry": d_geometry}
        arrays |= {"d_splats": by_drawn.splats, "d_means": by_drawn.means, "d_quats": by_drawn.quats}
        arrays |= {"d_scales": by_drawn.scales, "sh": d_sh, "colors": by_drawn.sh}
        self._geometry(commands, "activate_bwd", decoding, arrays)
        self._colors(commands, decoding, arrays, back=True)

    def acceleration(
        self,
        commands: Commands,
        line: Line,
        geometry: DeviceArray,
        drawn: Gaussians[DeviceArray],
        by_drawn: GaussianGradients,
        d_geometry: DeviceArray,
    ) -> DeviceArray:
        """Record the acceleration loss of each sample, without its weight: (count,).

        Its gradients are added to those of the Gaussians; the outputs of both decodings become theirs.
        """
        (now, before, after, scale), kernel = line, Kernel.get(self._device, "acceleration")
        assert before.sampling is not None

        def write() -> bytes:
            share = (now.time() - before.time()) / (after.time() - before.time())
            return kernel.uniform("Acceleration", outputs=self._outputs, mirror=self._mirror, share=share, scale=scale)

        values = self._pool.array("accelerations", (before.points.count,))
        arrays = {"geometry": geometry, "d_geometry": d_geometry, "values": values}
        arrays |= {"means": drawn.means, "scales": drawn.scales, "before": before.outputs, "after": after.outputs}
        arrays |= {"d_means": by_drawn.means, "d_scales": by_drawn.scales}
        arrays |= {"biases_before": before.biases, "biases_after": after.biases}
        arrays["samples"] = self._samples.uniform("line", before.sampling)
        arrays["acceleration"] = self._pool.varying("acceleration", write)
        for name in ("acceleration", "acceleration_bwd"):
            commands.run(Kernel.get(self._device, name), -(-before.points.count // 64), arrays)
        return values

    def _geometry(self, commands: Commands, name: str, decoding: Decoding | None, arrays: Mapping[str, Any]) -> None:
        """Record `activate` or `activate_bwd`."""
        count, moving = arrays["geometry"].shape[0], decoding is not None
        kernel = Kernel.get(self._device, name, MOVING=moving, OPACITY=moving and self._config.appearance_size > 3)
        content = kernel.uniform("Activate", gaussians=count, outputs=self._outputs, mirror=self._mirror)
        commands.run(kernel, -(-count // 64), {**arrays, "activation": self._pool.constant(content)})

    def _colors(self, commands: Commands, decoding: Decoding | None, arrays: Mapping[str, Any], *, back: bool) -> None:
        """Record `activate_sh`, between the harmonics that are trained and the colors that are drawn."""
        count, changes = arrays["sh"].shape[0], decoding is not None and self._config.appearance_size > 0
        kernel = Kernel.get(self._device, "activate_sh", COLOR=changes, BACK=back)
        floats = 3 * arrays["colors"].shape[1]
        content = kernel.uniform("Harmonics", gaussians=count, outputs=self._outputs, floats=floats)
        commands.run(kernel, -(-count * SH_FLOATS // 64), {**arrays, "harmonics": self._pool.constant(content)})

    def _moving(self, decoding: Decoding | None) -> dict[str, DeviceArray]:
        return {} if decoding is None else {"biases": decoding.biases, "outputs": decoding.outputs}
