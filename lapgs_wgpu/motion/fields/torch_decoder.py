"""The grid fields' decoder without hidden layers in torch: one function of features, its gradient written out.

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

from lapgs_wgpu.motion.fields.gate import opening

FEWEST = 1 << 9  # Gaussians from which on there is more than one block
LARGEST = 1 << 13  # Gaussians of a block
KEPT = 1 << 16  # Gaussians up to which activations are kept for the backward pass instead of computed again

Result = TypeVar("Result")


class DecoderWeights(NamedTuple):
    """Weights (outputs, inputs) and biases (outputs,) of the layers, float32; None: the field has no such layer.

    Attributes:
        spatial, spatial_bias: of the gate, halved (see `gated`); reads static features.
        temporal, dynamics, temporal_bias: of what the gate multiplies; reads temporal features and dynamics attributes.
        inner, inner_bias: of the motion, rectified; reads static features.
        heads: reads the gated channels.
        motion_heads: reads the motion's inner channels.
        heads_bias: of all heads.
    """

    spatial: Tensor
    spatial_bias: Tensor
    temporal: Tensor | None
    dynamics: Tensor | None
    temporal_bias: Tensor
    inner: Tensor | None
    inner_bias: Tensor | None
    heads: Tensor
    motion_heads: Tensor | None
    heads_bias: Tensor


def decode(static: Tensor, temporal: Tensor | None, dynamics: Tensor | None, weights: DecoderWeights) -> Tensor:
    """The outputs of the heads.

    Args:
        static: (N, columns) features, float32, or bfloat16, which is then the precision of all products but the heads'.
        temporal: (N, columns), as static; None without temporal grids.
        dynamics: (N, D) float32; None without.
        weights: of all layers. In float64, with features in float64, the result is a reference for float32.

    Returns:
        (N, outputs), of the weights' dtype.
    """
    outputs: Tensor = _Decode.apply(static, temporal, dynamics, *weights)
    return outputs


class _Inputs(NamedTuple):
    """As `decode` takes them, without what no layer reads; or their gradients."""

    static: Tensor
    temporal: Tensor | None
    dynamics: Tensor | None

    def each(self, function: Callable[[Tensor], Tensor]) -> _Inputs:
        temporal, dynamics = (None if each is None else function(each) for each in (self.temporal, self.dynamics))
        return _Inputs(function(self.static), temporal, dynamics)

    def rows(self, block: slice) -> _Inputs:
        return self.each(lambda each: each[block])


class _Activations(NamedTuple):
    """What the backward pass of a block needs, (n, W) each: gated is the product of gate and moving."""

    gate: Tensor
    moving: Tensor
    gated: Tensor
    inner: Tensor | None


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, static: Tensor, temporal: Tensor | None, dynamics: Tensor | None, *given: Any) -> Tensor:
        weights, inputs = DecoderWeights(*given), _Inputs(static, temporal, dynamics)
        w = _rounded(weights, static.dtype)
        outputs = weights.heads.new_empty(len(static), len(weights.heads))
        keep = any(ctx.needs_input_grad) and len(static) <= KEPT

        def decode_block(block: slice) -> tuple[Tensor | None, ...]:
            found, target = _activations(inputs.rows(block), w), outputs[block]
            torch.addmm(weights.heads_bias, found.gated.to(target.dtype), weights.heads.T, out=target)
            if found.inner is not None and weights.motion_heads is not None:
                target.addmm_(found.inner.to(target.dtype), weights.motion_heads.T)
            return found if keep else (None,) * len(found)

        kept = _each_block(decode_block, len(static))
        ctx.save_for_backward(static, temporal, dynamics, *given, *(each for block in kept for each in block))
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *d_results: Tensor) -> tuple[Tensor | None, ...]:
        saved, sizes = ctx.saved_tensors, (len(_Inputs._fields), len(DecoderWeights._fields))
        inputs, weights = _Inputs(*saved[: sizes[0]]), DecoderWeights(*saved[sizes[0] : sum(sizes)])
        w = _rounded(weights, inputs.static.dtype)
        d_inputs = inputs.each(torch.empty_like)
        kept = zip(*[iter(saved[sum(sizes) :])] * len(_Activations._fields), strict=True)

        def differentiate_block(block: slice, own: tuple[Any, ...]) -> DecoderWeights:
            here = inputs.rows(block)
            found = _activations(here, w) if own[0] is None else _Activations(*own)
            return _backward(here, found, d_results[0][block], weights, w, d_inputs.rows(block))

        parts = zip(*_each_block(differentiate_block, len(inputs.static), kept), strict=True)
        return (*d_inputs, *(None if part[0] is None else sum(part[1:], part[0]) for part in parts))


def _activations(inputs: _Inputs, w: DecoderWeights) -> _Activations:
    gate = opening(torch.addmm(w.spatial_bias, inputs.static, w.spatial.T))
    moving = w.temporal_bias.repeat(len(gate), 1)
    if inputs.temporal is not None and w.temporal is not None:
        moving.addmm_(inputs.temporal, w.temporal.T)
    if inputs.dynamics is not None and w.dynamics is not None:
        moving.addmm_(inputs.dynamics.to(moving.dtype), w.dynamics.T)
    moving.relu_()
    inner = None
    if w.inner is not None and w.inner_bias is not None:
        inner = torch.addmm(w.inner_bias, inputs.static, w.inner.T).relu_()
    return _Activations(gate, moving, moving * gate, inner)


def _backward(
    inputs: _Inputs,
    found: _Activations,
    d_outputs: Tensor,
    weights: DecoderWeights,
    w: DecoderWeights,
    d_inputs: _Inputs,
) -> DecoderWeights:
    """The gradients of the weights; writes those of the inputs."""
    dtype, exact = found.gate.dtype, weights.heads.dtype
    d = d_outputs.to(dtype)
    d_gated = d @ weights.heads.to(dtype)
    d_moving = torch.ops.aten.threshold_backward(d_gated * found.gate, found.moving, 0)
    d_gate = torch.ops.aten.tanh_backward(d_gated.mul_(found.moving), found.gate)
    torch.mm(d_gate, w.spatial, out=d_inputs.static)
    d_inner = None
    if found.inner is not None and w.inner is not None and weights.motion_heads is not None:
        d_inner = torch.ops.aten.threshold_backward(d @ weights.motion_heads.to(dtype), found.inner, 0)
        d_inputs.static.addmm_(d_inner, w.inner)
    if d_inputs.temporal is not None and w.temporal is not None:
        torch.mm(d_moving, w.temporal, out=d_inputs.temporal)
    if d_inputs.dynamics is not None and w.dynamics is not None:
        d_inputs.dynamics.copy_(d_moving @ w.dynamics)

    def weight(d_layer: Tensor, x: Tensor) -> Tensor:
        return (d_layer.T @ x.to(dtype)).to(exact)

    def bias(d_layer: Tensor) -> Tensor:
        return d_layer.sum(0).to(exact)

    return DecoderWeights(
        spatial=weight(d_gate, inputs.static),
        spatial_bias=bias(d_gate),
        temporal=None if inputs.temporal is None else weight(d_moving, inputs.temporal),
        dynamics=None if inputs.dynamics is None else weight(d_moving, inputs.dynamics),
        temporal_bias=bias(d_moving),
        inner=None if d_inner is None else weight(d_inner, inputs.static),
        inner_bias=None if d_inner is None else bias(d_inner),
        heads=weight(d, found.gated),
        motion_heads=None if found.inner is None else weight(d, found.inner),
        heads_bias=d_outputs.sum(0),
    )


def _rounded(weights: DecoderWeights, dtype: torch.dtype) -> DecoderWeights:
    """In the precision of the features, but for the heads: rounding errors of single features average out in their
    sums, but those of the sums would move Gaussians."""
    heads = {"heads", "motion_heads", "heads_bias"}
    given = {name: each for name, each in weights._asdict().items() if each is not None and name not in heads}
    return weights._replace(**{name: each.to(dtype) for name, each in given.items()})


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
