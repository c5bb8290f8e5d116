"""Encoder and decoder of the grid fields on the device, as one autograd function.

Features and their gradients stay on the device; only outputs and parameters are exchanged. See motion/passes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...gpu.buffer import Buffer, BufferPool, Request, read_all
from ...gpu.device import Device
from ...gpu.kernel import Commands, Kernel
from ..passes.decoder_passes import DecoderPasses, DecoderShape
from .hash_encoder import HashEncoder, Place


class Decoded(NamedTuple):
    """outputs (N, outputs) of the heads, without their biases; apart: for each group of grids the sum of the squared
    differences between the features of the places that are compared, none where there are none."""

    outputs: Tensor
    apart: Tensor


class Decoder:
    """Encodes Gaussians and decodes their features on one device.

    encoder: of one group of grids, over place, or of two, the second over place and time.
    """

    def __init__(self, device: Device, encoder: HashEncoder, shape: DecoderShape, *, block: int | None = None) -> None:
        self.encoder, self.shape = encoder, shape
        self._device = device
        self._decoder = DecoderPasses(device, shape, block=block)
        self._pool = BufferPool(device)

    def __call__(
        self,
        gaussians: Place,
        beside: Tensor,
        weights: Mapping[str, Tensor],
        compared: tuple[Place, Place] | None = None,
    ) -> Decoded:
        """Decode the Gaussians at their means (N, 3) and a time, and what stands beside their features, (N, columns).

        weights: of the shapes `DecoderShape.weights`. compared: two sets of as many places whose features are compared.
        Differentiable in `beside`, the weights and the encoder's tables. float32.
        """
        places = [gaussians, *(compared or ())]
        tables = [grid.table for grid in self.encoder.grids]
        ordered = [weights[name] for name in self.shape.weights]
        return Decoded(*_Decode.apply(self, places, beside, len(ordered), *ordered, *tables))

    # The passes, without autograd ------------------------------------------------------------------------------------

    def write(
        self, places: Sequence[Place], beside: Tensor, weights: Sequence[Tensor], tables: Sequence[Tensor]
    ) -> None:
        """Bring all that the forward pass reads to the device."""
        self.encoder.write(places, tables)
        self._upload("beside", beside)
        for name, weight in zip(self.shape.weights, weights, strict=True):
            self._upload(f"weights {name}", weight)

    def record(self, commands: Commands, places: Sequence[Place]) -> list[Request]:
        """The forward pass: what to read to have the outputs and, for each group of grids, the sums of each pair."""
        self.encoder.record(commands, places)
        n = len(places[0][0])
        outputs = self._pool.get("outputs", 4 * n * self.shape.outputs)
        self._decoder.decode(commands, n, self._inputs(), self._weights(), outputs)
        requests: list[Request] = [(outputs, "float32", (n, self.shape.outputs), 0)]
        for group, (here, there) in enumerate(self._compared(places)):
            pairs = len(places[1][0])
            sums = self._pool.get(f"sums {group}", 4 * pairs)
            commands.dispatch(
                Kernel.get(self._device, "smoothness"),
                -(-pairs // 64),
                smoothness=self._smoothness(group, pairs, 0.0),
                here=here,
                there=there,
                sums=sums,
            )
            requests.append((sums, "float32", (pairs,), 0))
        return requests

    def record_bwd(self, commands: Commands, places: Sequence[Place], d_apart: Sequence[float]) -> list[Request]:
        """The backward pass, from the gradient of the outputs in its buffer: what to read to have the gradients of
        `beside`, of the weights and of the tables. Features and tables on the device become their gradients."""
        n, shape = len(places[0][0]), self.shape
        for group, (here, there) in enumerate(self._compared(places)):
            pairs = len(places[1][0])
            commands.dispatch(
                Kernel.get(self._device, "smoothness_bwd"),
                -(-pairs * self.encoder.features[group] // 64),
                smoothness=self._smoothness(group, pairs, 2 * d_apart[group]),
                here=here,
                there=there,
            )
        d_weights = {
            name: self._pool.get(f"d weights {name}", 4 * rows * columns)
            for name, (rows, columns) in shape.weights.items()
        }
        d_outputs = self._pool.get("d outputs", 0)
        self._decoder.decode_bwd(commands, n, self._inputs(), self._weights(), d_outputs, d_weights)
        requests: list[Request] = [(self._pool.get("beside", 0), "float32", (n, shape.beside), 0)]
        requests += [(d_weights[name], "float32", size, 0) for name, size in shape.weights.items()]
        return requests + self.encoder.record_gradient(commands, places)

    def _inputs(self) -> dict[str, Buffer]:
        return dict(zip(self.shape.inputs, [self._pool.get("beside", 0), *self.encoder.encodings(0)], strict=True))

    def _weights(self) -> dict[str, Buffer]:
        return {name: self._pool.get(f"weights {name}", 0) for name in self.shape.weights}

    def _compared(self, places: Sequence[Place]) -> list[tuple[Buffer, Buffer]]:
        """For each group of grids, the encodings of the two sets of places that are compared."""
        if len(places) == 1:
            return []
        return list(zip(self.encoder.encodings(1), self.encoder.encodings(2), strict=True))

    def _smoothness(self, group: int, pairs: int, scale: float) -> Buffer:
        kernel = Kernel.get(self._device, "smoothness")
        content = kernel.uniform("Smoothness", pairs=pairs, features=self.encoder.features[group], scale=scale)
        return self._pool.constant(f"smoothness {group} {'back' if scale else 'forth'}", content)

    def _upload(self, name: str, tensor: Tensor) -> None:
        array = tensor.detach().to("cpu", torch.float32).contiguous().numpy()
        self._pool.get(name, array.nbytes).write(array)


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, decoder: Decoder, places: list[Place], *arguments: Any) -> tuple[Tensor, Tensor]:
        beside, count, *tensors = arguments
        points = [points.detach() for points, _ in places]
        ctx.decoder, ctx.count, ctx.times = decoder, count, [time for _, time in places]
        ctx.save_for_backward(*points, beside, *tensors)
        decoder.write(places, beside, tensors[:count], tensors[count:])
        with Commands(decoder._device) as commands:
            requests = decoder.record(commands, places)
        ctx.written = decoder.encoder.written
        outputs, *sums = read_all(requests)
        apart = np.array([each.sum(dtype=np.float64) for each in sums], np.float32)
        return torch.from_numpy(outputs).to(beside.device), torch.from_numpy(apart).to(beside.device)

    @staticmethod
    def backward(ctx: Any, *d_results: Tensor) -> tuple[Tensor | None, ...]:
        d_outputs, d_apart = d_results
        decoder: Decoder = ctx.decoder
        sets = len(ctx.times)
        places = list(zip(ctx.saved_tensors[:sets], ctx.times, strict=True))
        beside, *tensors = ctx.saved_tensors[sets:]
        lost = decoder.encoder.written is not ctx.written  # something else was encoded in between
        if lost:
            decoder.write(places, beside, tensors[: ctx.count], tensors[ctx.count :])
        decoder._upload("d outputs", d_outputs)
        decoder.encoder.written = None  # features become gradients
        with Commands(decoder._device) as commands:
            if lost:
                decoder.record(commands, places)
            requests = decoder.record_bwd(commands, places, d_apart.tolist())
        found: list[NDArray[np.float32]] = read_all(requests)
        d_beside, *d_tensors = (torch.from_numpy(array).to(beside.device) for array in found)
        return (None, None, d_beside, None, *d_tensors)
