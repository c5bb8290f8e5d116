"""The interface of all deformation fields: what a field is asked and what it returns.

A field is an nn.Module that is called as field(means, t, dynamics, nearby) -> Deformation. means: (N, 3) canonical,
world units; they get no gradient from the field. t: in [0, 1]. dynamics: (N, D) or None. nearby: a Nearby or None.
A new field changes nothing. parameter_groups() returns its parameters by learning rate: "hash" (tables and planes) and
"mlp".
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Nearby(NamedTuple):
    """Where a field is asked once more, to keep it smooth: Gaussians `rows` (M,), at their means + offsets (M, 3),
    world units, and at another time in [0, 1]. The weights are those of the two parts of the smoothness loss."""

    rows: Tensor
    offsets: Tensor
    time: float
    static_weight: float
    temporal_weight: float


class Deformation(NamedTuple):
    """What is done to N Gaussians at a time.

    Means are turned by `rotation` (N, 4) wxyz of unit length about the origin and shifted by `translation` (N, 3);
    d_quats (N, 4) and d_scales (N, 3) are added to unit quaternions and to scales, d_dc (N, 3) to the colors' constant
    part and d_opacity (N,) to the opacities' logits, None where the field leaves them as they are.
    smoothness: a scalar, the weighted loss that keeps the field smooth; None where it was not asked for.
    """

    rotation: Tensor | None
    translation: Tensor
    d_quats: Tensor
    d_scales: Tensor
    d_dc: Tensor | None = None
    d_opacity: Tensor | None = None
    smoothness: Tensor | None = None
