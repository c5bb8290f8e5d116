"""Device passes of the grid fields' decoder for training, forward and backward, without torch.

The decoder of motion/fields/grid_field, without hidden layers. Its weights lie in one array. The second layer of the
Laplacian motion, which only linear layers follow, is folded into the heads at each time, as torch does. The rest are
matrix products: spatial channels = static W_static^T; temporal channels = dynamics W_dynamics^T + temporal
W_temporal^T; features = gate(layers + biases); outputs = features W_heads^T.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.matmul import Matmul, Matrix
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.motion.fields.config import APPEARANCE_SCALE, GEOMETRY, FieldConfig, static_grid, temporal_grids
from lapgs_wgpu.motion.fields.parameter_shapes import parameter_shapes
from lapgs_wgpu.motion.passes.hash_encoder_passes import PointSet
from lapgs_wgpu.motion.passes.samples import Sampling

_BLOCK = 1 << 14  # Gaussians per block: its layers and features take 80 MB at a width of 256
ALIGNED = 64  # floats; a multiple of 256 bytes, at which a binding may begin
_BIASES = 20  # floats of the heads' biases, as activate.wgsl binds them
# What one product or pass takes lies together.
_FIRST = [f"{name}.weight" for name in ("spatial", "motion.first", "heads", "appearance")]
_FIRST += [f"{name}.bias" for name in ("spatial", "motion.first", "temporal", "heads", "appearance")]
_LAST = "motion.frequencies"  # which has an optimizer of its own

Time = Callable[[], float]  # gives that of the step that is taken, in [0, 1]


class Segment(NamedTuple):
    """A parameter among a field's weights: its first number and its shape."""

    first: int
    shape: tuple[int, ...]


class Heads(NamedTuple):
    """The heads at a time, or the gradient of them.

    weights: (outputs, features) of what the gate leaves and of the motion's inner layer. biases: (20,), of which as
    many count as there are outputs.
    """

    weights: DeviceArray
    biases: DeviceArray


class Decoding(NamedTuple):
    """Gaussians at a time that were decoded.

    time: gives that of the field, in [0, 1]. sampling: gives those of the Gaussians; None for all, in their order.
    points: of the encoder. inputs: of the decoder, by name: beside (count, D + 1) dynamics attributes, then ones;
    static and temporal (count, features), the latter where there is any; in the backward pass these two become their
    gradients. heads: at that time. outputs: (count, outputs) of the heads, without their biases; before the backward
    pass they become their gradient.
    """

    time: Time
    sampling: Sampling | None
    points: PointSet
    inputs: dict[str, DeviceArray]
    heads: Heads
    outputs: DeviceArray


