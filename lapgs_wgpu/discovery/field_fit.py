"""A deformation field fitted to tracks, before any image is looked at."""

from collections.abc import Callable, Mapping

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor, nn

from lapgs_wgpu.discovery.residual import Floats
from lapgs_wgpu.discovery.tracks import Tracks
from lapgs_wgpu.motion.fields.config import APPEARANCE_SCALE
from lapgs_wgpu.motion.fields.deformation import Deformation, Field, TimeSamples
from lapgs_wgpu.motion.fields.grid_field import GridField
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.constants import CONSTANTS
from lapgs_wgpu.train.optimizer import ADAM_EPS

STILL = 300  # Gaussians of the static fit that a step asks to stay where they are
MOVING = 1500  # Gaussians of tracks that a step asks, at most
HASH_RATE, MLP_RATE = 1e-2, 2e-3  # learning rates: half of those of the preset tiny, twice train.setup.MAX_*_RATE
LAST = 0.05  # of the learning rates, in the end; they fall over the second half
SHAPE_WEIGHT = 0.1  # of changes of scales and quaternions, which the tracks do not know
HIDDEN = 0.1  # weight of the places of what is faded, which would else wander before the cameras
SHEET_STIFF = 10.0  # times as much, of the scales of tracks that fade
FADED, FADE_WEIGHT = 7.0, 0.12  # logits by which what is not seen loses opacity; weight of the distance from that
SHEET_DYNAMICS = 2.0  # of the dynamics attributes of sheets: of all of them, and of the last one's time
HINGES = 3.0  # of the decoder's units, whose inputs are of the size 1: how much they change over the clip
STEEP = 0.5  # of those about a sheet's own time, times the number of sheets
WITHIN, BEYOND = 0.5, 0.3  # of the way to another point of its body, on which a step asks for one; and away from it
LIGHT_WEIGHT = 0.03  # of the light on bodies
SOFTENING = 1e-2  # world units; distances below count as squares


