"""The grid fields for training on the device, without torch: from Gaussians and weights to the heads' outputs and back.

Everything stays in device arrays. Gradients are added to arrays that the caller has cleared. The decoder is that of
motion/fields/grid_field, without hidden layers. Its weights lie in one array. The second layer of the Laplacian motion,
which only linear layers follow, is folded into the heads at each time, as torch does. The rest are matrix products:
spatial channels = static W_static^T; temporal channels = dynamics W_dynamics^T + temporal W_temporal^T; features =
gate(layers + biases); outputs = features W_heads^T.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.matmul import Matrix, multiply, multiply_long
from lapgs_wgpu.motion.fields.config import APPEARANCE_SCALE, GEOMETRY, FieldConfig, static_grid, temporal_grids
from lapgs_wgpu.motion.fields.parameter_shapes import parameter_shapes
from lapgs_wgpu.motion.passes.hash_encoder_passes import HashEncoderPasses, PointSet
from lapgs_wgpu.motion.passes.samples import SamplePasses, Sampling

_BLOCK = 1 << 14  # Gaussians per block: its layers and features take 80 MB at a width of 256
_BIASES = 20  # floats of the heads' biases, as activate.wgsl binds them
# What one product or pass takes lies together.
_FIRST = [f"{name}.weight" for name in ("spatial", "motion.first", "heads", "appearance")]
_FIRST += [f"{name}.bias" for name in ("spatial", "motion.first", "temporal", "heads", "appearance")]
_LAST = "motion.frequencies"  # which has an optimizer of its own

Time = Callable[[], float]  # gives that of the step that is taken, in [0, 1]


class FieldArrays(NamedTuple):
    """Gaussians and the field that moves them, or the gradients of both.

    geometry: (N, 12), as common/geometry.wgsl has it; its gradient is not the field's. sh: (N, 48). beside: (N, D + 1)
    dynamics attributes, then ones. tables: (entries, 2) of each grid, the spatial one first. weights: the parameters of
    `GridFieldPasses.places`.
    """

    geometry: DeviceArray
    sh: DeviceArray
    beside: DeviceArray
    tables: list[DeviceArray]
    weights: DeviceArray


class Decoding(NamedTuple):
    """Gaussians at a time that were decoded.

    time: gives that of the field, in [0, 1]. sampling: gives those of the Gaussians; None for all, in their order.
    points: of the encoder. inputs: of the decoder, by name: beside (count, D + 1) dynamics attributes, then ones;
    static and temporal (count, features); in the backward pass these two become their gradients. heads: (outputs,
    features) weights at that time, of what the gate leaves and of the motion's inner layer.
    biases: (20,) of the heads, of which as many count as there are outputs. outputs: (count, outputs) of the heads,
    without their biases; before the backward pass they become their gradient.
    """

    time: Time
    sampling: Sampling | None
    points: PointSet
    inputs: dict[str, DeviceArray]
    heads: DeviceArray
    biases: DeviceArray
    outputs: DeviceArray


class GridFieldPasses:
    """Records the passes of a field that `decodes_on_device`; the decoder's, a block of Gaussians after another.

    dynamics: columns of the attributes, which may be 0. places: by name of each parameter but the tables its first
    number in the array of weights, (count,), the frequencies last.
    """

    def __init__(self, device: Device, config: FieldConfig) -> None:
        self.config, self._device, self._pool = config, device, BufferPool(device)
        self._samples = SamplePasses(device, self._pool)
        grids = [static_grid(config)], temporal_grids(config)
        self._encoders = [
            HashEncoderPasses(device, group, config.bound, first_table=i) for i, group in enumerate(grids)
        ]
        self.dynamics, self._outputs = config.dynamics_size, sum(GEOMETRY) + config.appearance_size
        self._motion, width = config.kind == "laplacian", config.width
        # Channels of all layers: spatial, the motion's inner ones, temporal. The heads read as many as there are placed
        # ones, which depend on the static features.
        self._placed = placed = width * (2 if self._motion else 1)
        self._channels = placed + width
        shapes = {name: shape for name, shape in parameter_shapes(config).items() if not name.endswith(".table")}
        order = [*_FIRST, *(name for name in shapes if name not in (*_FIRST, _LAST)), _LAST]
        self.places: dict[str, int] = {}
        self.count = 0
        for name in (name for name in order if name in shapes):
            self.places[name] = self.count
            self.count += math.prod(shapes[name])
        self._block = max(64, min(_BLOCK, device.max_binding // (4 * self._channels) // 64 * 64))
        static, moving = (encoder.features for encoder in self._encoders)
        first, row, size = self.places["temporal.weight"], shapes["temporal.weight"][1], self.dynamics
        # What is added to the layers: the first columns of an input, from a channel on, times a matrix of the weights
        # (channels, columns); of it also the stride and the first number.
        products = [
            ("static", 0, (placed, static, static, self.places["spatial.weight"])),
            ("beside", placed, (width, size, row, first)),
            ("temporal", placed, (width, moving, row, first + size)),
        ]
        self._products = [(name, channel, place) for name, channel, place in products if place[1]]

    def decode(
        self, commands: Commands, number: int, arrays: FieldArrays, t: Time, sampling: Sampling | None = None
    ) -> Decoding:
        """Record the forward pass of all Gaussians, or of samples, at a time of the field.

        number: distinguishes the times that are submitted together; 1 and 2 are those that `compare` takes.
        """
        points = self._points(commands, number, sampling, arrays, t)
        encodings = self._encode(commands, points, arrays.tables)
        beside = arrays.beside
        if sampling is not None:
            beside = self._pool.array(f"beside {number}", (points.count, beside.shape[1]))
            self._samples.rows(commands, f"set {number}", sampling, arrays.beside, beside, back=False)
        inputs = dict(zip(("beside", "static", "temporal"), [beside, *encodings], strict=True))
        heads = self._pool.array(f"heads {number}", (self._outputs, self._placed))
        biases = self._pool.array(f"biases {number}", (_BIASES,))
        bound = self._bound(arrays.weights, t, number) | {"heads": heads, "biases": biases}
        if self._motion:
            commands.run(Kernel.get(self._device, "spectrum"), -(-self.config.width // 64), bound)
        fold = Kernel.get(self._device, "fold_motion", MOTION=self._motion)
        commands.run(fold, -(-self._outputs * (self._placed + 1) // 64), bound)
        outputs = self._pool.array(f"outputs {number}", (points.count, self._outputs))
        for first, count in self._blocks(points):
            _, features = self._activate(commands, first, count, inputs, arrays.weights)
            multiply(commands, self._pool, features, Matrix.of(heads).transpose, Matrix.of(outputs.rows(first, count)))
        return Decoding(t, sampling, points, inputs, heads, biases, outputs)

    def decode_bwd(self, commands: Commands, decoding: Decoding, arrays: FieldArrays, gradients: FieldArrays) -> None:
        """Record the backward pass, from the outputs, which have become their gradient.

        The gradient of `beside` is written for all Gaussians, and added for samples.
        """
        d_beside = gradients.beside
        if decoding.sampling is not None:
            d_beside = self._pool.array("d_beside", decoding.inputs["beside"].shape)
        inputs, d_inputs = decoding.inputs, decoding.inputs | {"beside": d_beside}
        weights, d_weights, number = arrays.weights, gradients.weights, decoding.points.number
        d_heads = self._pool.array("d_heads", decoding.heads.shape)
        d_biases = self._pool.array("d_biases", (_BIASES,))
        of_layers = Matrix(d_weights, self._channels, 1, 1, self.places["spatial.bias"])
        for first, count in self._blocks(decoding.points):
            layers, features = self._activate(commands, first, count, inputs, weights)
            d, more = Matrix.of(decoding.outputs.rows(first, count)), first > 0
            ones = Matrix.of(inputs["beside"].rows(first, count)).from_column(self.dynamics, 1)
            multiply_long(commands, self._pool, d.transpose, features, Matrix.of(d_heads), add=more)
            multiply_long(commands, self._pool, d.transpose, ones, Matrix(d_biases, self._outputs, 1, 1), add=more)
            multiply(commands, self._pool, d, Matrix.of(decoding.heads), features)
            self._gate("gate_bwd", commands, count, weights, d_features=features.array, layers=layers.array)
            multiply_long(commands, self._pool, layers.transpose, ones, of_layers, add=True)
            for name, channel, place in self._products:
                own, matrix = layers.from_column(channel, place[0]), Matrix(weights, *place)
                given, d_given = (_columns(each[name], first, count, matrix) for each in (inputs, d_inputs))
                multiply_long(commands, self._pool, own.transpose, given, Matrix(d_weights, *place), add=True)
                multiply(commands, self._pool, own, matrix, d_given)
        bound = self._bound(weights, decoding.time, number) | {"d_weights": d_weights}
        bound |= {"d_series": self._pool.array("d_series", (self.config.width,))}
        bound |= {"d_heads": d_heads, "d_biases": d_biases}
        commands.run(Kernel.get(self._device, "fold_motion_bwd", MOTION=self._motion), self.config.width, bound)
        if self._motion:
            commands.run(Kernel.get(self._device, "spectrum_bwd"), self.config.components, bound)
        if decoding.sampling is not None:
            self._samples.rows(commands, f"set {number}", decoding.sampling, gradients.beside, d_beside, back=True)
        encodings = [array for name, array in decoding.inputs.items() if name != "beside"]
        self._encode_bwd(commands, decoding.points, encodings, gradients.tables)

    def compare(
        self,
        commands: Commands,
        arrays: FieldArrays,
        gradients: FieldArrays,
        near: Sampling,
        times: tuple[Time, Time],
        weights: Sequence[float],
    ) -> list[DeviceArray]:
        """Record the squared differences (count,) between the features of samples at a time and of places near them at
        another time, for each group of grids; and the gradient of their weighted sums.

        times: give both. weights: of the sum of each group.
        """
        means = self._points(commands, 1, lambda: replace(near(), reach=0.0), arrays, times[0])
        places = self._points(commands, 2, near, arrays, times[1])
        here, there = (self._encode(commands, points, arrays.tables) for points in (means, places))
        forth, back = Kernel.get(self._device, "smoothness"), Kernel.get(self._device, "smoothness_bwd")
        sums = []
        for group, (a, b, weight) in enumerate(zip(here, there, weights, strict=True)):
            (count, features), total = a.shape, self._pool.array(f"differences {group}", (means.count,))
            content = forth.uniform("Smoothness", pairs=count, features=features, scale=2 * weight)
            both = {"smoothness": self._pool.constant(content), "here": a, "there": b}
            commands.dispatch(forth, -(-count // 64), sums=total, **both)
            commands.dispatch(back, -(-a.size // 64), **both)
            sums.append(total)
        for points, d_encodings in ((means, here), (places, there)):
            self._encode_bwd(commands, points, d_encodings, gradients.tables)
        return sums

    def _points(
        self, commands: Commands, number: int, sampling: Sampling | None, arrays: FieldArrays, t: Time
    ) -> PointSet:
        array = self._samples.places(commands, f"set {number}", sampling, arrays.geometry)
        return PointSet(number, array, array.shape[0], lambda: self.config.grid_time(t()))

    def _encode(self, commands: Commands, points: PointSet, tables: list[DeviceArray]) -> list[DeviceArray]:
        found = []
        for number, encoder in enumerate(self._encoders):
            encoding = self._pool.array(f"encoding {points.number} {number}", (points.count, encoder.features))
            encoder.encode(commands, points, tables, encoding)
            found.append(encoding)
        return found

    def _encode_bwd(
        self, commands: Commands, points: PointSet, d_encodings: list[DeviceArray], d_tables: list[DeviceArray]
    ) -> None:
        for encoder, d_encoding in zip(self._encoders, d_encodings, strict=True):
            encoder.add_gradient(commands, points, d_encoding, d_tables)

    def _bound(self, weights: DeviceArray, time: Time, number: int) -> dict[str, DeviceArray]:
        """What the passes between weights and heads bind. number: of the points."""
        kernel = Kernel.get(self._device, "spectrum")
        names = {key: f"motion.{key}" for key in ("alpha", "beta", "frequencies")}
        names |= {"second": "motion.second.weight", "second_bias": "motion.second.bias"}
        names |= {"heads": "heads.weight", "head_biases": "heads.bias"}
        given: dict[str, float] = {key: self.places.get(name, 0) for key, name in names.items()}
        given |= {"width": self.config.width, "components": self.config.components, "columns": self._placed}
        given |= {"outputs": self._outputs, "unit": self.config.unit, "appearance": APPEARANCE_SCALE}
        spectrum = self._pool.varying(f"spectrum {number}", lambda: kernel.uniform("Spectrum", time=time(), **given))
        series = self._pool.array(f"series {number}", (self.config.width,))
        return {"spectrum": spectrum, "weights": weights, "series": series}

    def _blocks(self, points: PointSet) -> list[tuple[int, int]]:
        """First Gaussian and number of Gaussians of each block."""
        return [(first, min(self._block, points.count - first)) for first in range(0, points.count, self._block)]

    def _activate(
        self, commands: Commands, first: int, count: int, inputs: Mapping[str, DeviceArray], weights: DeviceArray
    ) -> tuple[Matrix, Matrix]:
        """Return the outputs of the layers for a block, without biases, and the inputs of the heads."""
        layers = Matrix.of(self._pool.array("layers", (count, self._channels)))
        features = Matrix.of(self._pool.array("features", (count, self._placed)))
        if len(self._products) == 1:
            commands.clear(layers.array)  # the temporal channels have nothing but biases
        for name, channel, place in self._products:
            own, matrix = layers.from_column(channel, place[0]), Matrix(weights, *place)
            given, more = _columns(inputs[name], first, count, matrix), name == "temporal" and self.dynamics > 0
            multiply(commands, self._pool, given, matrix.transpose, own, add=more)
        self._gate("gate", commands, count, weights, layers=layers.array, features=features.array)
        return layers, features

    def _gate(self, name: str, commands: Commands, count: int, weights: DeviceArray, **arrays: DeviceArray) -> None:
        kernel, width = Kernel.get(self._device, name, MOTION=self._motion), self.config.width
        biases = self.places["spatial.bias"]
        uniform = self._pool.constant(kernel.uniform("Gate", gaussians=count, width=width, biases=biases))
        commands.dispatch(kernel, -(-count * width // 64), gate=uniform, weights=weights, **arrays)


def _columns(array: DeviceArray, first: int, count: int, matrix: Matrix) -> Matrix:
    """Of some rows of an input the columns that a matrix of the weights takes."""
    return Matrix.of(array.rows(first, count)).from_column(0, matrix.columns)
