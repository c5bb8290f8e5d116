"""The hash encoder in torch: what its kernels are tested against."""

import torch
from torch import Tensor

from lapgs_wgpu.motion.fields.config import TIME
from lapgs_wgpu.motion.fields.hash_encoder import HashGrid


def encode_reference(grid: HashGrid, table: Tensor, points: Tensor, time: float, bound: float) -> Tensor:
    """Encode points (N, 3): (N, 2 x levels) in the table's precision; cells are found in float32, as on the device."""
    columns = [(points[:, axis] + bound) / (2 * bound) if axis != TIME else None for axis in grid.axes]
    unit = torch.stack([torch.full_like(points[:, 0], time) if c is None else c for c in columns], dim=1)
    inside = ((unit >= 0) & (unit <= 1)).all(dim=1)
    primes = (1, 2654435761, 805459861)
    encodings = []
    for level, rows in zip(grid.levels, table.split([level.entries for level in grid.levels]), strict=True):
        p = torch.where(inside[:, None], unit * torch.tensor(level.scale, dtype=unit.dtype), 0.0)
        low = p.floor()
        fraction = (p - low).to(table.dtype)
        up = fraction * fraction * (3 - 2 * fraction)
        base = low.long()
        total = table.new_zeros((len(points), 2))
        for corner in range(8):
            weight = inside.to(table.dtype)
            at = []
            for axis in range(3):
                high = (corner >> axis) & 1
                weight = weight * (up[:, axis] if high else 1 - up[:, axis])
                at.append((base[:, axis] + high).clamp(max=level.resolution[axis] - 1))
            x, y, z = at
            if level.dense:
                index = x + level.resolution[0] * (y + level.resolution[1] * z)
            else:
                hashed = [((a * prime) & 0xFFFFFFFF) for a, prime in zip(at, primes, strict=True)]
                index = (hashed[0] ^ hashed[1] ^ hashed[2]) % level.entries
            total = total + weight[:, None] * rows[index]
        encodings.append(total)
    return torch.cat(encodings, dim=1)
