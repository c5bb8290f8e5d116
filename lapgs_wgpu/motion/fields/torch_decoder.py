"""The grid fields' decoder in torch: one function of features, its gradient written out.

motion/passes/grid_field_passes is the same for kernels. Gaussians are decoded in blocks, each by one thread: torch
shares single operators among threads, which takes longer than it saves where they are short. Blocks, and with them the
bits of results, follow from the number of Gaussians and not from that of the threads.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

FEWEST = 1 << 9  # Gaussians from which on there is more than one block
LARGEST = 1 << 13  # Gaussians of a block
KEPT = 1 << 16  # Gaussians up to which activations are kept for the backward pass instead of computed again

_INPUTS = 3  # static, temporal, dynamics

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


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *given: Tensor) -> Tensor:
        inputs, weights = given[:_INPUTS], DecoderWeights(*given[_INPUTS:])
        outputs = weights.heads.new_empty(len(inputs[0]), len(weights.heads))
        keep = any(ctx.needs_input_grad) and len(outputs) <= KEPT

        def decode_block(block: slice, _: int) -> Sequence[Tensor]:
            activations = _activate([each[block] for each in inputs], weights)
            gated, inner = activations[2:]
            torch.addmm(weights.heads_bias, gated, weights.heads.T, out=outputs[block])
            outputs[block].addmm_(inner, weights.motion_heads.T)
            return activations if keep else ()

        kept = _each_block(decode_block, len(outputs))
        ctx.save_for_backward(*given, *(each for block in kept for each in block))
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *d_results: Tensor) -> tuple[Tensor | None, ...]:
        saved, end = ctx.saved_tensors, _INPUTS + len(DecoderWeights._fields)
        inputs, weights, kept = saved[:_INPUTS], DecoderWeights(*saved[_INPUTS:end]), saved[end:]
        d_inputs = [torch.empty_like(each) for each in inputs]

        def differentiate_block(block: slice, number: int) -> DecoderWeights:
            here, d_here = ([each[block] for each in whole] for whole in (inputs, d_inputs))
            activations = kept[4 * number : 4 * number + 4] or _activate(here, weights)
            return _backward(here, activations, d_results[0][block], weights, d_here)

        parts = zip(*_each_block(differentiate_block, len(inputs[0])), strict=True)
        return (*d_inputs, *(sum(part[1:], part[0]) for part in parts))


def _activate(inputs: Sequence[Tensor], w: DecoderWeights) -> Sequence[Tensor]:
    """Return the activations (n, W) of a block that the backward pass needs: the gate, what it multiplies, their
    product, and the motion's inner channels."""
    static, temporal, dynamics = inputs
    # 2 sigmoid(x) - 1 = tanh(x / 2), by torch's sigmoid, which takes a tenth of the time of its tanh.
    gate = torch.addmm(w.spatial_bias, static, w.spatial.T).mul_(2).sigmoid_().mul_(2).sub_(1)
    moving = w.temporal_bias.repeat(len(gate), 1)
    moving.addmm_(temporal, w.temporal.T).addmm_(dynamics, w.dynamics.T).relu_()
    inner = torch.addmm(w.inner_bias, static, w.inner.T).relu_()
    return gate, moving, moving * gate, inner


def _backward(
    inputs: Sequence[Tensor], activations: Sequence[Tensor], d: Tensor, w: DecoderWeights, d_inputs: Sequence[Tensor]
) -> DecoderWeights:
    """Return the gradients of the weights, and write those of the inputs. d: of the outputs."""
    (static, temporal, dynamics), (d_static, d_temporal, d_dynamics) = inputs, d_inputs
    gate, moving, gated, inner = activations
    d_gated = d @ w.heads
    d_moving = torch.ops.aten.threshold_backward(d_gated * gate, moving, 0)
    d_gate = torch.ops.aten.tanh_backward(d_gated.mul_(moving), gate)
    torch.mm(d_gate, w.spatial, out=d_static)
    d_inner = torch.ops.aten.threshold_backward(d @ w.motion_heads, inner, 0)
    d_static.addmm_(d_inner, w.inner)
    torch.mm(d_moving, w.temporal, out=d_temporal)
    torch.mm(d_moving, w.dynamics, out=d_dynamics)
    return DecoderWeights(
        spatial=d_gate.T @ static,
        spatial_bias=d_gate.sum(0),
        temporal=d_moving.T @ temporal,
        dynamics=d_moving.T @ dynamics,
        temporal_bias=d_moving.sum(0),
        inner=d_inner.T @ static,
        inner_bias=d_inner.sum(0),
        heads=d.T @ gated,
        motion_heads=d.T @ inner,
        heads_bias=d.sum(0),
    )


def _each_block(function: Callable[[slice, int], Result], count: int) -> list[Result]:
    """Call a function of blocks and their numbers, in several threads. Blocks are of nearly equal size and of an even
    number, so that two threads end together."""
    blocks = 1 if count < FEWEST else 2 * -(-count // (2 * LARGEST))
    ends = [number * count // blocks for number in range(blocks + 1)]
    slices = [slice(*both) for both in pairwise(ends)]
    within = torch.no_grad()(function)  # threads record gradients unless told otherwise
    return list((map if blocks == 1 else _threads().map)(within, slices, range(blocks)))


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(os.cpu_count(), "decoder", partial(torch.set_num_threads, 1))
