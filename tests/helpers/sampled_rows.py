"""The rows and offsets of samples, as common/samples.wgsl draws them, in integers of the host."""

import numpy as np
import torch
from torch import Tensor

from lapgs_wgpu.motion.passes.samples import Samples

MASK = 0xFFFFFFFF


def scrambled(value: int) -> int:
    state = (value * 747796405 + 2891336453) & MASK
    word = (((state >> ((state >> 28) + 4)) ^ state) * 277803737) & MASK
    return (word >> 22) ^ word


def draw(samples: Samples, i: int, number: int) -> int:
    return scrambled(samples.seed ^ scrambled(4 * i + number))


def row(samples: Samples, i: int) -> int:
    low = (1 << samples.half_bits) - 1
    while True:
        for turn in range(4):
            i = ((i & low) << samples.half_bits) | ((i >> samples.half_bits) ^ (draw(samples, i & low, turn) & low))
        if i < samples.gaussians:
            return i


def rows(samples: Samples) -> Tensor:
    return torch.tensor([row(samples, i) for i in range(samples.count)])


def offsets(samples: Samples) -> Tensor:
    high = [[draw(samples, i, k) >> 8 for k in (1, 2, 3)] for i in range(samples.count)]
    return samples.reach * torch.from_numpy(np.array(high, np.float64) / 8388608.0 - 1.0).float()
