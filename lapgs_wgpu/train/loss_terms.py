"""Loss terms of one's own, beside those of the configuration (docs/api.md)."""

from __future__ import annotations

import re
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.array import DeviceArray, read_all
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.train.ground_truth import host_image

SIDE = 8  # pixels; a workgroup of a WGSL loss is a square

Weight = float | Callable[[int], float]


@dataclass(frozen=True)
class Regularizer:
    """A term of the Gaussians, in torch.

    Attributes:
        name: in `StepResult.terms` and log.jsonl.
        function: of the scene, its Gaussians at the view's time (activated, differentiable in the scene's parameters)
            and that time in [0, 1]; returns a scalar.
        weight: of the term, or a function of the step, counted from 1; at 0 it is not computed.
    """

    name: str
    function: Callable[[Scene4D, Gaussians[Tensor], float], Tensor]
    weight: Weight = 1.0


@dataclass(frozen=True)
class TorchLoss:
    """A term of the image, in torch. The image and its gradient then go through the host's memory in each step. Pixels
    that the losses leave out (data.masks) have the image's own color as ground truth, and no gradient.

    Attributes:
        name: in `StepResult.terms` and log.jsonl.
        function: of the image (H, W, 3), differentiable, and the ground truth (H, W, 3) in [0, 1]; returns a scalar.
        weight: as in `Regularizer`.
    """

    name: str
    function: Callable[[Tensor, Tensor], Tensor]
    weight: Weight = 1.0


@dataclass(frozen=True)
class WgslLoss:
    """A term of the image, as a compute shader on the device: the mean over the pixels of what it leaves.

    Attributes:
        name: in `StepResult.terms` and log.jsonl.
        file: of WGSL that imports common/loss_term, which says what it gets and leaves.
        weight: as in `Regularizer`.

    Raises:
        InputError: no such file, or another workgroup size than 8 x 8.
    """

    name: str
    file: str | Path
    weight: Weight = 1.0
    _pools: dict[Device, BufferPool] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Raises InputError where the file is none, or of another workgroup size."""
        path = Path(self.file)
        if path.suffix != ".wgsl" or not path.is_file():
            raise InputError(f"{path}: a loss needs a file of WGSL whose name ends with .wgsl.")
        sizes = re.findall(r"@workgroup_size\(([^)]*)\)", path.read_text(encoding="utf-8"))
        if [size.replace(" ", "") for size in sizes] != [f"{SIDE},{SIDE}"]:
            found = f"@workgroup_size({sizes[0]})" if sizes else "no entry point"
            raise InputError(f"{path}: needs one entry point with @workgroup_size({SIDE}, {SIDE}), got {found}.")

    @cached_property
    def _kernel(self) -> tuple[str, dict[str, int]]:
        """Name and defines: a file that was edited since another term was made of it is another kernel."""
        path = Path(self.file).resolve()
        return str(path.with_suffix("")), {"EDITION": zlib.crc32(path.read_bytes())}

    def record(
        self,
        commands: Commands,
        image: DeviceArray,
        truth: DeviceArray,
        background: tuple[float, float, float],
        weight: float,
        d_image: DeviceArray,
    ) -> DeviceArray:
        """Record the passes of this term into a command buffer.

        Args:
            commands: to record into.
            image: (4, H, W) red, green, blue, transmittance.
            truth: (H, W) uint32 RGBA of the ground truth.
            background: behind transparent pixels of the ground truth.
            weight: of the term.
            d_image: (4, H, W), to which the weighted gradient is added.

        Returns:
            (H, W) values of the pixels.
        """
        height, width = truth.shape
        pool = self._pools.setdefault(commands.device, BufferPool(commands.device))
        name, defines = self._kernel
        kernel = Kernel.get(commands.device, name, **defines)
        own = pool.array("truth", truth.shape, "uint32")
        commands.copy(truth, own)  # so that all images of a training go through one bind group
        values = pool.array("values", (height, width))
        commands.clear(values)
        share = weight / (height * width)
        given = {"size": (width, height), "share": share, "padding": 0.0, "background": background}
        uniform = pool.varying("term", lambda: kernel.uniform("Term", **given))
        groups = -(-width // SIDE), -(-height // SIDE)
        arrays = {"image": image, "rgba": own, "d_image": d_image, "values": values}
        commands.dispatch_grid(kernel, groups, term=uniform, **arrays)
        return values


LossTerm = Regularizer | TorchLoss | WgslLoss
# Names of the terms of the configuration, and of what stands beside them in the log.
TAKEN_NAMES = frozenset(
    {"l1", "mse", "ssim", "pyramid", "ncc", "smoothness", "acceleration", "dynamics", "loss", "psnr"}
)


def weight_at(term: LossTerm, step: int) -> float:
    """The weight of a term in a step, counted from 1."""
    return float(term.weight(step) if callable(term.weight) else term.weight)


def torch_loss(
    term: TorchLoss, image: DeviceArray, truth: DeviceArray, background: tuple[float, float, float], weight: float
) -> tuple[float, np.ndarray]:
    """The value of a term in torch, and its weighted gradient (4, H, W) by the image. Others as `WgslLoss.record`.

    Raises InputError for a result that is no scalar.
    """
    planes, texels = read_all([image, truth])
    target, left_out = host_image(texels, torch.tensor(background))
    with torch.enable_grad():
        shown = torch.from_numpy(planes[:3]).permute(1, 2, 0).requires_grad_()
        value = term.function(shown, torch.where(left_out, shown.detach(), target))
        if not isinstance(value, Tensor) or value.ndim:
            raise InputError(
                f"the loss {term.name!r} must return a scalar tensor, got {getattr(value, 'shape', value)}."
            )
        gradient = torch.zeros_like(shown)
        if value.requires_grad:
            (found,) = torch.autograd.grad(value, shown, allow_unused=True)
            gradient = gradient if found is None else found.masked_fill(left_out, 0.0)
    d_image = np.zeros((4, *truth.shape), np.float32)
    d_image[:3] = weight * gradient.permute(2, 0, 1).numpy()
    return float(value.detach()), d_image
