"""Random Gaussians, cameras, and one step of gradient descent's forward and backward pass over them."""

from typing import Any, NamedTuple

import numpy as np
import torch
from helpers.reference import near_discontinuity, rasterize_reference
from torch import Tensor

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.rasterize import rasterize

Scene = dict[str, Tensor]  # the tensors that `rasterize` takes, by argument name, float32


def front_camera(width: int, height: int, focal: float = 40.0) -> Camera:
    """At the origin, looking along +z."""
    return Camera(np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), np.eye(4), width, height)


def oblique_camera(width: int, height: int) -> Camera:
    """3.2 from the origin, turned, with unequal focal lengths and a principal point off the centre."""
    camera = Camera.looking_at([1.0, -3.0, 0.7], [0.1, 0, 0], up=[0, 0, 1], fov_x=0.8, width=width, height=height)
    return Camera(camera.K * np.array([[1.0, 1, 1.1], [1, 1.15, 0.93], [1, 1, 1]]), camera.T_cam_world, width, height)


def random_scene(count: int, seed: int, *, sh: int | None = None, size: float = 0.05, spread: float = 0.8) -> Scene:
    """Gaussians around the origin, every tenth far away (beside the image, or behind the oblique camera).

    sh: coefficients of spherical harmonics a channel; plain colors where None.
    """
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    means = spread * normal(count, 3)
    means[9::10] *= 4
    return {
        "means": means,
        "quats": 3 * normal(count, 4),
        "scales": size * torch.exp(0.7 * normal(count, 3)),
        "opacities": torch.sigmoid(2 * normal(count)),
        "colors": torch.rand(count, 3, generator=generator) if sh is None else 0.4 * normal(count, sh, 3),
    }


def needles(count: int, seed: int, camera: Camera, length: float = 300.0) -> Scene:
    """Splats about `length` pixels long and as thin as the dilation lets them be, for a `front_camera`.

    They lie in all directions, some exactly along rows or columns; some are centred outside the image.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    depth, focal = 2.0 + uniform(count), float(camera.K[0, 0])
    pixels = torch.tensor([camera.width, camera.height]) * (1.4 * uniform(count, 2) - 0.2)
    centre = torch.tensor([camera.width / 2, camera.height / 2])
    half_angle = 0.5 * torch.pi * uniform(count)
    half_angle[::5], half_angle[1::5] = 0.0, torch.pi / 4
    zero = torch.zeros(count)
    sigma = length / 6 * depth / focal * (0.5 + uniform(count))
    return {
        "means": torch.cat([(pixels - centre) * depth[:, None] / focal, depth[:, None]], dim=1),
        "quats": torch.stack([half_angle.cos(), zero, zero, half_angle.sin()], dim=1),
        "scales": torch.stack([sigma, zero + 1e-4, zero + 1e-4], dim=1),
        "opacities": (uniform(count) ** 2).clamp(min=0.0041),
        "colors": uniform(count, 3),
    }


class Step(NamedTuple):
    """What `rasterize` gave, and its gradients by argument name (and "means2d")."""

    image: Tensor
    alpha: Tensor
    depth: Tensor
    radii: Tensor
    means2d: Tensor
    gradients: dict[str, Tensor]

    @property
    def bits(self) -> dict[str, bytes]:
        """Every value as bytes: equal where the steps agree to the last bit."""
        values = {name: getattr(self, name) for name in self._fields[:-1]}
        values |= {f"gradient of {name}": value for name, value in self.gradients.items()}
        return {name: value.numpy().tobytes() for name, value in values.items()}


class Weights(NamedTuple):
    """The loss is the sum of image, alpha and depth, each times these."""

    image: Tensor
    alpha: Tensor
    depth: Tensor

    @staticmethod
    def random(camera: Camera, seed: int = 0) -> "Weights":
        generator = torch.Generator().manual_seed(seed)
        shape = (camera.height, camera.width)
        return Weights(*(torch.randn(*shape, *more, generator=generator) for more in ((3,), (), ())))

    def without(self, pixels: Tensor) -> "Weights":
        """No weight on these pixels (H, W)."""
        keep = ~pixels
        return Weights(self.image * keep[..., None], self.alpha * keep, self.depth * keep)


def step(
    scene: Scene,
    camera: Camera,
    device: Device,
    *,
    sh_degree: int | None = None,
    background: Tensor | None = None,
    antialiased: bool | float = False,
    weights: Weights | None = None,
) -> Step:
    """One forward and backward pass on the device."""
    weights = weights or Weights.random(camera)
    leaves = {name: value.clone().requires_grad_() for name, value in scene.items()}
    if background is not None:
        background = background.clone().requires_grad_()
    how: dict[str, Any] = {"sh_degree": sh_degree, "background": background, "antialiased": antialiased}
    drawn = rasterize(**leaves, camera=camera, **how, device=device)
    (drawn.image * weights.image).sum().add((drawn.alpha * weights.alpha).sum()).add(
        (drawn.depth * weights.depth).sum()
    ).backward()
    return Step(*(value.detach() for value in drawn), _gradients(leaves, background, drawn.means2d.grad))


def reference_step(
    scene: Scene,
    camera: Camera,
    *,
    sh_degree: int | None = None,
    background: Tensor | None = None,
    antialiased: bool | float = False,
    weights: Weights | None = None,
) -> Step:
    """The same in float64 on the processor. Pixels near a discontinuity must have no weight."""
    weights = weights or Weights.random(camera)
    leaves = {name: value.double().requires_grad_() for name, value in scene.items()}
    if background is not None:
        background = background.double().requires_grad_()
    offset = torch.zeros(len(scene["means"]), 2, dtype=torch.float64, requires_grad=True)
    how: dict[str, Any] = {"sh_degree": sh_degree, "background": background, "antialiased": antialiased}
    drawn = rasterize_reference(**leaves, camera=camera, **how, means2d_offset=offset)
    loss = (drawn.image * weights.image).sum() + (drawn.alpha * weights.alpha).sum()
    (loss + (drawn.depth * weights.depth).sum()).backward()
    return Step(*(value.detach() for value in drawn), _gradients(leaves, background, offset.grad))


def _gradients(leaves: Scene, background: Tensor | None, means2d: Tensor | None) -> dict[str, Tensor]:
    found = {name: leaf.grad for name, leaf in leaves.items()} | {"means2d": means2d}
    if background is not None:
        found["background"] = background.grad
    return {name: torch.empty(0) if value is None else value for name, value in found.items()}


def fragile_pixels(
    scene: Scene, camera: Camera, sh_degree: int | None = None, *, antialiased: bool | float = False
) -> Tensor:
    """(H, W) bool: pixels where rounding may decide between two results."""
    exact = {name: value.double() for name, value in scene.items()}
    return near_discontinuity(**exact, camera=camera, sh_degree=sh_degree, antialiased=antialiased)


def relative(a: Tensor, b: Tensor) -> float:
    """|a - b| / |b|, 0 where both are zero."""
    difference = float((a.double() - b.double()).norm())
    return difference / max(float(b.double().norm()), 1e-30) if difference else 0.0
