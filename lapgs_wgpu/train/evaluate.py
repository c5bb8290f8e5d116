"""Measuring a trained scene on views that it has not seen (the protocol of docs/results.md), and pictures of it.

Both sides are compared as 8-bit pictures: the model of the last step, clamped and rounded, and the ground truth.
"""

import dataclasses
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from lapgs_wgpu.data.images import encode_png
from lapgs_wgpu.data.views import View, composite
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.io.safe_json_toml import open_regular
from lapgs_wgpu.io.safetensors_file import unpack_tensors
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.progress import counted
from lapgs_wgpu.train.config import BACKGROUND_LEVELS
from lapgs_wgpu.train.host import environment
from lapgs_wgpu.train.image_metrics import MS_SSIM_SMALLEST, differing_pixels, ms_ssim, psnr, ssim

ERROR_GAIN = 4  # of the error pictures
OFF_PATH = 0.05  # of the median depth: how far beside a view's camera pictures of what moves are drawn, too
PARTS = ("psnr_moving", "ssim_moving", "psnr_still", "ssim_still", "explained")
MEASURES = ("psnr", "ssim", "ms_ssim", "lpips", "lpips_unscaled", *PARTS)
NOT_AVAILABLE = "not available"
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
LPIPS_SMALLEST = 32  # pixels a side: below it the last block sees less than two


class Lpips:
    """LPIPS (Zhang et al. 2018) on VGG16, with weights that the user supplies: none may be passed on with this package.

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


def evaluate(
    scene: Scene4D, views: Sequence[View], background: str, folder: Path | None = None, *, lpips: Lpips | None = None
) -> dict[str, Any]:
    """Render every view and compare: the content of metrics.json (docs/metrics.md).

    background: black or white. folder: an existing one, where a picture of each view is written (`side_by_side`), and
    off_NAME.png from OFF_PATH to the left and right of it where a mask says what moves; the progress is then shown.
    lpips: None where there are no weights for it. Raises InputError where there are no views, or a picture or a mask
    cannot be read.
    """
    if not views:
        raise InputError("there are no views to measure: most captures have no validation views, only test views.")
    start = time.perf_counter()
    color = torch.full((3,), BACKGROUND_LEVELS[background])
    rows: list[dict[str, Any]] = []
    for view in views if folder is None else counted(views, len(views), "test views measured"):
        truth = composite(view.load(), color.numpy())
        image = to_8_bit(scene.render(view.camera, view.time, color, depth=False).image)
        moving = None if view.moving is None else view.moving()
        rows.append({"view": view.name, "time": view.time} | _measures(image, truth, moving, lpips))
        if folder is not None:
            with atomic_write(folder / f"{view.name}.png") as file:
                file.write(encode_png(side_by_side(truth, image)))
            if view.moving is not None:
                with atomic_write(folder / f"off_{view.name}.png") as file:
                    file.write(encode_png(_off_path(scene, view, color)))
    return {
        **{name: _mean(name, [row[name] for row in rows]) for name in MEASURES},
        "gaussians": len(scene),
        "field": scene.field_config.kind,
        "size": [views[0].camera.width, views[0].camera.height],
        "background": background,
        "views": rows,
        "seconds": round(time.perf_counter() - start, 3),
        "environment": environment(scene.device),
    }


def _measures(
    drawn: NDArray[np.uint8], captured: NDArray[np.uint8], moving: NDArray[np.bool_] | None, lpips: Lpips | None
) -> dict[str, float | str]:
    image, truth = (torch.from_numpy(picture.astype(np.float32) / 255) for picture in (drawn, captured))
    side = min(image.shape[:2])
    measures: dict[str, float | str] = dict.fromkeys(MEASURES, NOT_AVAILABLE)
    measures |= {"psnr": psnr(image, truth), "ssim": float(ssim(image, truth))}
    if side >= MS_SSIM_SMALLEST:
        measures["ms_ssim"] = float(ms_ssim(image, truth))
    if lpips is not None and side >= LPIPS_SMALLEST:
        measures |= {"lpips": lpips(image, truth), "lpips_unscaled": lpips(image, truth, unscaled=True)}
    if moving is None or not moving.any() or moving.all():
        return measures
    for name, pixels in (("moving", torch.from_numpy(moving)), ("still", torch.from_numpy(~moving))):
        measures[f"psnr_{name}"] = psnr(image[pixels], truth[pixels])
        measures[f"ssim_{name}"] = float(ssim(image, truth, pixels))
    differing = differing_pixels(truth.numpy(), image.numpy())
    return measures | {"explained": float(1 - differing[moving].mean())}


def _off_path(scene: Scene4D, view: View, color: Tensor) -> NDArray[np.uint8]:
    """(H, 2 W, 3) a view from the left and from the right of its camera."""
    drawn = scene.render(view.camera, view.time, color)
    shown = drawn.alpha > 0.5
    depth = float((drawn.depth[shown] / drawn.alpha[shown]).median()) if shown.any() else 1.0
    pictures = []
    for way in (OFF_PATH, -OFF_PATH):  # the world moves the other way
        pose = view.camera.T_cam_world + way * depth * np.eye(4, k=3)
        camera = dataclasses.replace(view.camera, T_cam_world=pose)
        pictures.append(to_8_bit(scene.render(camera, view.time, color, depth=False).image))
    return np.concatenate(pictures, axis=1)


def _mean(name: str, values: list[Any]) -> float | str:
    """Of a measure; where it is one of a part of the image, of the images that have any."""
    known = [value for value in values if value != NOT_AVAILABLE]
    return float(np.mean(known)) if known and (name in PARTS or len(known) == len(values)) else NOT_AVAILABLE


def write_metrics(folder: Path, metrics: dict[str, Any]) -> None:
    """Write metrics.json. Atomic; InputError where it cannot be written."""
    with atomic_write(folder / "metrics.json") as file:
        file.write((json.dumps(metrics, indent=1) + "\n").encode())


def to_8_bit(image: Tensor) -> NDArray[np.uint8]:
    """(H, W, 3) in [0, 1], clamped and rounded to the nearest 8-bit value."""
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).numpy(force=True)


def side_by_side(truth: NDArray[np.uint8], image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Ground truth | rendering | absolute error, 4 times enlarged: (H, 3 W, 3) of two (H, W, 3) pictures."""
    error = np.abs(truth.astype(np.int32) - image.astype(np.int32)) * ERROR_GAIN
    return np.concatenate([truth, image, error.clip(max=255).astype(np.uint8)], axis=1)
