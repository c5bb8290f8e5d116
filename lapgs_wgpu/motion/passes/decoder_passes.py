"""Device passes of the grid fields' decoder for training, forward and backward, without torch.

The decoder of motion/fields/grid_field, without hidden layers, as matrix products: layers = beside W_beside^T; static
W_static^T is added to the spatial channels, temporal W_temporal^T to the temporal ones; features = gate(layers);
outputs = features W_heads^T. The layers' biases are the weights of a column of ones in `beside`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.matmul import Matmul, Matrix
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.motion.fields.config import GEOMETRY, FieldConfig, static_grid, temporal_grids

_BLOCK = 1 << 14  # Gaussians per block: its layers and features take 80 MB at a width of 256


@dataclass(frozen=True)
class DecoderShape:
    """Sizes of a decoder.

    width: channels of a layer. beside, static, temporal: columns of the inputs; temporal may be 0. motion: whether the
    decoder includes the inner layer of the Laplacian motion.
    """

    width: int
    beside: int
    static: int
    temporal: int
    outputs: int
    motion: bool

    @property
    def placed(self) -> int:
        """Number of channels that depend on the static features; the heads read as many."""
        return self.width * (2 if self.motion else 1)

    @property
    def channels(self) -> int:
        """Number of channels of all layers."""
        return self.placed + self.width

    @property
    def inputs(self) -> dict[str, tuple[int, int, int]]:
        """For each input: its columns, and the first and the number of the channels that depend on it."""
        inputs = {
            "beside": (self.beside, 0, self.channels),
            "static": (self.static, 0, self.placed),
            "temporal": (self.temporal, self.placed, self.width),
        }
        return {name: sizes for name, sizes in inputs.items() if sizes[0]}

    @property
    def weights(self) -> dict[str, tuple[int, int]]:
        """Shapes of the layers' weights, by input, and of the heads' weights."""
        shapes = {name: (channels, columns) for name, (columns, _, channels) in self.inputs.items()}
        return shapes | {"heads": (self.outputs, self.placed)}


def decoder_shape(config: FieldConfig) -> DecoderShape:
    """Return the decoder of a field that `decodes_on_device`."""
    return DecoderShape(
        width=config.width,
        beside=config.dynamics_size + 1,
        static=static_grid(config).features,
        temporal=sum(grid.features for grid in temporal_grids(config)),
        outputs=sum(GEOMETRY) + config.appearance_size,
        motion=config.kind == "laplacian",
    )


class DecoderPasses:
    """Records the passes on one device.

    inputs: (N, columns) float32, by the names of `DecoderShape.inputs`. weights: as `DecoderShape.weights`.
    block: number of Gaussians per block, a multiple of 64.
    """

    def __init__(self, device: Device, shape: DecoderShape, *, block: int | None = None) -> None:
        self.device, self.shape = device, shape
        self.pool = BufferPool(device)
        self._product = Matmul(device, self.pool)
        self._size = block or max(64, min(_BLOCK, device.max_binding // (4 * shape.channels) // 64 * 64))

    def decode(
        self,
        commands: Commands,
        inputs: Mapping[str, DeviceArray],
        weights: Mapping[str, DeviceArray],
        outputs: DeviceArray,
    ) -> None:
        """Record the forward pass. outputs: (N, outputs) float32."""
        for first, count in self._blocks(outputs):
            _, features = self._activate(commands, first, count, inputs, weights)
            target = Matrix.of(outputs.rows(first, count))
            self._product(commands, f"outputs {first}", features, Matrix.of(weights["heads"]).transpose, target)

    def decode_bwd(
        self,
        commands: Commands,
        inputs: Mapping[str, DeviceArray],
        weights: Mapping[str, DeviceArray],
        d_outputs: DeviceArray,
        d_inputs: Mapping[str, DeviceArray],
        d_weights: Mapping[str, DeviceArray],
        *,
        add: bool = False,
    ) -> None:
        """Record the backward pass to d_inputs, which may be the inputs' own arrays, and to d_weights.

        d_weights: as `DecoderShape.weights`, and "biases" (outputs, 1) of the heads. add: to what the layers' gradients
        hold, those of the heads excepted.
        """
        for first, count in self._blocks(d_outputs):
            layers, features = self._activate(commands, first, count, inputs, weights)
            d, more = Matrix.of(d_outputs.rows(first, count)), first > 0
            ones = Matrix.of(inputs["beside"].rows(first, count)).from_column(self.shape.beside - 1, 1)
            split = self._product.split_k
            split(commands, f"d heads {first}", d.transpose, features, d_weights["heads"], add=more)
            split(commands, f"d biases {first}", d.transpose, ones, d_weights["biases"], add=more)
            self._product(commands, f"d features {first}", d, Matrix.of(weights["heads"]), features)
            self._gate("gate_bwd", commands, first, count, d_features=features.array, layers=layers.array)
            for name, (_, channel, channels) in self.shape.inputs.items():
                given, own = Matrix.of(inputs[name].rows(first, count)), layers.from_column(channel, channels)
                target = Matrix.of(d_inputs[name].rows(first, count))
                name_of_sum = f"d weights {name} {first}"
                split(commands, name_of_sum, own.transpose, given, d_weights[name], add=add or more)
                self._product(commands, f"d {name} {first}", own, Matrix.of(weights[name]), target)

    def _blocks(self, outputs: DeviceArray) -> Iterator[tuple[int, int]]:
        n = outputs.shape[0]
        return ((first, min(self._size, n - first)) for first in range(0, n, self._size))

    def _activate(
        self,
        commands: Commands,
        first: int,
        count: int,
        inputs: Mapping[str, DeviceArray],
        weights: Mapping[str, DeviceArray],
    ) -> tuple[Matrix, Matrix]:
        """Return the outputs of the layers for a block, and the inputs of the heads."""
        shape = self.shape
        layers = Matrix.of(self.pool.array("layers", (count, shape.channels)))
        features = Matrix.of(self.pool.array("features", (count, shape.placed)))
        for number, (name, (_, channel, channels)) in enumerate(shape.inputs.items()):
            given, own = Matrix.of(inputs[name].rows(first, count)), layers.from_column(channel, channels)
            # The first input, `beside`, contributes to all channels.
            self._product(commands, f"{name} {first}", given, Matrix.of(weights[name]).transpose, own, add=number > 0)
        self._gate("gate", commands, first, count, layers=layers.array, features=features.array)
        return layers, features

    def _gate(self, name: str, commands: Commands, first: int, count: int, **arrays: DeviceArray) -> None:
        kernel = Kernel.get(self.device, name, MOTION=self.shape.motion)
        content = kernel.uniform("Gate", gaussians=count, width=self.shape.width)
        uniform = self.pool.constant(f"gate {first}", content)
        commands.dispatch(kernel, -(-count * self.shape.width // 64), gate=uniform, **arrays)
