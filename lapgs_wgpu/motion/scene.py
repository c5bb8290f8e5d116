"""The 4D scene: canonical Gaussians and the field that moves them, as stored in a checkpoint."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device, open_device
from lapgs_wgpu.io.checkpoint import write_checkpoint
from lapgs_wgpu.io.ply import GaussianSnapshot
from lapgs_wgpu.io.safe_json_toml import PathLike
from lapgs_wgpu.motion.fields.config import MIN_SCALE, FieldConfig
from lapgs_wgpu.motion.fields.deformation import Deformation, Deformed, Field, Nearby, TimeSamples
from lapgs_wgpu.motion.fields.grid_field import GridField
from lapgs_wgpu.motion.fields.hexplane_field import HexPlaneField
from lapgs_wgpu.motion.fields.laplacian import LaplacianMotion
from lapgs_wgpu.motion.fields.mlp_field import MlpField
from lapgs_wgpu.motion.fields.own_field import OwnField, check_own
from lapgs_wgpu.motion.scene_file import SceneFile, read_scene, row_shapes, scene_header
from lapgs_wgpu.motion.timing import EVEN, Timing
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rasterize import Rendering, rasterize
from lapgs_wgpu.splat.rotation import quat_multiply

Floats = NDArray[np.floating]


def isotropic_rows(points: Floats, colors: Floats, scales: Floats, opacity: float) -> dict[str, Tensor]:
    """The parameters of isotropic Gaussians that stand still, as `Scene4D` has them; arguments as for `from_points`."""
    n = len(points)
    return {
        "means": torch.as_tensor(np.asarray(points, np.float32)),
        "log_scales": torch.as_tensor(np.log(np.asarray(scales, np.float32)))[:, None].repeat(1, 3),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        "opacity_logits": torch.full((n,), float(np.log(opacity / (1 - opacity)))),
        "sh_dc": (torch.as_tensor(np.asarray(colors, np.float32)) - CONSTANTS["SH_OFFSET"])[:, None]
        / CONSTANTS["SH_C0"],
        "sh_rest": torch.zeros(n, 15, 3),
    }


def make_field(config: FieldConfig, device: Device, seed: int = 0, own: nn.Module | None = None) -> Field | None:
    """Make the field of this configuration; None for static scenes. own: the module of the field own."""
    if own is not None:
        return OwnField(own)
    if config.kind == "mlp":
        return MlpField(config, seed)
    if config.kind == "hexplane":
        return HexPlaneField(config, seed)
    return None if config.kind == "static" else GridField(config, device, seed)


class Scene4D:
    """A moving scene.

    Attributes:
        field_config: configuration of the field.
        on_access: called with "gaussians" or "field" before these are given out: a training device may have newer ones.
        newest_at: gives what `at_field_time` does without gradients, while a device trains; else None.
        device: that renders.
        sh_degree: degree of the harmonics in use, 0 to 3.
        antialiased: how the Gaussians are drawn, see Gaussians.
        timing: of the capture: the time of the field at each time of an image.
        metadata: texts by name that the checkpoint holds.
    """

    def __init__(
        self,
        parameters: Mapping[str, Tensor],
        field_config: FieldConfig,
        device: Device,
        *,
        sh_degree: int = 0,
        antialiased: bool | float = False,
        seed: int = 0,
        own_field: nn.Module | None = None,
    ) -> None:
        """Make a scene of Gaussians and a field that is new. Raises InputError where own_field does not fit the kind.

        parameters: as the property; copied. seed: of the field's initial parameters. own_field: a module in place of
        the configured field (docs/api.md). The others are as the attributes.
        """
        check_own(field_config, own_field)
        self.on_access: Callable[[str], None] = lambda part: None
        self.newest_at: Callable[[float], Gaussians[Tensor]] | None = None
        self._parameters = {
            name: nn.Parameter(parameters[name].detach().float().contiguous().clone())
            for name in row_shapes(field_config)
        }
        self.field_config = field_config
        self.device = device
        self.sh_degree = sh_degree
        self.antialiased = antialiased
        self.timing: Timing = EVEN
        self._field: Field | None = make_field(field_config, device, seed, own_field)
        self.metadata: dict[str, str] = {}

    @staticmethod
    def from_points(
        points: Floats,
        colors: Floats,
        scales: Floats,
        field_config: FieldConfig,
        *,
        opacity: float = 0.1,
        antialiased: bool | float = False,
        device: Device | None = None,
        seed: int = 0,
        own_field: nn.Module | None = None,
    ) -> "Scene4D":
        """A scene of isotropic Gaussians.

        points: (N, 3) means, world units. colors: (N, 3) in [0, 1]. scales: (N,) standard deviations, world units.
        opacity: of all Gaussians, in (0, 1). device: None for the default adapter. field_config, antialiased, seed and
        own_field are as for `Scene4D`.
        """
        parameters = isotropic_rows(points, colors, scales, opacity)
        parameters["dynamics"] = torch.zeros(len(points), field_config.dynamics_size)
        device = device or open_device()
        return Scene4D(parameters, field_config, device, antialiased=antialiased, seed=seed, own_field=own_field)

    def __len__(self) -> int:
        return len(self._parameters["means"])

    @property
    def parameters(self) -> dict[str, nn.Parameter]:
        """The canonical Gaussians as they are optimized.

        Each is an nn.Parameter of float32: means (N, 3) world units, log_scales (N, 3), quats (N, 4) wxyz of any
        length, opacity_logits (N,), sh_dc (N, 1, 3), sh_rest (N, 15, 3); for the field laplacian and one's own also
        dynamics (N, D) (paper eq. 8).
        """
        self.on_access("gaussians")
        return self._parameters

    @property
    def field(self) -> Field | None:
        """The module that moves the Gaussians; None for static scenes."""
        self.on_access("field")
        return self._field

    @property
    def spectrum(self) -> LaplacianMotion | None:
        """The motion spectrum of the field, if it has one."""
        motion = self.field.motion if isinstance(self.field, GridField) else None
        return motion if isinstance(motion, LaplacianMotion) else None

    def canonical(self) -> Gaussians:
        """The Gaussians without motion, activated. Differentiable in `parameters`."""
        p = self.parameters
        return Gaussians(
            p["means"],
            nn.functional.normalize(p["quats"], dim=1),
            p["log_scales"].exp().clamp(min=MIN_SCALE),
            p["opacity_logits"].sigmoid(),
            torch.cat([p["sh_dc"], p["sh_rest"][:, : (self.sh_degree + 1) ** 2 - 1]], dim=1),
            antialiased=self.antialiased,
        )

    def at(self, t: float) -> Gaussians:
        """The Gaussians at time t in [0, 1], activated. Differentiable in `parameters` and the field's parameters."""
        return self.at_field_time(self.timing(t))

    def at_field_time(self, time: float) -> Gaussians:
        """As `at`, at a time of the field, to which `timing` maps those of images."""
        if self.newest_at is not None and not torch.is_grad_enabled():
            return self.newest_at(time)
        return self.deformed(time).gaussians

    def deformed(self, time: float, nearby: Nearby | None = None, time_samples: TimeSamples | None = None) -> Deformed:
        """The Gaussians at a time of the field, activated, with what the losses of motion compare. Differentiable as
        in `at`.

        nearby: where the smoothness loss looks; None without it. time_samples: some of the Gaussians and further times
        of the field.
        """
        p = self.parameters
        canonical = self.canonical()
        if self.field is None or len(self) == 0:
            return Deformed(canonical)
        move, *others = self.field.at_times(p["means"], time, p.get("dynamics"), nearby, time_samples)
        quats, sh, opacities = canonical.quats, canonical.sh, canonical.opacities
        if move.orientation is not None:
            quats = quat_multiply(move.orientation, quats)
        if move.d_quats is not None:
            quats = nn.functional.normalize(quats + move.d_quats, dim=1)
        if move.d_dc is not None:
            sh = torch.cat([sh[:, :1] + move.d_dc[:, None], sh[:, 1:]], dim=1)
        if move.d_opacity is not None:
            opacities = (p["opacity_logits"] + move.d_opacity).sigmoid()
        means, scales = self._moved(move, canonical.means, canonical.scales)
        gaussians = Gaussians(means, quats, scales, opacities, sh, antialiased=self.antialiased)
        if time_samples is None:
            return Deformed(gaussians, move.smoothness)
        rows = p["means"][time_samples.rows], canonical.scales[time_samples.rows]
        return Deformed(gaussians, move.smoothness, [self._moved(other, *rows) for other in others])

    def _moved(self, move: Deformation, means: Tensor, scales: Tensor) -> tuple[Tensor, Tensor]:
        if move.d_scales is not None:
            scales = scales + move.d_scales
            if self.field_config.negative_scales == "mirror":
                scales = scales.abs()
            scales = scales.clamp(min=MIN_SCALE)
        return move.apply_to_means(means), scales

    def render(
        self, camera: Camera, t: float, background: Tensor | Sequence[float] | None = None, *, depth: bool = True
    ) -> Rendering:
        """Render the scene on the CPU, without gradients.

        Args:
            camera: which renders the image.
            t: time in [0, 1].
            background: (3,); None for black.
            depth: whether to render depth, see `rasterize`.
        """
        return self.render_at_field_time(camera, self.timing(t), background, depth=depth)

    @torch.no_grad()
    def render_at_field_time(
        self, camera: Camera, time: float, background: Tensor | Sequence[float] | None = None, *, depth: bool = True
    ) -> Rendering:
        """As `render` with this camera, background and depth, at a time of the field."""
        now = self.at_field_time(time)
        tensors = (now.means, now.quats, now.scales, now.opacities, now.sh)
        return rasterize(
            *tensors,
            camera,
            sh_degree=now.sh_degree,
            background=None if background is None else torch.as_tensor(background, dtype=torch.float32),
            antialiased=now.antialiased,
            depth=depth,
            device=self.device,
        )

    def snapshot(self, t: float) -> GaussianSnapshot:
        """The Gaussians at time t in [0, 1] before their activations, as 3DGS viewers read them."""
        with torch.no_grad():
            now = self.at(t)
            sh = torch.cat([now.sh[:, :1], self.parameters["sh_rest"]], dim=1)
            logits = self.parameters["opacity_logits"].detach()
            if not torch.allclose(now.opacities, logits.sigmoid(), rtol=1e-5, atol=1e-7):
                logits = now.opacities.logit(eps=1e-7)
        means, log_scales, quats = (each.numpy(force=True) for each in (now.means, now.scales.log(), now.quats))
        return GaussianSnapshot(means, sh.numpy(force=True), logits.numpy(force=True), log_scales, quats)

    def save(self, path: PathLike, metadata: Mapping[str, str] | None = None) -> None:
        """Write the scene to one file, which 3DGS viewers open as a static scene at time 0 (docs/format.md). Atomic.

        Args:
            path: of the file, .ply.
            metadata: further texts by name.

        Raises:
            InputError: the file system failed, or a value cannot be stored; an older file is then unchanged.
        """
        arrays = self.snapshot(0.0)
        tensors = {f"gaussians.{name}": value.numpy(force=True) for name, value in self.parameters.items()}
        if self.field is not None:
            tensors |= {f"field.{name}": value.numpy(force=True) for name, value in self.field.state_dict().items()}
        header = scene_header(self.field_config, self.sh_degree, self.antialiased, self.timing)
        write_checkpoint(path, arrays, tensors, {**self.metadata, **(metadata or {}), **header})


