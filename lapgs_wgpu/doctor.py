"""The self-test of lapgs-doctor: kernels of a training against closed forms.

lapgs-doctor runs this module in a process of its own (`python -m lapgs_wgpu.doctor [DEVICE]`), since a driver may crash
or hang. It prints a Markdown line a check.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_wgpu.command import guarded
from lapgs_wgpu.gpu.device import Device, open_device
from lapgs_wgpu.gpu.probe_subgroup import subgroup_size
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.splat.rasterize import Rendering, rasterize, rasterizer_of

COUNT = 40  # Gaussians
FOCAL, WIDTH, HEIGHT = 64.0, 70, 50  # pixels
BACKGROUND = np.array([0.2, 0.1, 0.6])

Floats = NDArray[np.float64]


class Check(NamedTuple):
    """run: returns the largest error. allowed: the largest error that passes."""

    name: str
    run: Callable[[Device], float]
    allowed: float


class StackedGaussians:
    """Axis-aligned Gaussians on the optical axis, in no order of depth.

    Their projections are axis-aligned ellipses around the middle of the image, so image and gradients have closed
    forms, and only a correct sort puts them in order. N Gaussians, images (H, W).
    """

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.depths = rng.permutation(np.linspace(3.0, 6.0, COUNT))
        self.scales = rng.uniform(0.1, 0.5, (COUNT, 3))
        self.opacities = rng.uniform(0.05, 0.2, COUNT)  # so low that no pixel is finished before the last Gaussian
        self.colors = rng.uniform(0, 1, (COUNT, 3))

        self.x = np.arange(WIDTH)[None] + 0.5 - WIDTH / 2
        self.y = np.arange(HEIGHT)[:, None] + 0.5 - HEIGHT / 2
        self.magnification = FOCAL / self.depths
        self.variances = (self.magnification[:, None] * self.scales[:, :2]) ** 2 + CONSTANTS["DILATION"]  # (N, 2), px^2
        xx, yy = self.variances.T[:, :, None, None]
        alphas = self.opacities[:, None, None] * np.exp(-0.5 * (self.x**2 / xx + self.y**2 / yy))
        self.alphas = np.where(alphas >= CONSTANTS["ALPHA_MIN"], alphas, 0.0)  # (N, H, W)

        self.behind = np.zeros((COUNT, HEIGHT, WIDTH, 3))  # colors behind each Gaussian
        self.image = np.broadcast_to(BACKGROUND, (HEIGHT, WIDTH, 3))
        for i in np.argsort(-self.depths):
            self.behind[i] = self.image
            alpha = self.alphas[i, ..., None]
            self.image = alpha * self.colors[i] + (1 - alpha) * self.image
        self.transmittance = np.zeros_like(self.alphas)  # of all that is in front of each Gaussian
        left = np.ones((HEIGHT, WIDTH))
        for i in np.argsort(self.depths):
            self.transmittance[i] = left
            left = left * (1 - self.alphas[i])
        self.depth = np.einsum("nhw,n->hw", self.transmittance * self.alphas, self.depths)

    def gradients(self, weights: Floats) -> dict[str, Floats]:
        """Gradients of sum(weights * image), weights (H, W, 3), by the arguments of `rasterize`.

        Of the quaternions (w, x, y, z), z alone: (N, 1).
        """
        xx, yy = self.variances.T
        sx, sy, _ = self.scales.T
        m2 = self.magnification**2
        color_change = np.einsum("nhwc,hwc->nhw", self.colors[:, None, None] - self.behind, weights)
        by_exponent = color_change * self.transmittance * self.alphas  # (N, H, W)

        def moment(plane: Floats) -> Floats:
            return np.einsum("nhw,hw->n", by_exponent, plane)

        by_xx = 0.5 * moment(np.broadcast_to(self.x**2, (HEIGHT, WIDTH))) / xx**2
        by_yy = 0.5 * moment(np.broadcast_to(self.y**2, (HEIGHT, WIDTH))) / yy**2
        by_xy = moment(self.x * self.y) / (xx * yy)
        mean_x = self.magnification * moment(np.broadcast_to(self.x, (HEIGHT, WIDTH))) / xx
        mean_y = self.magnification * moment(np.broadcast_to(self.y, (HEIGHT, WIDTH))) / yy
        mean_z = -2 * m2 / self.depths * (by_xx * sx**2 + by_yy * sy**2)
        return {
            "means": np.stack([mean_x, mean_y, mean_z], axis=1),
            "quats": (2 * m2 * (sx**2 - sy**2) * by_xy)[:, None],
            "scales": 2 * m2[:, None] * np.stack([by_xx * sx, by_yy * sy, np.zeros(COUNT)], axis=1),
            "opacities": by_exponent.sum(axis=(1, 2)) / self.opacities,
            "colors": np.einsum("nhw,hwc->nc", self.transmittance * self.alphas, weights),
        }

    def draw(self, device: Device) -> tuple[dict[str, torch.Tensor], Rendering]:
        """The arguments of `rasterize`, which require gradients, and what it returned."""
        arguments = {
            "means": np.stack([np.zeros(COUNT), np.zeros(COUNT), self.depths], axis=1),
            "quats": np.tile([1.0, 0.0, 0.0, 0.0], (COUNT, 1)),
            "scales": self.scales,
            "opacities": self.opacities,
            "colors": self.colors,
        }
        tensors = {name: torch.tensor(a, dtype=torch.float32, requires_grad=True) for name, a in arguments.items()}
        K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
        camera = Camera(K, np.eye(4), WIDTH, HEIGHT)
        background = torch.tensor(BACKGROUND, dtype=torch.float32)
        gaussians: dict[str, Any] = dict(tensors)  # arguments of rasterize by name
        return tensors, rasterize(**gaussians, camera=camera, background=background, device=device)


def image(device: Device) -> float:
    """Colors and depths of stacked Gaussians. The error of depths is relative to the largest."""
    gaussians = StackedGaussians()
    _, rendering = gaussians.draw(device)
    return max(relative_error(rendering.image, gaussians.image), relative_error(rendering.depth, gaussians.depth))


def image_gradient(device: Device) -> float:
    """The gradients of that image, each error relative to the largest gradient of its kind."""
    gaussians = StackedGaussians()
    weights = np.random.default_rng(0).standard_normal((HEIGHT, WIDTH, 3))
    tensors, rendering = gaussians.draw(device)
    (rendering.image * torch.tensor(weights, dtype=torch.float32)).sum().backward()
    errors = []
    for name, gradient in gaussians.gradients(weights).items():
        computed = tensors[name].grad
        assert computed is not None
        errors.append(relative_error(computed[:, 3:] if name == "quats" else computed, gradient))
    return max(errors)


def relative_error(computed: torch.Tensor, expected: Floats) -> float:
    """The largest difference relative to the largest expected value; infinite where a computed value is not finite."""
    error = float(np.abs(computed.detach().double().numpy() - expected).max() / np.abs(expected).max())
    return error if np.isfinite(error) else float("inf")


CHECKS = (Check("image", image, 1e-5), Check("gradient of the image", image_gradient, 1e-4))


def self_test(arguments: list[str]) -> int:
    """Run the checks on the adapter that `arguments` may name. Returns 1 if one failed. Raises NoAdapterError."""
    device = open_device(*arguments)
    print(f"### Self-test on {device.info.name} ({device.info.backend})\n", flush=True)
    failed = 0
    for check in CHECKS:
        print(f"- {check.name}: ", end="", flush=True)  # which tells where a driver crashed
        start = time.perf_counter()
        try:
            error = check.run(device)
        except Exception as problem:
            failed += 1
            print(f"**FAILED**, {type(problem).__name__}: {' '.join(str(problem).split())[:300]}", flush=True)
            continue
        passed = error <= check.allowed
        failed += not passed
        result = "ok" if passed else "**FAILED**"
        seconds = time.perf_counter() - start
        print(f"{result}, error {error:.2g} (allowed {check.allowed:g}), {seconds:.1f} s with compilation", flush=True)
    config = rasterizer_of(device).config  # after a drawing, which may have turned subgroups off
    print(
        f"- subgroups of {subgroup_size(device)} lanes, {'used' if config.subgroups else 'not used'}; tiles of "
        f"{config.tile_width}x{config.tile_height} pixels\n\n"
        f"{len(CHECKS) - failed} of {len(CHECKS)} checks passed.",
        flush=True,
    )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(guarded("lapgs-doctor", self_test, sys.argv[1:]))