def fit_field(
    scene: Scene4D,
    tracks: Tracks,
    times: NDArray[np.float64],
    steps: int,
    generator: torch.Generator,
    progress: Callable[[int], None],
    *,
    fades: bool,
    light: Mapping[int, Floats],
) -> float | None:
    """Train the field of a scene so that its last Gaussians follow the tracks, and those before them stay.

    Each step looks at one of the times (T,). fades: whether tracks lose opacity where they are not seen. light: (T, m)
    of `rigid_tracks`, by the number of each part that is a body; of these the field learns all that lies inside, where
    Gaussians will be, and the light. Returns the mean distance of tracks and Gaussians in the end, world units; None,
    and nothing is trained, where the field moves no Gaussians.
    """
    field, still = scene.field, len(scene) - len(tracks.part)
    assert field is not None
    groups = _groups(field, look=fades or bool(light))
    if not groups:
        return None
    if fades and isinstance(field, GridField) and field.config.dynamics_size > 1 and field.config.temporal_hash:
        _tell_times(field, tracks.parts, generator)
    optimizer = torch.optim.Adam([{"params": each, "rate": rate} for rate, each in groups], eps=ADAM_EPS, fused=True)
    paths, supported = torch.from_numpy(tracks.paths), torch.from_numpy(tracks.supported)
    beside = torch.from_numpy(ndimage.maximum_filter1d(tracks.supported, 3, axis=0)).float()
    canonical, codes = scene.parameters["means"].detach(), scene.parameters.get("dynamics")
    first, count, shades = _bodies(scene, tracks, light)
    order: list[int] = []
    errors: list[float] = []
    at_once, most = (8, MOVING // 2) if fades else (1, MOVING)  # times that a step looks at, and Gaussians
    for step in range(steps):
        while len(order) < at_once:
            order = torch.randperm(len(times), generator=generator).tolist() + order
        now = [order.pop() for _ in range(at_once)]
        staying = torch.randint(max(still, 1), (min(still, STILL),), generator=generator)
        asked, other, way = _asked(first, count, most, generator, within=bool(light))
        means = torch.cat([canonical[still + asked].lerp(canonical[still + other], way), canonical[staying]])
        dynamics = None if codes is None else codes.detach()[torch.cat([still + asked, staying])]
        loss, distance = torch.zeros(()), 0.0
        first_time, *others = (float(times[at]) for at in now)
        samples = TimeSamples(torch.arange(len(means)), tuple(others)) if others else None
        for at, move in zip(now, field.at_times(means, first_time, dynamics, None, samples), strict=True):
            seen, targets = supported[at, asked], paths[at, asked].lerp(paths[at, other], way)
            squared = (move.apply_to_means(means) - torch.cat([targets, means[len(asked) :]])).square().sum(dim=1)
            far = (squared + SOFTENING**2).sqrt()
            if fades:
                loss = loss + _sheets_loss(move, far, seen, beside[at, asked])
            else:
                shade = shades[at, asked].lerp(shades[at, other], way) if light else None
                loss = loss + _parts_loss(move, far, seen, shade)
            distance += float((seen * squared[: len(asked)].detach().sqrt()).sum() / seen.sum().clamp(min=1))
        if not loss.requires_grad:
            return None
        for group in optimizer.param_groups:
            group["lr"] = group["rate"] * max(LAST, min(1.0, 2.0 * (steps - step) / steps))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        errors.append(distance / at_once)
        progress(step + 1)
    optimizer.zero_grad()
    return float(np.mean(errors[-max(1, steps // 10) :]))


def _asked(
    first: Tensor, count: Tensor, most: int, generator: torch.Generator, *, within: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """The points of tracks (n,) that a step asks, at most so many; within: on the way from each to another point of its
    body (n,), at a share of it (n, 1). first, count: of `_bodies`."""
    asked = torch.randint(len(first), (most,), generator=generator) if len(first) > most else torch.arange(len(first))
    if not within:
        return asked, asked, torch.zeros(len(asked), 1)
    along, way = torch.rand(2, len(asked), 1, generator=generator)
    return asked, first[asked] + (along[:, 0] * count[asked]).long(), way * (WITHIN + BEYOND) - BEYOND


def _groups(field: Field, *, look: bool) -> list[tuple[float, list[nn.Parameter]]]:
    """What is trained, with its learning rate. look: so is what changes the Gaussians' look, in its own unit."""
    groups = [(HASH_RATE if name == "hash" else MLP_RATE, each) for name, each in field.parameter_groups().items()]
    if groups and look and (head := getattr(field, "appearance", None)) is not None:
        own = set(head.parameters())
        groups = [(rate, [one for one in each if one not in own]) for rate, each in groups]
        groups.append((MLP_RATE / APPEARANCE_SCALE, list(head.parameters())))
    return groups


def _parts_loss(move: Deformation, far: Tensor, seen: Tensor, shade: Tensor | None) -> Tensor:
    """The loss at a time. far: (n + m,) how far Gaussians of tracks, and those that stay, are from where they should
    be. seen: (n,) whether these tracks are. shade: (n, 3) what the light adds to their colors; None where all is even.
    """
    still = len(far) - len(seen)
    loss = (torch.cat([seen.float(), torch.ones(still)]) * far).mean() + _shape_loss(move, stiffness=1.0)
    if shade is not None and move.d_dc is not None:
        of_tracks, of_still = move.d_dc.split([len(seen), still])
        loss = loss + LIGHT_WEIGHT * ((of_tracks - shade).abs().mean() + of_still.abs().mean())
    return loss


def _sheets_loss(move: Deformation, far: Tensor, seen: Tensor, beside: Tensor) -> Tensor:
    """The loss of tracks that fade where they are not seen, as `_parts_loss`. beside: (n,) 1 for what is seen at this
    time or at one beside it, since between two times those of both are, else 0."""
    sizes = [len(seen), len(far) - len(seen)]
    weights = HIDDEN + (1 - HIDDEN) * beside  # few are seen at a time
    of_tracks, of_still = far.split(sizes)
    loss = (weights * of_tracks).sum() / weights.sum() + of_still.mean() + _shape_loss(move, stiffness=SHEET_STIFF)
    if move.d_opacity is not None:
        of_tracks, of_still = move.d_opacity.split(sizes)
        kinds = of_tracks[seen], (of_tracks[beside == 0] + FADED).clamp(min=0), of_still
        loss = loss + FADE_WEIGHT * sum(each.abs().mean() for each in kinds if len(each))
    return loss


def _shape_loss(move: Deformation, stiffness: float) -> Tensor | float:
    """Of changes of scales, which count `stiffness` times, and of quaternions."""
    changes = (stiffness, move.d_scales), (1.0, move.d_quats)
    return SHAPE_WEIGHT * sum((weight * each).abs().mean() for weight, each in changes if each is not None)


def _bodies(scene: Scene4D, tracks: Tracks, light: Mapping[int, Floats]) -> tuple[Tensor, Tensor, Tensor]:
    """Of each point of the tracks (n,): the first point of its body, and how many that has; and how much light adds to
    its color (T, n, 3). A point of no body is one of its own, without light."""
    n = len(tracks.part)
    first, count, shades = torch.arange(n), torch.ones(n, dtype=torch.int64), torch.zeros(*tracks.paths.shape[:2], 3)
    for k, factors in light.items():
        body = np.flatnonzero(tracks.part == k)
        first[body], count[body] = int(body[0]), len(body)
        own = scene.parameters["sh_dc"].detach()[len(scene) - n + body, 0]
        colors = CONSTANTS["SH_OFFSET"] / CONSTANTS["SH_C0"] + own
        shades[:, body] = (torch.from_numpy(factors)[..., None] - 1) * colors
    return first, count, shades


def _tell_times(field: GridField, parts: int, generator: torch.Generator) -> None:
    """Have the decoder's units begin as hinges in time and in the time of a sheet's code (`discover`): what
    moves and fades one after another is made of these. Half of them lie about a sheet's own time, the steeper the more
    parts there are. Without a code, as what stands still is, all are zero."""
    with torch.no_grad():
        for grid in field.grids[1:]:
            if grid.levels[0].dense:
                x, y, t = grid.levels[0].resolution
                grid.table[: x * y * t, 0] = torch.linspace(-1, 1, t).repeat_interleave(x * y)
        weight, size = field.temporal.weight, field.config.dynamics_size
        slope, own, knot = 2 * torch.rand(3, len(weight), generator=generator) - 1
        steep, half = torch.full((len(weight),), HINGES), len(weight) // 2
        steep[:half], slope[:half] = STEEP * parts, slope[:half].sign()
        own[:half], knot[half:] = -steep[:half] * slope[:half] / SHEET_DYNAMICS, 1
        weight[:, size], weight[:, 1] = steep * slope / field.config.time_scale, own
        weight[:, 0] = (1 + steep + knot) / SHEET_DYNAMICS
        field.temporal.bias.copy_(-1 - steep)
        field.spatial.bias.fill_(2.0)  # the gate lets 0.76 through
