"""Encoder and decoder of the grid fields on the device (motion/passes), as one autograd function.

Features and their gradients stay on the device; only outputs and parameters are transferred.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from lapgs_wgpu.gpu.array import DeviceArray, read_all
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.motion.fields.hash_encoder import Encoded, HashEncoder, Place
from lapgs_wgpu.motion.passes.decoder_passes import DecoderPasses, DecoderShape
from lapgs_wgpu.splat.rasterize import upload


class Decoded(NamedTuple):
    """Results of a decoder.

    outputs: (N, outputs) of the heads, without their biases. sq_distances: for each group of grids, the sum of squared
    differences between the features of the compared places; empty without them.
    """

    outputs: Tensor
    sq_distances: Tensor


class Decoder:
    """Encodes Gaussians and decodes their features on one device.

    encoder: has one group of grids over space, or a second one over space and time.
    """

    def __init__(self, device: Device, encoder: HashEncoder, shape: DecoderShape, *, block: int | None = None) -> None:
        self.encoder, self.shape = encoder, shape
        self._device = device
        self._passes = DecoderPasses(device, shape, block=block)
        self._pool = BufferPool(device)

    def __call__(
        self,
        gaussians: Place,
        beside: Tensor,
        weights: Mapping[str, Tensor],
        compared: tuple[Place, Place] | None = None,
    ) -> Decoded:
        """Encode and decode Gaussians. Differentiable in `beside`, the weights and the encoder's tables. float32.

        gaussians: their means (N, 3) and a time. beside: (N, columns) further inputs of the decoder. weights: in the
        shapes of `DecoderShape.weights`. compared: two sets of equally many places whose features are compared.
        """
        places = [gaussians, *(compared or ())]
        tables = [grid.table for grid in self.encoder.grids]
        ordered = [weights[name] for name in self.shape.weights]
        return Decoded(*_Decode.apply(self, places, beside, len(ordered), *ordered, *tables))

    # The passes, without autograd ------------------------------------------------------------------------------------

    def write(
        self, places: Sequence[Place], beside: Tensor, weights: Sequence[Tensor], tables: Sequence[Tensor]
    ) -> _Written:
        """Upload the inputs of the forward pass."""
        encoded = self.encoder.write(places, tables)
        arrays = {"beside": upload(self._pool, "beside", beside)}
        inputs = dict(zip(self.shape.inputs, [arrays["beside"], *encoded.encodings[0]], strict=True))
        named = zip(self.shape.weights, weights, strict=True)
        return _Written(
            encoded, inputs, {name: upload(self._pool, f"weights {name}", weight) for name, weight in named}
        )

    def record(self, commands: Commands, written: _Written) -> list[DeviceArray]:
        """Record the forward pass. Returns the outputs and, for each group of grids, the sum of each compared pair."""
        encoded = written.encoded
        self.encoder.record(commands, encoded)
        outputs = self._pool.array("outputs", (encoded.points[0].count, self.shape.outputs))
        self._passes.decode(commands, written.inputs, written.weights, outputs)
        results = [outputs]
        for group, (here, there) in enumerate(written.compared):
            pairs = here.shape[0]
            sums = self._pool.array(f"sums {group}", (pairs,))
            commands.dispatch(
                Kernel.get(self._device, "smoothness"),
                -(-pairs // 64),
                smoothness=self._smoothness(group, pairs, 0.0),
                here=here,
                there=there,
                sums=sums,
            )
            results.append(sums)
        return results

    def record_bwd(
        self, commands: Commands, written: _Written, d_outputs: DeviceArray, d_sq_distances: Sequence[float]
    ) -> list[DeviceArray]:
        """Record the backward pass. Returns the gradients of `beside`, of the weights and of the tables.

        Features and tables on the device are overwritten by their gradients.
        """
        for group, (here, there) in enumerate(written.compared):
            pairs = here.shape[0]
            commands.dispatch(
                Kernel.get(self._device, "smoothness_bwd"),
                -(-pairs * self.encoder.features[group] // 64),
                smoothness=self._smoothness(group, pairs, 2 * d_sq_distances[group]),
                here=here,
                there=there,
            )
        d_weights = {name: self._pool.array(f"d weights {name}", size) for name, size in self.shape.weights.items()}
        self._passes.decode_bwd(commands, written.inputs, written.weights, d_outputs, d_weights)
        d_tables = self.encoder.record_gradient(commands, written.encoded)
        return [written.inputs["beside"], *d_weights.values(), *d_tables]

    def _smoothness(self, group: int, pairs: int, scale: float) -> DeviceArray:
        kernel = Kernel.get(self._device, "smoothness")
        content = kernel.uniform("Smoothness", pairs=pairs, features=self.encoder.features[group], scale=scale)
        return self._pool.constant(f"smoothness {group} {'back' if scale else 'forth'}", content)


class _Written(NamedTuple):
    """Inputs of a forward pass: encodings, and the decoder's inputs and weights by the names of DecoderShape."""

    encoded: Encoded
    inputs: dict[str, DeviceArray]
    weights: dict[str, DeviceArray]

    @property
    def compared(self) -> list[tuple[DeviceArray, DeviceArray]]:
        """For each group of grids, the encodings of the two compared sets of places."""
        here, there = self.encoded.encodings[1:] or ([], [])
        return list(zip(here, there, strict=True))


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, decoder: Decoder, places: list[Place], *arguments: Any) -> tuple[Tensor, Tensor]:
        beside, count, *tensors = arguments
        points = [points.detach() for points, _ in places]
        ctx.decoder, ctx.count, ctx.times = decoder, count, [time for _, time in places]
        ctx.save_for_backward(*points, beside, *tensors)
        ctx.written = decoder.write(places, beside, tensors[:count], tensors[count:])
        with Commands(decoder._device) as commands:
            results = decoder.record(commands, ctx.written)
        outputs, *sums = read_all(results)
        sq_distances = np.array([each.sum(dtype=np.float64) for each in sums], np.float32)
        return torch.from_numpy(outputs).to(beside.device), torch.from_numpy(sq_distances).to(beside.device)

    @staticmethod
    def backward(ctx: Any, *d_results: Tensor) -> tuple[Tensor | None, ...]:
        d_outputs, d_sq_distances = d_results
        decoder: Decoder = ctx.decoder
        sets = len(ctx.times)
        places = list(zip(ctx.saved_tensors[:sets], ctx.times, strict=True))
        beside, *tensors = ctx.saved_tensors[sets:]
        lost = not decoder.encoder.holds(ctx.written.encoded)  # something else was encoded in between
        if lost:
            ctx.written = decoder.write(places, beside, tensors[: ctx.count], tensors[ctx.count :])
        upstream = upload(decoder._pool, "d outputs", d_outputs)
        with Commands(decoder._device) as commands:
            if lost:
                decoder.record(commands, ctx.written)
            gradients = decoder.record_bwd(commands, ctx.written, upstream, d_sq_distances.tolist())
        d_beside, *d_tensors = (torch.from_numpy(array).to(beside.device) for array in read_all(gradients))
        return (None, None, d_beside, None, *d_tensors)
