"""Rotations by quaternions, differentiable."""

import torch
from torch import Tensor

from lapgs_wgpu.splat.camera import rotation_rows


def rotation_matrices(quats: Tensor) -> Tensor:
    """Return the rotation matrices (N, 3, 3) of quaternions (N, 4) wxyz of any non-zero length."""
    rows = rotation_rows(*(quats / quats.norm(dim=-1, keepdim=True)).unbind(-1))
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def quat_multiply(first: Tensor, second: Tensor) -> Tensor:
    """Return products (N, 4) of quaternions wxyz (N, 4): the rotation `second`, followed by the rotation `first`."""
    w, axis = first[:, :1], first[:, 1:]
    v, other = second[:, :1], second[:, 1:]
    real = w * v - (axis * other).sum(dim=1, keepdim=True)
    return torch.cat([real, w * other + v * axis + torch.linalg.cross(axis, other)], dim=1)


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors (N, 3) by unit quaternions (N, 4) wxyz."""
    w, axis = quats[:, :1], quats[:, 1:]
    twice = 2.0 * torch.linalg.cross(axis, vectors)
    return vectors + w * twice + torch.linalg.cross(axis, twice)
