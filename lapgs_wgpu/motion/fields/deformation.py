"""The interface of all deformation fields, and their linear layers.

A field is a `Field` with the call field(means, t, dynamics, nearby) -> Deformation. means: (N, 3) canonical, world
units; the field gives them no gradient. t: in [0, 1]. dynamics: (N, D) or None. nearby: a Nearby or None.
A new field is the identity. `OwnField` makes a field of any nn.Module.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.rotation import rotate


class Nearby(NamedTuple):
    """Second sample points of the smoothness loss, which compares features at nearby points.

    rows: (M,) Gaussians. offsets: (M, 3) from their means, world units. time: in [0, 1]. static_weight,
    temporal_weight: of the loss on spatial and on space-time features.
    """

    rows: Tensor
    offsets: Tensor
    time: float
    static_weight: float
    temporal_weight: float


class TimeSamples(NamedTuple):
    """Some of the Gaussians at further times. rows: (M,) indices. times: in [0, 1]."""

    rows: Tensor
    times: tuple[float, ...]

    def chosen(self, means: Tensor, dynamics: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """The rows of all Gaussians' means (N, 3) and dynamics attributes (N, D)."""
        return means[self.rows], None if dynamics is None else dynamics[self.rows]


class Field(nn.Module):
    """Base class of fields."""

    def at_times(
        self, means: Tensor, t: float, dynamics: Tensor | None, nearby: Nearby | None, time_samples: TimeSamples | None
    ) -> "list[Deformation]":
        """Return the deformation at time t as `forward` does, and that of `time_samples` at each of its times."""
        moves = [self(means, t, dynamics, nearby)]
        if time_samples is not None:
            rows, their_dynamics = time_samples.chosen(means, dynamics)
            moves += [self(rows, time, their_dynamics) for time in time_samples.times]
        return moves

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return the parameters by learning rate: "hash" (tables and planes) and "mlp". The spectrum's frequencies, in
        no group, have their own optimizer."""
        groups: dict[str, list[nn.Parameter]] = {"hash": [], "mlp": []}
        for name, parameter in self.named_parameters():
            if name != "motion.frequencies":
                groups["hash" if "grid" in name or "planes" in name else "mlp"].append(parameter)
        return {name: group for name, group in groups.items() if group}


class Deformation(NamedTuple):
    """Changes of N Gaussians at a time. None: no change.

    Attributes:
        rotation: (N, 4) unit quaternions wxyz, which rotate the means about the origin, but not the orientations.
        translation: (N, 3) added to the rotated means, world units.
        d_quats: (N, 4) added to the Gaussians' unit quaternions, after orientation; the sums are normalized.
        d_scales: (N, 3) added to the scales (standard deviations, world units).
        d_dc: (N, 3) added to the constant part of the colors (spherical harmonics, degree 0).
        d_opacity: (N,) added to the opacity logits.
        smoothness: scalar, the weighted smoothness loss; None if it was not requested.
        orientation: (N, 4) unit quaternions wxyz, which rotate the Gaussians' orientations; in rigid motion the same as
            rotation. No built-in field uses it.
    """

    rotation: Tensor | None = None
    translation: Tensor | None = None
    d_quats: Tensor | None = None
    d_scales: Tensor | None = None
    d_dc: Tensor | None = None
    d_opacity: Tensor | None = None
    smoothness: Tensor | None = None
    orientation: Tensor | None = None

    def apply_to_means(self, means: Tensor) -> Tensor:
        """Rotated and shifted means (N, 3)."""
        if self.rotation is not None:
            means = rotate(self.rotation, means)
        return means if self.translation is None else means + self.translation


class Deformed(NamedTuple):
    """Gaussians at a time, activated.

    smoothness: the weighted smoothness loss, if it was asked for. at_times: means (M, 3) and scales (M, 3) of chosen
    Gaussians at each further time that was asked for.
    """

    gaussians: Gaussians[Tensor]
    smoothness: Tensor | None = None
    at_times: Sequence[tuple[Tensor, Tensor]] = ()


def linear(shape: tuple[int, ...], generator: torch.Generator | None = None) -> nn.Linear:
    """Return a linear layer with a weight of this shape (outputs, inputs) and torch's own initial distribution; without
    a generator all zero, so that it starts without effect."""
    outputs, inputs = shape
    layer, reach = nn.Linear(inputs, outputs), inputs**-0.5
    for values in layer.parameters():
        if generator is None:
            nn.init.zeros_(values)
        else:
            nn.init.uniform_(values, -reach, reach, generator)
    return layer
