"""The grid fields' decoder in float64 by autograd: what torch's decoder and the kernels are tested against."""

import math

import torch
from helpers.encoder_reference import encode_reference
from torch import Tensor

from lapgs_wgpu.motion.fields.grid_field import GridField


def gated(temporal: Tensor, spatial: Tensor) -> Tensor:
    """Paper eq. 9 (Grid4D): what passes the gate, from the outputs of the temporal and the spatial layer."""
    return torch.relu(temporal) * (2 * torch.sigmoid(spatial) - 1)


def decode_reference(field: GridField, means: Tensor, dynamics: Tensor | None, t: float) -> tuple[Tensor, Tensor]:
    """From the tables to the heads (paper eqs. 2, 6, 8 and 9).

    means: (N, 3). dynamics: (N, D), where the field reads them. Returns the outputs of the geometry heads (N, 14), in
    world units where they are lengths, and of the appearance head (N, 0, 3 or 4).
    """
    config = field.config
    w = {name: value.detach().double() for name, value in field.named_parameters()}
    time = 0.5 * ((2 * t - 1) * config.time_scale + 1)
    static, *temporal = (encode_reference(g, g.table.detach().double(), means, time, config.bound) for g in field.grids)

    def layer(name: str, x: Tensor) -> Tensor:
        return x @ w[f"{name}.weight"].T + w[f"{name}.bias"]

    inputs = [dynamics.double(), *temporal] if config.dynamics_size and dynamics is not None else temporal
    fused = torch.cat(inputs, dim=1) if inputs else means.new_zeros(len(means), 1).double()
    features = gated(layer("temporal", fused), layer("spatial", static))
    hidden = features
    if config.kind == "laplacian":
        phase = 2 * math.pi * t * w["motion.frequencies"]
        series = phase.cos() @ w["motion.alpha"] + phase.sin() @ w["motion.beta"]
        hidden = features + series * layer("motion.second", torch.relu(layer("motion.first", static)))
    for i in range(config.depth):
        hidden = torch.relu(layer(f"hidden.{2 * i}", hidden))
    heads = layer("heads", hidden)
    heads[:, 4:7] *= config.unit
    heads[:, 11:] *= config.unit
    look = 0.1 * layer("appearance", features) if config.appearance_size else heads[:, :0]
    return heads, look
