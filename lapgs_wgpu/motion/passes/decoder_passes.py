"""The passes of the grid fields' decoder for training, without torch: from features to outputs of the heads, and back.

The decoder is that of motion/fields/grid_field without hidden layers, in matrices: layers = beside W_beside^T, to whose
channels of place static W_static^T is added, and to the temporal ones temporal W_temporal^T; features = gate(layers);
outputs = features W_heads^T. The layers' biases are the weights of a column of ones in `beside`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from ...gpu.buffer import Buffer, BufferPool
from ...gpu.device import Device
from ...gpu.kernel import Commands, Kernel
from ...gpu.matmul import Matmul, Matrix

_BLOCK = 1 << 14  # Gaussians that are decoded at once: layers and features of a block take 80 MB at a width of 256


@dataclass(frozen=True)
class DecoderShape:
    """width: channels of a layer. beside, static, temporal: columns of the inputs; temporal may be 0. motion: whether
    the inner layer of the Laplacian motion stands between the gate and the temporal layer."""

    width: int
    beside: int
    static: int
    temporal: int
    outputs: int
    motion: bool

    @property
    def placed(self) -> int:
        """Channels that depend on the static features; as many are read by the heads."""
        return self.width * (2 if self.motion else 1)

    @property
    def channels(self) -> int:
        """Of all layers."""
        return self.placed + self.width

    @property
    def inputs(self) -> dict[str, tuple[int, int, int]]:
        """Columns of each input, and the first and the number of the channels that depend on it."""
        inputs = {
            "beside": (self.beside, 0, self.channels),
            "static": (self.static, 0, self.placed),
            "temporal": (self.temporal, self.placed, self.width),
        }
        return {name: sizes for name, sizes in inputs.items() if sizes[0]}

    @property
    def weights(self) -> dict[str, tuple[int, int]]:
        """Shapes of the layers' weights, by input, and of the heads'."""
        shapes = {name: (channels, columns) for name, (columns, _, channels) in self.inputs.items()}
        return shapes | {"heads": (self.outputs, self.placed)}


class DecoderPasses:
    """Records the passes on one device. `inputs` are buffers of (N, columns) float32 by the names of
    `DecoderShape.inputs`, `weights` by those of `DecoderShape.weights`.

    block: how many Gaussians are decoded at once, a multiple of 64.
    """

    def __init__(self, device: Device, shape: DecoderShape, *, block: int | None = None) -> None:
        self.device, self.shape = device, shape
        self.pool = BufferPool(device)
        self._product = Matmul(device, self.pool)
        self._size = block or max(64, min(_BLOCK, device.max_binding // (4 * shape.channels) // 64 * 64))

    def decode(
        self, commands: Commands, n: int, inputs: Mapping[str, Buffer], weights: Mapping[str, Buffer], outputs: Buffer
    ) -> None:
        """outputs: (n, outputs) float32."""
        for first, count in self._blocks(n):
            _, features = self._activate(commands, first, count, inputs, weights)
            target = Matrix.block(outputs, self.shape.outputs, first, count)
            self._product(commands, f"outputs {first}", features, self._weights(weights, "heads").transpose, target)

    def decode_bwd(
        self,
        commands: Commands,
        n: int,
        inputs: Mapping[str, Buffer],
        weights: Mapping[str, Buffer],
        d_outputs: Buffer,
        d_weights: Mapping[str, Buffer],
    ) -> None:
        """Carry the gradient of the outputs back to the weights, and to the inputs, which become their gradients."""
        for first, count in self._blocks(n):
            layers, features = self._activate(commands, first, count, inputs, weights)
            d = Matrix.block(d_outputs, self.shape.outputs, first, count)
            self._product.long(commands, f"d heads {first}", d.transpose, features, d_weights["heads"], add=first > 0)
            self._product(commands, f"d features {first}", d, self._weights(weights, "heads"), features)
            self._gate("gate_bwd", commands, first, count, d_features=features.buffer, layers=layers.buffer)
            for name, (columns, channel, channels) in self.shape.inputs.items():
                given, own = Matrix.block(inputs[name], columns, first, count), layers.from_column(channel, channels)
                self._product.long(
                    commands, f"d weights {name} {first}", own.transpose, given, d_weights[name], add=first > 0
                )
                self._product(commands, f"d {name} {first}", own, self._weights(weights, name), given)

    def _blocks(self, n: int) -> Iterator[tuple[int, int]]:
        return ((first, min(self._size, n - first)) for first in range(0, n, self._size))

    def _weights(self, weights: Mapping[str, Buffer], name: str) -> Matrix:
        return Matrix.whole(weights[name], *self.shape.weights[name])

    def _activate(
        self,
        commands: Commands,
        first: int,
        count: int,
        inputs: Mapping[str, Buffer],
        weights: Mapping[str, Buffer],
    ) -> tuple[Matrix, Matrix]:
        """What the layers give for a block, and what the heads read."""
        shape = self.shape
        layers = Matrix.whole(self.pool.get("layers", 4 * count * shape.channels), count, shape.channels)
        features = Matrix.whole(self.pool.get("features", 4 * count * shape.placed), count, shape.placed)
        for number, (name, (columns, channel, channels)) in enumerate(shape.inputs.items()):
            given, own = Matrix.block(inputs[name], columns, first, count), layers.from_column(channel, channels)
            # The first input, beside the features, goes into all channels.
            self._product(
                commands, f"{name} {first}", given, self._weights(weights, name).transpose, own, add=number > 0
            )
        self._gate("gate", commands, first, count, layers=layers.buffer, features=features.buffer)
        return layers, features

    def _gate(self, name: str, commands: Commands, first: int, count: int, **buffers: Buffer) -> None:
        kernel = Kernel.get(self.device, name, **({"MOTION": 1} if self.shape.motion else {}))
        content = kernel.uniform("Gate", gaussians=count, width=self.shape.width)
        uniform = self.pool.constant(f"gate {first}", content)
        commands.dispatch(kernel, -(-count * self.shape.width // 64), gate=uniform, **buffers)
