"""LPIPS (Zhang et al. 2018) on VGG16, with weights that the user supplies: none may be passed on with this package."""

from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.safe_json_toml import open_regular
from lapgs_wgpu.io.safetensors_file import unpack_tensors

# VGG16's convolutions: number in torchvision's `features`, input and output channels; a tap after the last of each
# block, a pool between blocks.
BLOCKS = (
    ((0, 3, 64), (2, 64, 64)),
    ((5, 64, 128), (7, 128, 128)),
    ((10, 128, 256), (12, 256, 256), (14, 256, 256)),
    ((17, 256, 512), (19, 512, 512), (21, 512, 512)),
    ((24, 512, 512), (26, 512, 512), (28, 512, 512)),
)
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of ImageNet, for inputs in [-1, 1]
SMALLEST = 32  # pixels a side: below it the last block sees less than two


class Lpips:
    """The distance of two images.

    weights: a .safetensors file with torchvision's VGG16 (`features.N.weight`, `features.N.bias`) and the linear heads
    of LPIPS's VGG variant (`linK.model.1.weight`). Raises InputError.
    """

    def __init__(self, weights: Path) -> None:
        with open_regular(weights) as file:
            arrays, _ = unpack_tensors(file, weights.stat().st_size, str(weights))
        shapes: dict[str, tuple[int, ...]] = {}
        for k, block in enumerate(BLOCKS):
            for number, inputs, outputs in block:
                shapes[f"features.{number}.weight"] = (outputs, inputs, 3, 3)
                shapes[f"features.{number}.bias"] = (outputs,)
            shapes[f"lin{k}.model.1.weight"] = (1, block[-1][2], 1, 1)
        self._weights = {}
        for name, shape in shapes.items():
            found = arrays[name].shape if name in arrays else "nothing"
            if found != shape:
                raise InputError(f"{weights}: {name} must have the shape {shape}, but the file holds {found}.")
            self._weights[name] = torch.from_numpy(arrays[name]).float()

    @torch.no_grad()
    def __call__(self, image: Tensor, target: Tensor, *, unscaled: bool = False) -> float:
        """Of two (H, W, 3) images in [0, 1], at least 32 pixels a side. They are scaled to [-1, 1], which LPIPS asks
        for; unscaled: they are not, as in the figures that 3DGS's code and its successors report."""
        both = torch.stack([image, target]).permute(0, 3, 1, 2).float()
        if not unscaled:
            both = 2 * both - 1
        features = (both - torch.tensor(SHIFT).view(3, 1, 1)) / torch.tensor(SCALE).view(3, 1, 1)
        distance = 0.0
        for k, block in enumerate(BLOCKS):
            if k:
                features = functional.max_pool2d(features, 2)
            for number, _, _ in block:
                weight, bias = self._weights[f"features.{number}.weight"], self._weights[f"features.{number}.bias"]
                features = functional.relu(functional.conv2d(features, weight, bias, padding=1))
            unit = features / (features.square().sum(dim=1, keepdim=True).sqrt() + 1e-10)
            apart = (unit[:1] - unit[1:]).square()
            distance += float(functional.conv2d(apart, self._weights[f"lin{k}.model.1.weight"]).mean())
        return distance
