"""From the Gaussians as they are trained to those that are drawn at a time, on the device, and back."""

from collections.abc import Sequence

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.motion.fields.config import GEOMETRY, FieldConfig
from lapgs_wgpu.motion.passes.grid_field_passes import Decoding, FieldArrays
from lapgs_wgpu.motion.passes.samples import SamplePasses
from lapgs_wgpu.splat.drawing import GaussianGradients
from lapgs_wgpu.splat.gaussians import Gaussians

GEOMETRY_FLOATS = 12  # of a Gaussian, common/geometry.wgsl
SH_FLOATS = 48


class ActivationPasses:
    """Records the passes on one device. values, gradients: of the Gaussians as they are trained."""

    def __init__(self, device: Device, config: FieldConfig) -> None:
        self._device, self._config = device, config
        self._pool = BufferPool(device)
        self._samples = SamplePasses(device, self._pool)
        self._outputs = sum(GEOMETRY) + config.appearance_size
        self._mirror = float(config.negative_scales == "mirror")

    def activate(
        self,
        commands: Commands,
        values: FieldArrays,
        degree: int,
        decoding: Decoding | None,
        *,
        antialiased: bool | float,
    ) -> Gaussians[DeviceArray]:
        """Record the activation of Gaussians; without a decoding they stand still.

        degree: of the harmonics that are drawn.
        """
        n = values.geometry.shape[0]
        shapes = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
        drawn = {name: self._pool.array(name, shape) for name, shape in shapes.items()}
        colors = self._pool.array("sh", (n, (degree + 1) ** 2, 3))
        arrays = drawn | {"geometry": values.geometry, "sh": values.sh, "colors": colors}
        self._run(commands, decoding, arrays, back=False)
        return Gaussians(**drawn, sh=colors, antialiased=antialiased)

    def activate_bwd(
        self,
        commands: Commands,
        values: FieldArrays,
        drawn: Gaussians[DeviceArray],
        by_drawn: GaussianGradients,
        decoding: Decoding | None,
        gradients: FieldArrays,
    ) -> None:
        """Record the gradients: of geometry is added to, of sh written, and the decoding's outputs become theirs."""
        assert by_drawn.sh is not None
        arrays = {"geometry": values.geometry, "opacities": drawn.opacities, "d_geometry": gradients.geometry}
        arrays |= {"d_splats": by_drawn.splats, "d_means": by_drawn.means, "d_quats": by_drawn.quats}
        arrays |= {"d_scales": by_drawn.scales, "sh": gradients.sh, "colors": by_drawn.sh}
        self._run(commands, decoding, arrays, back=True)

    def acceleration(
        self,
        commands: Commands,
        decodings: Sequence[Decoding],
        scale: float,
        values: FieldArrays,
        drawn: Gaussians[DeviceArray],
        by_drawn: GaussianGradients,
        gradients: FieldArrays,
    ) -> DeviceArray:
        """Record the acceleration loss of each sample, without its weight: (count,).

        decodings: of all Gaussians at the time of a step, and of samples before and after it, which should lie on a
        line with these. scale: of the gradient: the loss's weight, divided by the number of samples. Its gradients are
        added to those of the Gaussians; the outputs of both decodings become theirs.
        """
        (now, before, after), kernel = decodings, Kernel.get(self._device, "acceleration")
        assert before.sampling is not None

        def write() -> bytes:
            share = (now.time() - before.time()) / (after.time() - before.time())
            return kernel.uniform("Acceleration", outputs=self._outputs, mirror=self._mirror, share=share, scale=scale)

        losses = self._pool.array("accelerations", (before.points.count,))
        arrays = {"geometry": values.geometry, "d_geometry": gradients.geometry, "values": losses}
        arrays |= {"means": drawn.means, "scales": drawn.scales, "before": before.outputs, "after": after.outputs}
        arrays |= {"d_means": by_drawn.means, "d_scales": by_drawn.scales}
        arrays |= {"biases_before": before.biases, "biases_after": after.biases}
        arrays["samples"] = self._samples.uniform("line", before.sampling)
        arrays["acceleration"] = self._pool.varying("acceleration", write)
        for name in ("acceleration", "acceleration_bwd"):
            commands.run(Kernel.get(self._device, name), -(-before.points.count // 64), arrays)
        return losses

    def _run(
        self, commands: Commands, decoding: Decoding | None, arrays: dict[str, DeviceArray], *, back: bool
    ) -> None:
        """Record `activate` or `activate_bwd`, and `activate_sh`, between the harmonics that are trained and the colors
        that are drawn."""
        count, moving = arrays["geometry"].shape[0], decoding is not None
        if decoding is not None:
            arrays |= {"biases": decoding.biases, "outputs": decoding.outputs}
        changes = self._config.appearance_size if moving else 0
        kernel = Kernel.get(self._device, "activate_bwd" if back else "activate", MOVING=moving, OPACITY=changes > 3)
        sizes = {"gaussians": count, "outputs": self._outputs}
        activation = self._pool.constant(kernel.uniform("Activate", mirror=self._mirror, **sizes))
        commands.run(kernel, -(-count // 64), arrays | {"activation": activation})
        kernel = Kernel.get(self._device, "activate_sh", COLOR=changes > 0, BACK=back)
        harmonics = self._pool.constant(kernel.uniform("Harmonics", floats=3 * arrays["colors"].shape[1], **sizes))
        commands.run(kernel, -(-count * SH_FLOATS // 64), arrays | {"harmonics": harmonics})
