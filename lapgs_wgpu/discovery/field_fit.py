"""A deformation field fitted to tracks, before any image is looked at."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor, nn

from lapgs_wgpu.discovery.residual import Floats
from lapgs_wgpu.discovery.tracks import Tracks
from lapgs_wgpu.motion.fields.config import APPEARANCE_SCALE
from lapgs_wgpu.motion.fields.deformation import Deformation, TimeSamples
from lapgs_wgpu.motion.fields.grid_field import GridField
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.train.optimizer import ADAM_EPS

AT_ONCE, FEWER = 8, 2  # for tracks that fade: times that a step looks at, and how many times fewer of them it asks
STILL = 300  # Gaussians of the static fit that a step asks to stay where they are
MOVING = 1500  # Gaussians of tracks that a step asks, at most
HASH_RATE, MLP_RATE = 1e-2, 2e-3  # learning rates: half of those of the preset tiny, twice train.start.MAX_*_RATE
LAST = 0.05  # of the learning rates, in the end; they fall over the second half
SHAPE_WEIGHT = 0.1  # of changes of scales and quaternions, which the tracks do not know
HIDDEN = 0.1  # weight of the places of what is faded, which would else wander before the cameras
SHEET_STIFF = 10.0  # times as much, of the scales of tracks that fade
FADED, FADE_WEIGHT = 7.0, 0.03  # logits by which what is not seen loses opacity; weight of the distance from that
HINGES = 3.0  # of the decoder's units, whose inputs are of the size 1: how much they change over the clip
OPEN = 2.0  # the gate's inputs: 0.76 is let through
WITHIN, BEYOND = 0.5, 0.3  # of the way to another point of its body, on which a step asks for one; and away from it
LIGHT_WEIGHT = 0.03  # of the light on bodies
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
    light: Mapping[int, Floats] | None = None,
) -> float | None:
    """Train the field of a scene so that its last Gaussians follow the tracks, and the first `still` ones stay.

    Each step looks at one of the times (T,). fades: whether tracks lose opacity where they are not seen. light: (T, m)
    of `rigid_tracks`, by the number of each part that is a body; of these the field learns all that lies inside, where
    Gaussians will be, and the light. Returns the mean distance of tracks and Gaussians in the end, world units; None,
    and nothing is trained, where the field moves no Gaussians.
    """
    field = scene.field
    assert field is not None
    groups = [(HASH_RATE if name == "hash" else MLP_RATE, each) for name, each in field.parameter_groups().items()]
    if (fades or light) and (head := getattr(field, "appearance", None)) is not None:  # outputs in that unit
        own = {id(parameter) for parameter in head.parameters()}
        groups = [(rate, [each for each in parameters if id(each) not in own]) for rate, parameters in groups]
        groups.append((MLP_RATE / APPEARANCE_SCALE, list(head.parameters())))
    if fades and isinstance(field, GridField) and field.config.dynamics_size > 1 and field.config.temporal_hash:
        _tell_times(field, generator)
    optimizer = torch.optim.Adam(
        [{"params": parameters, "lr": rate} for rate, parameters in groups], eps=ADAM_EPS, fused=True
    )
    device = scene.parameters["means"].device
    paths, supported = torch.from_numpy(tracks.paths).to(device), torch.from_numpy(tracks.supported).to(device)
    beside = torch.from_numpy(ndimage.maximum_filter1d(tracks.supported, 3, axis=0)).to(device)
    moving = torch.arange(still, still + len(tracks.part), device=device)
    canonical = scene.parameters["means"].detach()
    first = torch.arange(len(tracks.part), device=device)  # of the points of its body, for each
    count = torch.ones_like(first)
    shades = torch.zeros(*tracks.paths.shape[:2], 3, device=device)
    for k, factors in (light or {}).items():
        body = np.flatnonzero(tracks.part == k)
        first[body], count[body] = int(body[0]), len(body)
        colors = CONSTANTS["SH_OFFSET"] / CONSTANTS["SH_C0"] + scene.parameters["sh_dc"].detach()[still + body, 0]
        shades[:, body] = (torch.from_numpy(factors).to(device)[..., None] - 1) * colors
    order: list[int] = []
    errors: list[float] = []
    at_once, most = (AT_ONCE, MOVING // FEWER) if fades else (1, MOVING)
    for step in range(steps):
        now: list[int] = []
        for _ in range(at_once):
            order = order or torch.randperm(len(times), generator=generator).tolist()
            now.append(order.pop())
        staying = torch.randint(max(still, 1), (min(still, STILL),), generator=generator).to(device)
        asked = moving
        if len(moving) > most:
            asked = moving[torch.randint(len(moving), (most,), generator=generator).to(device)]
        on_track = asked - still
        rows = torch.cat([asked, staying])
        other, way = on_track, torch.zeros(len(asked), 1, device=device)
        if light:
            drawn = torch.rand(2, len(asked), 1, generator=generator).to(device)
            other = first[on_track] + (drawn[0, :, 0] * count[on_track]).long()
            way = drawn[1] * (WITHIN + BEYOND) - BEYOND
        means = torch.cat([canonical[asked].lerp(canonical[still + other], way), canonical[staying]])
        dynamics = scene.parameters["dynamics"].detach()[rows] if "dynamics" in scene.parameters else None
        loss, distance = torch.zeros((), device=device), 0.0
        for at, move in zip(now, _moves(field, means, [float(times[at]) for at in now], dynamics), strict=True):
            moved = move.apply_to_means(means)
            seen = supported[at, on_track]
            targets = paths[at, on_track].lerp(paths[at, other], way)
            squared = (moved - torch.cat([targets, means[len(asked) :]])).square().sum(dim=1)
            far = (squared + SOFTENING**2).sqrt()
            if fades:  # few are seen at a time; between two times, those of both
                weights = HIDDEN + (1 - HIDDEN) * beside[at, on_track].float()
                loss = loss + (weights * far[: len(asked)]).sum() / weights.sum() + far[len(asked) :].mean()
            else:
                weights = torch.cat([seen.float(), torch.ones(len(staying), device=device)])
                loss = loss + (weights * far).mean()
            stiff = 1.0 if move.d_scales is None or not fades else SHEET_STIFF
            loss = loss + SHAPE_WEIGHT * sum(
                (weight * change).abs().mean()
                for weight, change in ((stiff, move.d_scales), (1.0, move.d_quats))
                if change is not None
            )
            if light and move.d_dc is not None:
                shade = shades[at, on_track].lerp(shades[at, other], way)
                of_tracks, of_still = move.d_dc.split([len(asked), len(staying)])
                loss = loss + LIGHT_WEIGHT * ((of_tracks - shade).abs().mean() + of_still.abs().mean())
            if fades and move.d_opacity is not None:
                fading = (move.d_opacity + FADED * torch.cat([~seen, seen.new_zeros(len(staying))])).abs()
                of_tracks, of_still = fading.split([len(asked), len(staying)])
                kinds = of_tracks[seen], of_tracks[~seen], of_still
                loss = loss + FADE_WEIGHT * sum(each.mean() for each in kinds if len(each))
            distance += float((seen * squared[: len(asked)].detach().sqrt()).sum() / seen.sum().clamp(min=1))
        if not loss.requires_grad:
            return None
        for group, (rate, _) in zip(optimizer.param_groups, groups, strict=True):
            group["lr"] = rate * max(LAST, min(1.0, 2.0 * (steps - step) / steps))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        errors.append(distance / at_once)
        progress(step + 1)
    optimizer.zero_grad()
    return float(np.mean(errors[-max(1, steps // 10) :]))


def _moves(field: nn.Module, means: Tensor, times: list[float], dynamics: Tensor | None) -> list[Deformation]:
    """The deformation at each time."""
    if len(times) > 1 and isinstance(field, GridField):
        others = TimeSamples(torch.arange(len(means), device=means.device), tuple(times[1:]))
        return field.at_times(means, times[0], dynamics, None, others)
    return [field(means, t, dynamics, None) for t in times]


def _tell_times(field: GridField, generator: torch.Generator) -> None:
    """Have the decoder's units begin as hinges in time and in the time of a sheet's code (`discover.scene_with`): what
    moves and fades one after another is made of these. Without a code, as what stands still is, all are zero."""
    with torch.no_grad():
        for grid in field.grids[1:]:
            if grid.levels[0].dense:
                x, y, t = grid.levels[0].resolution
                grid.table[: x * y * t, 0] = torch.linspace(-1, 1, t).repeat_interleave(x * y)
        weight, size = field.temporal.weight, field.config.dynamics_size
        weight[:, size] = HINGES * (2 * torch.rand(len(weight), generator=generator) - 1)
        weight[:, 1] = torch.rand(len(weight), generator=generator) * 2 - 1
        weight[:, 0] = (1 + 1 + HINGES) / 2
        field.temporal.bias.fill_(-1 - HINGES)
        field.spatial.bias.fill_(OPEN)