class FieldWeights:
    """The weights of a field that `decodes_on_device`, and the passes from them to the heads and back.

    width: channels of a layer. dynamics, static, temporal: columns of the layers' inputs; the first and the last may be
    0. outputs: of the heads. motion: whether there is the inner layer of the Laplacian motion. placed: channels that
    depend on the static features; the heads read as many. channels: of all layers: spatial, the motion's inner ones,
    temporal. places: by name of each parameter but the tables its place in the array of weights. count: numbers of that
    array, the frequencies last.
    """

    def __init__(self, device: Device, config: FieldConfig) -> None:
        self.config, self._device, self._pool = config, device, BufferPool(device)
        self.width, self.dynamics, self.static = config.width, config.dynamics_size, static_grid(config).features
        self.temporal = sum(grid.features for grid in temporal_grids(config))
        self.outputs, self.motion = sum(GEOMETRY) + config.appearance_size, config.kind == "laplacian"
        self.placed = self.width * (2 if self.motion else 1)
        self.channels = self.placed + self.width
        shapes = {name: shape for name, shape in parameter_shapes(config).items() if not name.endswith(".table")}
        order = [*_FIRST, *(name for name in shapes if name not in (*_FIRST, _LAST)), _LAST]
        self.places: dict[str, Segment] = {}
        self.count = 0
        for name in (name for name in order if name in shapes):
            self.places[name] = Segment(self.count, shapes[name])
            self.count += math.prod(shapes[name])

    def heads(self, name: str) -> Heads:
        """Arrays for heads, or for their gradients, by name."""
        first = -(-self.outputs * self.placed // ALIGNED) * ALIGNED
        buffer = self._pool.array(f"heads {name}", (first + _BIASES,)).buffer
        weights = DeviceArray(buffer, (self.outputs, self.placed))
        return Heads(weights, DeviceArray(buffer, (_BIASES,), offset=4 * first))

    def heads_at(self, commands: Commands, weights: DeviceArray, number: int, t: Time) -> Heads:
        """Record the heads at a time. number: distinguishes the times that are submitted together."""
        arrays = {"spectrum": self._spectrum(number, t), "weights": weights, "series": self._series(number)}
        if self.motion:
            commands.dispatch(Kernel.get(self._device, "spectrum"), -(-self.width // 64), **arrays)
        heads = self.heads(f"at {number}")
        arrays |= {"heads": heads.weights, "biases": heads.biases}
        groups = -(-self.outputs * (self.placed + 1) // 64)
        commands.run(Kernel.get(self._device, "fold_motion", MOTION=self.motion), groups, arrays)
        return heads

    def heads_bwd(
        self, commands: Commands, weights: DeviceArray, d_weights: DeviceArray, d_heads: Heads, decoding: Decoding
    ) -> None:
        """Record that the gradients of a decoding's heads are added to those of the weights."""
        number = decoding.points.number
        arrays = {"spectrum": self._spectrum(number, decoding.time), "weights": weights, "d_weights": d_weights}
        arrays |= {"series": self._series(number), "d_series": self._series("gradient")}
        arrays |= {"d_heads": d_heads.weights, "d_biases": d_heads.biases}
        fold = Kernel.get(self._device, "fold_motion_bwd", MOTION=self.motion)
        commands.run(fold, self.width, arrays)
        if self.motion:
            commands.run(Kernel.get(self._device, "spectrum_bwd"), self.config.components, arrays)

    def _series(self, name: object) -> DeviceArray:
        return self._pool.array(f"series {name}", (self.width,))

    def _spectrum(self, number: int, t: Time) -> DeviceArray:
        kernel = Kernel.get(self._device, "spectrum")
        names = {key: f"motion.{key}" for key in ("alpha", "beta", "frequencies")}
        names |= {"second": "motion.second.weight", "second_bias": "motion.second.bias"}
        names |= {"heads": "heads.weight", "head_biases": "heads.bias"}
        absent = Segment(0, ())
        given: dict[str, float] = {key: self.places.get(name, absent).first for key, name in names.items()}
        given |= {"width": self.width, "components": self.config.components, "columns": self.placed}
        given |= {"outputs": self.outputs, "unit": self.config.unit, "appearance": APPEARANCE_SCALE}
        return self._pool.varying(f"spectrum {number}", lambda: kernel.uniform("Spectrum", time=t(), **given))


class _Product(NamedTuple):
    """An addend of the layers: the first `columns` columns of an input, times a matrix (channels, columns) of the
    weights, give `channels` channels from `channel` on. first, stride: of that matrix. add: not the first of these."""

    input: str
    columns: int
    channel: int
    channels: int
    first: int
    stride: int
    add: bool = False

    def weights(self, array: DeviceArray) -> Matrix:
        """The matrix in the array of weights, or its place in that of their gradients."""
        return Matrix(array, self.channels, self.columns, self.stride, self.first)

    def given(self, inputs: Mapping[str, DeviceArray], first: int, count: int) -> Matrix:
        """The input's columns in some rows."""
        return Matrix.of(inputs[self.input].rows(first, count)).from_column(0, self.columns)


class DecoderPasses:
    """Records the passes on one device, a block of Gaussians after another. weights: the array of `FieldWeights`."""

    def __init__(self, device: Device, layers: FieldWeights) -> None:
        self._device, self._of, self._pool = device, layers, BufferPool(device)
        self._product = Matmul(device, self._pool)
        self._block = max(64, min(_BLOCK, device.max_binding // (4 * layers.channels) // 64 * 64))
        placed, width, dynamics = layers.placed, layers.width, layers.dynamics
        (spatial, _), (temporal, (_, row)) = (layers.places[f"{name}.weight"] for name in ("spatial", "temporal"))
        products = [
            _Product("static", layers.static, 0, placed, spatial, layers.static),
            _Product("beside", dynamics, placed, width, temporal, row),
            _Product("temporal", layers.temporal, placed, width, temporal + dynamics, row, add=dynamics > 0),
        ]
        self._products = [each for each in products if each.columns]

    def decode(self, commands: Commands, weights: DeviceArray, decoding: Decoding) -> None:
        """Record the forward pass, which writes the outputs."""
        for first, count in self._blocks(decoding):
            _, features = self._activate(commands, first, count, decoding.inputs, weights)
            target = Matrix.of(decoding.outputs.rows(first, count))
            self._product(commands, features, Matrix.of(decoding.heads.weights).transpose, target)

    def decode_bwd(
        self,
        commands: Commands,
        weights: DeviceArray,
        decoding: Decoding,
        d_beside: DeviceArray,
        d_weights: DeviceArray,
    ) -> None:
        """Record the backward pass: d_beside is written, d_weights added to."""
        inputs, d_inputs = decoding.inputs, decoding.inputs | {"beside": d_beside}
        split, of = self._product.split_k, self._of
        d_heads = of.heads("gradient")
        for first, count in self._blocks(decoding):
            layers, features = self._activate(commands, first, count, inputs, weights)
            d, more = Matrix.of(decoding.outputs.rows(first, count)), first > 0
            ones = Matrix.of(inputs["beside"].rows(first, count)).from_column(of.dynamics, 1)
            split(commands, d.transpose, features, Matrix.of(d_heads.weights), add=more)
            split(commands, d.transpose, ones, Matrix(d_heads.biases, of.outputs, 1, 1), add=more)
            self._product(commands, d, Matrix.of(decoding.heads.weights), features)
            self._gate("gate_bwd", commands, count, weights, d_features=features.array, layers=layers.array)
            d_biases = Matrix(d_weights, of.channels, 1, 1, of.places["spatial.bias"].first)
            split(commands, layers.transpose, ones, d_biases, add=True)
            for each in self._products:
                own, given = layers.from_column(each.channel, each.channels), each.given(inputs, first, count)
                split(commands, own.transpose, given, each.weights(d_weights), add=True)
                self._product(commands, own, each.weights(weights), each.given(d_inputs, first, count))
        of.heads_bwd(commands, weights, d_weights, d_heads, decoding)

    def _blocks(self, decoding: Decoding) -> list[tuple[int, int]]:
        """First Gaussian and number of Gaussians of each block."""
        n = decoding.points.count
        return [(first, min(self._block, n - first)) for first in range(0, n, self._block)]

    def _activate(
        self, commands: Commands, first: int, count: int, inputs: Mapping[str, DeviceArray], weights: DeviceArray
    ) -> tuple[Matrix, Matrix]:
        """Return the outputs of the layers for a block, without biases, and the inputs of the heads."""
        layers = Matrix.of(self._pool.array("layers", (count, self._of.channels)))
        features = Matrix.of(self._pool.array("features", (count, self._of.placed)))
        if len(self._products) == 1:
            commands.clear(layers.array)  # the temporal channels have nothing but biases
        for each in self._products:
            own = layers.from_column(each.channel, each.channels)
            given, matrix = each.given(inputs, first, count), each.weights(weights).transpose
            self._product(commands, given, matrix, own, add=each.add)
        self._gate("gate", commands, count, weights, layers=layers.array, features=features.array)
        return layers, features

    def _gate(self, name: str, commands: Commands, count: int, weights: DeviceArray, **arrays: DeviceArray) -> None:
        kernel, width = Kernel.get(self._device, name, MOTION=self._of.motion), self._of.width
        biases = self._of.places["spatial.bias"].first
        uniform = self._pool.constant(kernel.uniform("Gate", gaussians=count, width=width, biases=biases))
        commands.dispatch(kernel, -(-count * width // 64), gate=uniform, weights=weights, **arrays)
