"""Parts that turn as rigid bodies: their shape and colors, and their turn and shift at each time, fitted by drawing.

A body starts as a ball of Gaussians that turns as `turns` found. Steps of Adam on one image after another fit its
Gaussians, the light, and smooth corrections of its turn and shift at all times.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lapgs_wgpu.discovery.residual import Floats, Mask, Residual
from lapgs_wgpu.discovery.tracks import Tracks, all_of, parabolas
from lapgs_wgpu.discovery.turns import harmonics
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.splat.camera import Array
from lapgs_wgpu.splat.linear_light import directions
from lapgs_wgpu.splat.rasterize import rasterize

POINTS = 300  # of a body
SPACING = 0.5  # standard deviation of a Gaussian in distances of a body's points, at first
STEPS = 800
RATES = {"points": 2e-3, "colors": 2e-2, "sizes": 1e-2, "opacities": 3e-2, "light": 5e-3, "turns": 1e-2, "shifts": 1e-3}
LAST = 0.05  # of these rates, in the end; they fall over the second half
UNEXPLAINED = 0.3  # of what the static fit lacks where a body is: more is left over of what is not rigid
SPREADS = {"turns": 4.0, "shifts": 2.0}  # time steps; of the weights by which parabolas are fitted around each time


def rigid_tracks(
    tracks: Tracks,
    stands: NDArray[np.int64],
    rotations: Mapping[int, Array],
    times: Array,
    images: Sequence[Residual],
    device: Device,
    generator: torch.Generator,
) -> tuple[Tracks, dict[int, Floats]]:
    """The tracks, in which the parts of the given rotations (T, 3, 3) at the times (T,) are rigid bodies; and by the
    number of each body the light (T, POINTS) on it, times its mean over time, which is in the colors.

    stands: (p,) which part stands for each; a body takes the place of all for which its part stands.
    Other parts are drawn, too, as they are, and so stay those of which too little of the images is explained.
    """
    bodies = _Bodies(tracks, ~np.isin(stands[tracks.part], list(rotations)), rotations, times)
    errors = bodies.fit(images, device, generator)
    rigid = {k: n for n, k in enumerate(rotations) if errors[1, n] < UNEXPLAINED * errors[0, n]}
    paths, colors, lights = bodies.in_the_end()
    found = [tracks.rows(~np.isin(stands[tracks.part], list(rigid)))]
    for k, n in rigid.items():
        part, own = tracks.rows(tracks.part == k), paths[:, n]
        key = np.linalg.norm(tracks.center(k) - part.positions.mean(axis=0), axis=1).argmin()  # where it was found
        seen = np.repeat(part.supported[:, :1], POINTS, axis=1)
        found.append(Tracks(own[key], colors[n], np.full(POINTS, k), own, seen))
    return all_of(found), {k: lights[:, n] for k, n in rigid.items()}


class _Bodies:
    """Gaussians of bodies, one for each given rotation (T, 3, 3), and of other tracks (n,), which stay as they are."""

    def __init__(self, tracks: Tracks, others: Mask, rotations: Mapping[int, Array], times: Array) -> None:
        parts, self._times = list(rotations), times
        self._radii = torch.tensor([tracks.radius(k) for k in parts])
        self._R = torch.from_numpy(np.stack([rotations[k] for k in parts], axis=1)).float()
        self._centers = torch.from_numpy(np.stack([tracks.center(k) for k in parts], axis=1))
        self._around = {name: torch.from_numpy(parabolas(times, 1.0, each)).float() for name, each in SPREADS.items()}
        self._others, other_colors = torch.from_numpy(tracks.paths[:, others]), torch.from_numpy(tracks.colors[others])
        count, rest = len(parts) * POINTS, len(other_colors)
        size = torch.log(SPACING * (4 * np.pi / POINTS) ** 0.5 * self._radii).repeat_interleave(POINTS)
        self._quats = torch.tensor([1.0, 0, 0, 0]).repeat(count + rest, 1)
        self._values = {
            "points": torch.from_numpy(directions(POINTS)).float() * self._radii[:, None, None],
            "colors": torch.cat([torch.full((count, 3), 0.4), other_colors]),
            "sizes": torch.cat([size, torch.full((rest,), float(size.mean()))]),
            "opacities": torch.full((count + rest,), 3.0),
            "light": torch.eye(9)[0].repeat(len(parts), 1),
            "turns": torch.zeros(len(times), len(parts), 3),
            "shifts": torch.zeros(len(times), len(parts), 3),
        }
        for value in self._values.values():
            value.requires_grad_()

    def _poses(self, at: int | slice) -> tuple[Tensor, Tensor]:
        """Turns (..., p, 3, 3) and centers (..., p, 3)."""
        turns, shifts = (torch.tensordot(self._around[name][at], self._values[name], 1) for name in ("turns", "shifts"))
        turned = torch.linalg.cross(torch.eye(3).expand(*turns.shape, 3), turns[..., None, :])
        return torch.linalg.matrix_exp(turned) @ self._R[at], self._centers[at] + shifts

    def _light(self, arms: Tensor) -> Tensor:
        """(..., p, POINTS) on points at these places (..., p, POINTS, 3) from the centers."""
        ways = nn.functional.normalize(arms.detach(), dim=-1).unbind(dim=-1)
        return (torch.stack(harmonics(*ways), dim=-1) @ self._values["light"][:, :, None])[..., 0]

    def _drawn(self, image: Residual, device: Device) -> tuple[Tensor, Tensor]:
        """The picture (H, W, 3) of all before the static fit at an image's time, and the bodies' centers (p, 3)."""
        at, values = int(np.searchsorted(self._times, image.time)), self._values
        R, center = self._poses(at)
        arms = values["points"] @ R.transpose(1, 2)
        means = torch.cat([(arms + center[:, None]).reshape(-1, 3), self._others[at]])
        lit = torch.cat([self._light(arms).reshape(-1, 1), torch.ones(self._others.shape[1], 1)])
        shapes = means, self._quats, values["sizes"].exp()[:, None].repeat(1, 3), values["opacities"].sigmoid()
        drawn = rasterize(*shapes, values["colors"] * lit, image.camera, antialiased=True, depth=False, device=device)
        return drawn.image + (1 - drawn.alpha)[..., None] * torch.from_numpy(image.still), center

    def fit(self, images: Sequence[Residual], device: Device, generator: torch.Generator) -> Array:
        """Fit them. Returns (2, p): errors of the static fit and of the drawing, where each body is, in the end."""
        optimizer = torch.optim.Adam([{"params": [value], "name": name} for name, value in self._values.items()])
        order: list[int] = []
        errors = np.zeros((2, len(self._radii)))
        for step in range(STEPS):
            order = order or torch.randperm(len(images), generator=generator).tolist()
            image = images[order.pop()]
            for group in optimizer.param_groups:
                group["lr"] = RATES[group["name"]] * max(LAST, min(1.0, 2.0 * (STEPS - step) / STEPS))
            picture, center = self._drawn(image, device)
            difference = (picture - torch.from_numpy(image.image)).abs()
            optimizer.zero_grad()
            difference.sum().backward()
            optimizer.step()
            if step >= STEPS - len(images):
                middles, depths = image.camera.project(center.numpy(force=True).astype(np.float64))
                reach = image.camera.K[0, 0] * self._radii.double().numpy() / np.maximum(depths, 1e-6)
                shown = [image.moving_within(*body) for body in zip(middles, reach, strict=True)]
                absolute = np.abs(image.still - image.image), difference.numpy(force=True)
                errors += [[each[where].sum() for where in shown] for each in absolute]
        return errors

    @torch.no_grad()
    def in_the_end(self) -> tuple[Floats, Floats, Floats]:
        """Paths (T, p, POINTS, 3), colors (p, POINTS, 3), light (T, p, POINTS) times its mean, which is in these."""
        R, center = self._poses(slice(None))
        paths = self._values["points"] @ R.transpose(2, 3) + center[:, :, None]
        light = self._light(paths - center[:, :, None])
        mean = light.mean(dim=0)
        colors = self._values["colors"][: mean.numel()].reshape(*mean.shape, 3) * mean[..., None]
        return paths.numpy(), colors.clamp(0, 1).numpy(), (light / mean).numpy()
