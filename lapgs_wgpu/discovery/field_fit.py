"""A deformation field fitted to tracks, before any image is looked at."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from lapgs_wgpu.discovery.tracks import Tracks
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.train.optimizer import ADAM_EPS

STILL = 300  # Gaussians of the static fit that a step asks to stay where they are
MOVING = 1500  # Gaussians of tracks that a step asks, at most
HASH_RATE, MLP_RATE = 1e-2, 2e-3  # learning rates: half of those of the preset tiny, twice train.start.MAX_*_RATE
LAST = 0.05  # of the learning rates, in the end; they fall over the second half
SHAPE_WEIGHT = 0.1  # of changes of scales and quaternions, which the tracks do not know
FADED, FADE_WEIGHT = 4.0, 0.2  # logits by which what is not seen loses opacity; weight of the distance from that
SOFTENING = 1e-2  # world units; distances below count as squares


def fit_field(
    scene: Scene4D,
    tracks: Tracks,
    times: NDArray[np.float64],
    still: int,
    steps: int,
    generator: torch.Generator,
    progress: Callable[[int], None],
    *,
    fades: bool = False,
) -> float | None:
    """Train the field of a scene so that its last Gaussians follow the tracks, and the first `still` ones stay.

    Each step looks at one of the times (T,). fades: whether tracks lose opacity where they are not seen. Returns the
    mean distance of tracks and Gaussians in the end, world units; None, and nothing is trained, where the field moves
    no Gaussians.
    """
    field = scene.field
    assert field is not None
    groups = field.parameter_groups()
    rates = {name: HASH_RATE if name == "hash" else MLP_RATE for name in groups}
    optimizer = torch.optim.Adam(
        [{"params": parameters, "lr": rates[name]} for name, parameters in groups.items()], eps=ADAM_EPS, fused=True
    )
    device = scene.parameters["means"].device
    paths, supported = torch.from_numpy(tracks.paths).to(device), torch.from_numpy(tracks.supported).to(device)
    moving = torch.arange(still, still + len(tracks.part), device=device)
    order: list[int] = []
    errors: list[float] = []
    for step in range(steps):
        order = order or torch.randperm(len(times), generator=generator).tolist()
        at = order.pop()
        staying = torch.randint(max(still, 1), (min(still, STILL),), generator=generator).to(device)
        asked = moving
        if len(moving) > MOVING:
            asked = moving[torch.randint(len(moving), (MOVING,), generator=generator).to(device)]
        on_track = asked - still
        rows = torch.cat([asked, staying])
        means = scene.parameters["means"].detach()[rows]
        dynamics = scene.parameters["dynamics"].detach()[rows] if "dynamics" in scene.parameters else None
        move = field(means, float(times[at]), dynamics, None)
        moved = move.apply_to_means(means)
        seen = supported[at, on_track]
        weights = torch.cat([seen.float(), torch.ones(len(staying), device=device)])
        squared = (moved - torch.cat([paths[at, on_track], means[len(asked) :]])).square().sum(dim=1)
        loss = (weights * (squared + SOFTENING**2).sqrt()).mean()
        loss = loss + SHAPE_WEIGHT * sum(
            change.abs().mean() for change in (move.d_scales, move.d_quats) if change is not None
        )
        if fades and move.d_opacity is not None:
            fading = move.d_opacity + FADED * torch.cat([~seen, seen.new_zeros(len(staying))])
            loss = loss + FADE_WEIGHT * fading.abs().mean()
        if not loss.requires_grad:
            return None
        for group, name in zip(optimizer.param_groups, groups, strict=True):
            group["lr"] = rates[name] * max(LAST, min(1.0, 2.0 * (steps - step) / steps))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        distances = squared[: len(asked)].detach().sqrt()
        errors.append(float((seen * distances).sum() / seen.sum().clamp(min=1)))
        progress(step + 1)
    optimizer.zero_grad()
    return float(np.mean(errors[-max(1, steps // 10) :]))
