"""Parts that turn as rigid bodies: their shape and colors, and their turn and shift at each time, fitted by drawing.

A body starts as a ball of Gaussians that turns as `turns` found. Steps of Adam on one image after another fit its
Gaussians, the light, and smooth corrections of its turn and shift at all times.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lapgs_wgpu.discovery.residual import Floats, Residual
from lapgs_wgpu.discovery.tracks import Tracks, all_of, parabolas
from lapgs_wgpu.discovery.turns import harmonics
from lapgs_wgpu.gpu.device import Device
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
    rotations: Mapping[int, NDArray[np.float64]],
    times: NDArray[np.float64],
    images: Sequence[Residual],
    device: Device,
    generator: torch.Generator,
) -> tuple[Tracks, dict[int, Floats]]:
    """The tracks, in which the parts of the given rotations (T, 3, 3) at the times (T,) are rigid bodies; and by the
    number of each body the light (T, POINTS) on it, times its mean over time, which is in the colors.

    stands: (p,) which part stands for each; a body takes the place of all for which its part stands.
    Other parts are drawn, too, as they are, and so stay those of which too little of the images is explained.
    """
    parts = list(rotations)
    radii = torch.tensor([tracks.radius(k) for k in parts])
    others = ~np.isin(stands[tracks.part], parts)
    R0 = torch.from_numpy(np.stack([rotations[k] for k in parts], axis=1)).float()
    centers = torch.from_numpy(np.stack([tracks.center(k) for k in parts], axis=1))
    other_paths, other_colors = torch.from_numpy(tracks.paths[:, others]), torch.from_numpy(tracks.colors[others])
    count = len(parts) * POINTS
    size = torch.log(SPACING * (4 * np.pi / POINTS) ** 0.5 * radii).repeat_interleave(POINTS)
    other_size = torch.full((len(other_colors),), float(size.mean()))
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count + len(other_size), 1)
    around = {name: torch.from_numpy(parabolas(times, 1.0, spread)).float() for name, spread in SPREADS.items()}
    values = {
        "points": torch.from_numpy(directions(POINTS)).float() * radii[:, None, None],
        "colors": torch.cat([torch.full((count, 3), 0.4), other_colors]),
        "sizes": torch.cat([size, other_size]),
        "opacities": torch.full((count + len(other_size),), 3.0),
        "light": torch.eye(9)[0].repeat(len(parts), 1),
        "turns": torch.zeros(len(times), len(parts), 3),
        "shifts": torch.zeros(len(times), len(parts), 3),
    }
    for value in values.values():
        value.requires_grad_()
    optimizer = torch.optim.Adam([{"params": [value], "name": name} for name, value in values.items()])

    def poses(at: int | slice) -> tuple[Tensor, Tensor]:
        turns, shifts = (torch.tensordot(around[name][at], values[name], 1) for name in ("turns", "shifts"))
        turned = torch.linalg.cross(torch.eye(3).expand(*turns.shape, 3), turns[..., None, :])
        return torch.linalg.matrix_exp(turned) @ R0[at], centers[at] + shifts

    def light_on(arms: Tensor) -> Tensor:
        """(..., p, POINTS) on points at these places (..., p, POINTS, 3) from the centers."""
        ways = nn.functional.normalize(arms.detach(), dim=-1).unbind(dim=-1)
        return (torch.stack(harmonics(*ways), dim=-1) @ values["light"][:, :, None])[..., 0]

    order: list[int] = []
    errors = np.zeros((2, len(parts)))  # of the static fit and of the drawing, where a part is, at the end
    for step in range(STEPS):
        order = order or torch.randperm(len(images), generator=generator).tolist()
        image = images[order.pop()]
        at = int(np.searchsorted(times, image.time))
        for group in optimizer.param_groups:
            group["lr"] = RATES[group["name"]] * max(LAST, min(1.0, 2.0 * (STEPS - step) / STEPS))
        R, center = poses(at)
        arms = values["points"] @ R.transpose(1, 2)
        means = torch.cat([(arms + center[:, None]).reshape(-1, 3), other_paths[at]])
        lit = torch.cat([light_on(arms).reshape(-1, 1), torch.ones(len(other_size), 1)])
        shapes = means, quats, values["sizes"].exp()[:, None].repeat(1, 3), values["opacities"].sigmoid()
        drawn = rasterize(*shapes, values["colors"] * lit, image.camera, antialiased=True, depth=False, device=device)
        picture = drawn.image + (1 - drawn.alpha)[..., None] * torch.from_numpy(image.still)
        difference = (picture - torch.from_numpy(image.image)).abs()
        optimizer.zero_grad()
        difference.sum().backward()
        optimizer.step()
        if step >= STEPS - len(images):
            absolute = np.abs(image.still - image.image), difference.numpy(force=True)
            middles, depths = image.camera.project(center.numpy(force=True).astype(np.float64))
            reach = image.camera.K[0, 0] * radii.double().numpy() / np.maximum(depths, 1e-6)
            for n in range(len(parts)):
                where = image.moving_within(middles[n], reach[n])
                errors[:, n] += [each[where].sum() for each in absolute]
    rigid = errors[1] < UNEXPLAINED * errors[0]  # which of the parts are bodies
    with torch.no_grad():
        R, center = poses(slice(None))
        paths = values["points"] @ R.transpose(2, 3) + center[:, :, None]
        light = light_on(paths - center[:, :, None])
        mean = light.mean(dim=0)
        colors = (values["colors"][:count].reshape(len(parts), POINTS, 3) * mean[..., None]).clamp(0, 1).numpy()
        lights = (light / mean).numpy()
    bodies = {k: n for n, k in enumerate(parts) if rigid[n]}
    found = [tracks.rows(~np.isin(stands[tracks.part], list(bodies)))]
    for k, n in bodies.items():
        part, own = tracks.rows(tracks.part == k), paths[:, n].numpy()
        key = np.linalg.norm(tracks.center(k) - part.positions.mean(axis=0), axis=1).argmin()  # where it was found
        seen = np.repeat(part.supported[:, :1], POINTS, axis=1)
        found.append(Tracks(own[key], colors[n], np.full(POINTS, k), own, seen))
    return all_of(found), {k: lights[:, n] for k, n in bodies.items()}