def load(path: PathLike, device: Device | None = None, *, field: nn.Module | None = None) -> Scene4D:
    """Read a checkpoint, or any 3DGS .ply file as a static scene.

    Args:
        path: of the file.
        device: None for the default adapter.
        field: the module of a scene that was trained with a field of one's own, which takes the file's parameters.

    Returns:
        The scene.

    Raises:
        InputError: not such a file; or a compact scene that moves, which lacks the static grid (`lapgs-view` shows it).
    """
    return scene_of(read_scene(path), device, field)


def scene_of(file: SceneFile, device: Device | None = None, own_field: nn.Module | None = None) -> Scene4D:
    """The scene of a file that was read; own_field as in `load`. Raises InputError for a compact scene that moves."""
    if "static_features" in file.gaussians:
        raise InputError(
            f"{file.path}: is a compact scene, which lapgs-view shows, without the static grid that a Scene4D needs: "
            "load the checkpoint that it was made of"
        )
    parameters = {name: torch.from_numpy(array.copy()) for name, array in file.gaussians.items()}
    try:
        scene = Scene4D(
            parameters,
            file.field_config,
            device or open_device(),
            sh_degree=file.sh_degree,
            antialiased=file.antialiased,
            own_field=own_field,
        )
        if scene.field is not None:
            scene.field.load_state_dict({name: torch.from_numpy(array) for name, array in file.field.items()})
    except InputError as error:
        raise InputError(f"{file.path}: {error}") from error
    except RuntimeError as error:  # torch's, of a field of one's own: the shapes of the others were checked
        raise InputError(
            f"{file.path}: is of another field than the module {type(own_field).__name__} that was given; give one of "
            f"the class and the sizes that it was trained with ({' '.join(str(error).split())})."
        ) from error
    scene.timing, scene.metadata = file.timing, file.metadata
    return scene
