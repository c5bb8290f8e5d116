"""Measuring a trained scene on views that it has not seen (the protocol of docs/results.md), and pictures of it.

Both sides are compared as 8-bit pictures: the model of the last step, clamped and rounded, and the ground truth.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lapgs_wgpu.data.views import View, composite
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.log import environment
from lapgs_wgpu.train.losses import psnr, ssim

ERROR_GAIN = 4  # of the error pictures
COLOURS = {"black": 0.0, "white": 1.0, "random": 0.0}  # of the background under test views


def evaluate(scene: Scene4D, views: Sequence[View], background: str, folder: Path | None = None) -> dict[str, Any]:
    """Render every view and compare: the content of metrics.json.

    background: black, white, or random, which is black here. folder: where a picture of each view is written, the
    ground truth beside the rendering and their error, 4 times enlarged; an existing folder.
    psnr is per image over all channels, then the mean of the dB; ssim is that of the loss. Raises InputError where a
    picture cannot be read.
    """
    start = time.perf_counter()
    colour = torch.full((3,), COLOURS[background])
    rows = []
    for view in views:
        truth = composite(view.load(), colour.numpy())
        image = to_8_bit(scene.render(view.camera, view.time, colour).image)
        a, b = _unit(image), _unit(truth)
        rows.append({"view": view.name, "time": view.time, "psnr": psnr(a, b), "ssim": float(ssim(a, b))})
        if folder is not None:
            Image.fromarray(side_by_side(truth, image)).save(folder / f"{view.name}.png")
    return {
        "psnr": float(np.mean([row["psnr"] for row in rows])),
        "ssim": float(np.mean([row["ssim"] for row in rows])),
        "lpips": "not available",  # it needs weights, which do not come with the package
        "gaussians": len(scene),
        "field": scene.field_config.kind,
        "size": [views[0].camera.width, views[0].camera.height],
        "background": background,
        "views": rows,
        "seconds": round(time.perf_counter() - start, 3),
        "environment": environment(scene.device),
    }


def write_metrics(path: Path, metrics: dict[str, Any]) -> None:
    """Write metrics.json. Atomic; InputError where it cannot be written."""
    with atomic_write(path) as file:
        file.write((json.dumps(metrics, indent=1) + "\n").encode())


def to_8_bit(image: Tensor) -> NDArray[np.uint8]:
    """(H, W, 3) in [0, 1], clamped and rounded to the nearest 8-bit value."""
    rounded = (image.detach().clamp(0, 1) * 255).round().to(torch.uint8)
    return rounded.numpy(force=True)


def side_by_side(truth: NDArray[np.uint8], image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Ground truth | rendering | absolute error, 4 times enlarged: (H, 3 W, 3) of two (H, W, 3) pictures."""
    error = np.abs(truth.astype(np.int32) - image.astype(np.int32)) * ERROR_GAIN
    return np.concatenate([truth, image, error.clip(max=255).astype(np.uint8)], axis=1)


def _unit(picture: NDArray[np.uint8]) -> Tensor:
    return torch.from_numpy(picture.astype(np.float32) / 255)
