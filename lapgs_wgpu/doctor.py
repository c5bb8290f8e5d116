"""The self-test of lapgs-doctor: a known image and its gradient, against float64."""

import math
import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lapgs_wgpu.gpu.device import Device, open_device
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.splat.raster_config import subgroup_size
from lapgs_wgpu.splat.rasterize import rasterize, rasterizer_of
from lapgs_wgpu.splat.rotation import rotation_matrices

COUNT = 40  # Gaussians
FOCAL, WIDTH, HEIGHT = 64.0, 70, 50  # pixels
# The largest errors that pass: of colors and depths, and of the image's gradients by each kind of parameter.
ALLOWED = {"image": 1e-5, "gradient of the image": 1e-4}
BACKGROUND = torch.tensor([0.2, 0.1, 0.6], dtype=torch.float64)


def stacked_gaussians() -> dict[str, Tensor]:
    """Arguments of `rasterize` by name, float64: Gaussians on the optical axis, in no order of depth."""
    rng = np.random.default_rng(0)
    depths = rng.permutation(np.linspace(3.0, 6.0, COUNT))
    arrays = {
        "means": np.stack([np.zeros(COUNT), np.zeros(COUNT), depths], axis=1),
        "quats": np.tile([1.0, 0.0, 0.0, 0.0], (COUNT, 1)),
        "scales": rng.uniform(0.1, 0.5, (COUNT, 3)),
        "opacities": rng.uniform(0.05, 0.2, COUNT),  # so low that no pixel is finished before the last Gaussian
        "colors": rng.uniform(0, 1, (COUNT, 3)),
    }
    return {name: torch.tensor(array, requires_grad=True) for name, array in arrays.items()}


def pixel_alphas(gaussians: Mapping[str, Tensor]) -> Tensor:
    """(N, H, W) opacity of each Gaussian at each pixel. Exact to first order in the distance from the axis, which is
    enough for gradients on it."""
    means, magnification = gaussians["means"], FOCAL / gaussians["means"][:, 2]
    axes = rotation_matrices(gaussians["quats"])[:, :2] * (magnification[:, None] * gaussians["scales"])[:, None]
    inverse = torch.linalg.inv(axes @ axes.mT + CONSTANTS["DILATION"] * torch.eye(2, dtype=torch.float64))
    x = torch.arange(WIDTH) + 0.5 - WIDTH / 2 - (magnification * means[:, 0])[:, None, None]
    y = torch.arange(HEIGHT)[:, None] + 0.5 - HEIGHT / 2 - (magnification * means[:, 1])[:, None, None]
    a, b, c = (inverse[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    return gaussians["opacities"][:, None, None] * torch.exp(-0.5 * (a * x**2 + 2 * b * x * y + c * y**2))


def known_image(gaussians: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Colors (H, W, 3) and depths (H, W) of stacked Gaussians, differentiable: only a correct sort gives the same."""
    depths, alphas = gaussians["means"][:, 2], pixel_alphas(gaussians)
    alphas = torch.where(alphas >= CONSTANTS["ALPHA_MIN"], alphas, 0.0)
    order = depths.argsort()
    behind = torch.cumprod(1 - alphas[order], dim=0)  # what each and those before it let through
    weights = alphas[order] * torch.cat([torch.ones_like(behind[:1]), behind[:-1]])
    image = torch.einsum("nhw,nc->hwc", weights, gaussians["colors"][order]) + behind[-1, ..., None] * BACKGROUND
    return image, torch.einsum("nhw,n->hw", weights, depths[order])


def errors(device: Device) -> Iterator[float]:
    """The largest errors of an adapter, in the order of ALLOWED, each as it has been computed."""
    exact = stacked_gaussians()
    gaussians: dict[str, Any] = {name: value.detach().float().requires_grad_() for name, value in exact.items()}
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    camera = Camera(K, np.eye(4), WIDTH, HEIGHT)
    rendering = rasterize(**gaussians, camera=camera, background=BACKGROUND.float(), device=device)
    image, depth = known_image(exact)
    yield max(relative_error(rendering.image, image), relative_error(rendering.depth, depth))
    weights = torch.randn(HEIGHT, WIDTH, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    computed = torch.autograd.grad((rendering.image * weights.float()).sum(), list(gaussians.values()))
    expected = torch.autograd.grad((image * weights).sum(), list(exact.values()))
    yield max(map(relative_error, computed, expected))


def relative_error(computed: Tensor, expected: Tensor) -> float:
    """The largest difference relative to the largest expected value; infinite where a computed value is not finite."""
    error = float((computed.detach().double() - expected.detach()).abs().max() / expected.detach().abs().max())
    return error if math.isfinite(error) else math.inf


def self_test(name: str | None) -> int:
    """Run and print the checks on an adapter (`open_device`). Returns 1 if one failed. Raises NoAdapterError."""
    device = open_device(name)
    print(f"### Self-test on {device.info.name} ({device.info.backend})\n", flush=True)
    found, passed = errors(device), 0
    for check, allowed in ALLOWED.items():
        print(f"- {check}: ", end="", flush=True)  # which tells where a driver crashed or hangs
        start = time.perf_counter()
        try:
            error = next(found)
        except Exception as problem:
            print(f"**FAILED**, {type(problem).__name__}: {' '.join(str(problem).split())[:300]}", flush=True)
            break
        passed += error <= allowed
        result = "ok" if error <= allowed else "**FAILED**"
        seconds = time.perf_counter() - start
        print(f"{result}, error {error:.2g} (allowed {allowed:g}), {seconds:.1f} s with compilation", flush=True)
    config = rasterizer_of(device).config  # after a drawing, which may have turned subgroups off
    print(
        f"- subgroups of {subgroup_size(device)} lanes, {'used' if config.subgroups else 'not used'}; tiles of "
        f"{config.tile_width}x{config.tile_height} pixels\n\n{passed} of {len(ALLOWED)} checks passed.",
        flush=True,
    )
    return int(passed < len(ALLOWED))
