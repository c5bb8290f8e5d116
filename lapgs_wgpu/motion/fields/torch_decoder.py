"""The grid fields' decoder in torch: one function of features, its gradient written out.

motion/passes/decoder_passes is the same for kernels. Gaussians are decoded in blocks, each by one thread: torch shares
single operators among threads, which takes longer than it saves where they are short. Blocks, and with them the bits of
results, follow from the number of Gaussians and not from that of the threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

FEWEST = 1 << 9  # Gaussians from which on there is more than one block
LARGEST = 1 << 13  # Gaussians of a block
KEPT = 1 << 16  # Gaussians up to which activations are kept for the backward pass instead of computed again

Result = TypeVar("Result")


class DecoderWeights(NamedTuple):
    """Weights (outputs, inputs) and biases (outputs,) of the layers, float32. What a field lacks has size 0.

    spatial: of the gate, halved, which is exact; reads static features. temporal, dynamics: of what the gate
    multiplies; read temporal features and dynamics attributes. inner: of the motion, rectified; reads static features.
    heads: read the gated channels. motion_heads: read the motion's inner channels. heads_bias: of all heads.
    """

    spatial: Tensor
    spatial_bias: Tensor
    temporal: Tensor
    dynamics: Tensor
    temporal_bias: Tensor
    inner: Tensor
    inner_bias: Tensor
    heads: Tensor
    motion_heads: Tensor
    heads_bias: Tensor


def decode(static: Tensor, temporal: Tensor, dynamics: Tensor, weights: DecoderWeights) -> Tensor:
    """Return the outputs (N, outputs) of the heads: with the layers' outputs x (spatial), y (temporal) and z (inner),
    relu(y) (2 sigmoid(x) - 1) heads^T + relu(z) motion_heads^T + heads_bias (Grid4D; paper eqs. 6 and 9).

    static, temporal: (N, columns) features. dynamics: (N, D). All tensors have one dtype: float32, or float64 for a
    reference.
    """
    outputs: Tensor = _Decode.apply(static, temporal, dynamics, *weights)
    return outputs


class _Inputs(NamedTuple):
    static: Tensor
    temporal: Tensor
    dynamics: Tensor

    def rows(self, block: slice) -> _Inputs:
        return _Inputs(*(each[block] for each in self))


class _Activations(NamedTuple):
    """Activations of a block that the backward pass needs, (n, W) each; gated is the product of gate and moving."""

    gate: Tensor
    moving: Tensor
    gated: Tensor
    inner: Tensor


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, static: Tensor, temporal: Tensor, dynamics: Tensor, *given: Any) -> Tensor:
        weights, inputs = DecoderWeights(*given), _Inputs(static, temporal, dynamics)
        outputs = weights.heads.new_empty(len(static), len(weights.heads))
        keep = any(ctx.needs_input_grad) and len(static) <= KEPT

        def decode_block(block: slice) -> tuple[Tensor | None, ...]:
            activations, target = _activations(inputs.rows(block), weights), outputs[block]
            torch.addmm(weights.heads_bias, activations.gated, weights.heads.T, out=target)
            target.addmm_(activations.inner, weights.motion_heads.T)
            return activations if keep else (None,) * len(activations)

        kept = _each_block(decode_block, len(static))
        ctx.save_for_backward(static, temporal, dynamics, *given, *(each for block in kept for each in block))
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *d_results: Tensor) -> tuple[Tensor | None, ...]:
        saved, sizes = ctx.saved_tensors, (len(_Inputs._fields), len(DecoderWeights._fields))
        inputs, weights = _Inputs(*saved[: sizes[0]]), DecoderWeights(*saved[sizes[0] : sum(sizes)])
        d_inputs = _Inputs(*map(torch.empty_like, inputs))
        kept = zip(*[iter(saved[sum(sizes) :])] * len(_Activations._fields), strict=True)

        def differentiate_block(block: slice, own: tuple[Any, ...]) -> DecoderWeights:
            here = inputs.rows(block)
            activations = _activations(here, weights) if own[0] is None else _Activations(*own)
            return _backward(here, activations, d_results[0][block], weights, d_inputs.rows(block))

        parts = zip(*_each_block(differentiate_block, len(inputs.static), kept), strict=True)
        return (*d_inputs, *(sum(part[1:], part[0]) for part in parts))


def _activations(inputs: _Inputs, w: DecoderWeights) -> _Activations:
    # 2 sigmoid(x) - 1 = tanh(x / 2), by torch's sigmoid, which takes a tenth of the time of its tanh.
    gate = torch.addmm(w.spatial_bias, inputs.static, w.spatial.T).mul_(2).sigmoid_().mul_(2).sub_(1)
    moving = w.temporal_bias.repeat(len(gate), 1)
    moving.addmm_(inputs.temporal, w.temporal.T).addmm_(inputs.dynamics, w.dynamics.T).relu_()
    inner = torch.addmm(w.inner_bias, inputs.static, w.inner.T).relu_()
    return _Activations(gate, moving, moving * gate, inner)


def _backward(
    inputs: _Inputs, activations: _Activations, d: Tensor, w: DecoderWeights, d_inputs: _Inputs
) -> DecoderWeights:
    """Return the gradients of the weights, and write those of the inputs. d: of the outputs."""
    gate, moving, gated, inner = activations
    d_gated = d @ w.heads
    d_moving = torch.ops.aten.threshold_backward(d_gated * gate, moving, 0)
    d_gate = torch.ops.aten.tanh_backward(d_gated.mul_(moving), gate)
    torch.mm(d_gate, w.spatial, out=d_inputs.static)
    d_inner = torch.ops.aten.threshold_backward(d @ w.motion_heads, inner, 0)
    d_inputs.static.addmm_(d_inner, w.inner)
    torch.mm(d_moving, w.temporal, out=d_inputs.temporal)
    torch.mm(d_moving, w.dynamics, out=d_inputs.dynamics)
    return DecoderWeights(
        spatial=d_gate.T @ inputs.static,
        spatial_bias=d_gate.sum(0),
        temporal=d_moving.T @ inputs.temporal,
        dynamics=d_moving.T @ inputs.dynamics,
        temporal_bias=d_moving.sum(0),
        inner=d_inner.T @ inputs.static,
        inner_bias=d_inner.sum(0),
        heads=d.T @ gated,
        motion_heads=d.T @ inner,
        heads_bias=d.sum(0),
    )


def _each_block(function: Callable[..., Result], count: int, *values: Iterable[Any]) -> list[Result]:
    """Call a function of blocks, and of further values for each, in several threads. Blocks are of nearly equal size
    and of an even number, so that two threads end together."""
    blocks = 1 if count < FEWEST else 2 * -(-count // (2 * LARGEST))
    ends = [number * count // blocks for number in range(blocks + 1)]
    slices = [slice(*both) for both in pairwise(ends)]
    within = torch.no_grad()(function)  # threads record gradients unless told otherwise
    return list((map if blocks == 1 else _threads().map)(within, slices, *values))


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), "decoder", partial(torch.set_num_threads, 1))
