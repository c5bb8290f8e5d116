"""The small layers of a grid field on the device: its weights in one array, and packed as the decoder takes them.

The second layer of the Laplacian motion, which only linear layers follow, is folded into the heads at each time; torch
does the same in motion/fields/grid_field.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.motion.fields.config import GEOMETRY, FieldConfig
from lapgs_wgpu.motion.fields.parameter_shapes import parameter_shapes
from lapgs_wgpu.motion.passes.decoder_passes import DecoderShape, decoder_shape

_NONE = 0xFFFFFFFF  # pack_weights.wgsl
ALIGNED = 64  # floats; a multiple of 256 bytes, at which a binding may begin
_BIASES = 20  # floats of the heads' biases, as activate.wgsl binds them
_HEADS = sum(GEOMETRY)


Time = Callable[[], float]  # gives that of the step that is taken, in [0, 1]


class Segment(NamedTuple):
    """A matrix among packed weights: its first number and its shape."""

    first: int
    shape: tuple[int, ...]

    def of(self, packed: DeviceArray) -> DeviceArray:
        """This part of an array of packed weights."""
        return DeviceArray(packed.buffer, self.shape, packed.dtype, packed.offset + 4 * self.first)


class _Packing:
    """Where packed numbers come from, and times what."""

    def __init__(self) -> None:
        self.segments: dict[str, Segment] = {}
        self._parts: list[tuple[NDArray[np.uint32], NDArray[np.float32]]] = []
        self.count = 0

    def add(self, name: str, sources: NDArray[np.integer], factors: NDArray[np.floating] | float = 1.0) -> None:
        """A matrix of places among the weights, negative for zeros, and factors that broadcast to its shape."""
        size = -(-sources.size // ALIGNED) * ALIGNED
        places, scales = np.full(size, _NONE, np.uint32), np.zeros(size, np.float32)
        places[: sources.size] = np.where(sources < 0, _NONE, sources).reshape(-1)
        scales[: sources.size] = np.broadcast_to(factors, sources.shape).reshape(-1)
        self.segments[name] = Segment(self.count, sources.shape)
        self._parts.append((places, scales))
        self.count += size

    def upload(self, device: Device, name: str) -> None:
        places, scales = (np.concatenate(each) for each in zip(*self._parts, strict=True))
        self.sources = DeviceArray.upload(device, f"{name} sources", places)
        self.factors = DeviceArray.upload(device, f"{name} factors", scales)


class FieldWeights:
    """Records the passes between a field's weights and the decoder's.

    places: by name of each parameter but the tables its first number in the array of weights, and its shape. count:
    numbers of that array, the frequencies last. shape: of the decoder.
    """

    def __init__(self, device: Device, config: FieldConfig) -> None:
        self.config, self.shape = config, decoder_shape(config)
        self._device, self._pool = device, BufferPool(device)
        names = {name: size for name, size in parameter_shapes(config).items() if not name.endswith(".table")}
        last = "motion.frequencies"
        ordered = [*(name for name in names if name != last), *([last] if last in names else [])]
        self.places: dict[str, Segment] = {}
        self.count = 0
        for name in ordered:
            self.places[name] = Segment(self.count, names[name])
            self.count += math.prod(names[name])
        self._layers, self._heads = _Packing(), _Packing()
        self._pack_layers(self.shape)
        self._pack_heads(self.shape)
        self._layers.upload(device, "layers")
        self._heads.upload(device, "heads")

    def _of(self, name: str) -> NDArray[np.int64]:
        first, shape = self.places[name]
        return np.arange(first, first + math.prod(shape)).reshape(shape)

    def _pack_layers(self, shape: DecoderShape) -> None:
        size, width = self.config.dynamics_size, shape.width
        temporal = self._of("temporal.weight")
        beside = np.full((shape.channels, shape.beside), -1)
        factors = np.ones((shape.channels, 1))
        factors[:width] = 0.5
        static, halves = [self._of("spatial.weight")], [np.full((width, 1), 0.5)]
        beside[:width, -1] = self._of("spatial.bias")
        if shape.motion:
            static.append(self._of("motion.first.weight"))
            halves.append(np.ones((width, 1)))
            beside[width : 2 * width, -1] = self._of("motion.first.bias")
        beside[shape.placed :, :size] = temporal[:, :size]
        beside[shape.placed :, -1] = self._of("temporal.bias")
        self._layers.add("beside", beside, factors)
        self._layers.add("static", np.concatenate(static), np.concatenate(halves))
        if shape.temporal:
            self._layers.add("temporal", temporal[:, size:])

    def _pack_heads(self, shape: DecoderShape) -> None:
        weights, biases = [self._of("heads.weight")], [self._of("heads.bias")]
        if self.config.appearance_size:
            weights.append(self._of("appearance.weight"))
            biases.append(self._of("appearance.bias"))
        heads = np.full((shape.outputs, shape.placed), -1)
        heads[:, : shape.width] = np.concatenate(weights)
        padded = np.full((_BIASES, 1), -1)
        padded[: shape.outputs, 0] = np.concatenate(biases)
        factors = np.ones((_BIASES, 1))
        factors[: shape.outputs, 0] = self.config.head_factors
        self._heads.add("heads", heads, factors[: shape.outputs])
        self._heads.add("biases", padded, factors)

    def layers(self, name: str) -> DeviceArray:
        """An array for packed layers, or for their gradients, by name."""
        return self._pool.array(f"layers {name}", (self._layers.count,))

    def heads(self, name: str) -> DeviceArray:
        """An array for packed heads, or for their gradients, by name."""
        return self._pool.array(f"heads {name}", (self._heads.count,))

    def segments(self, layers: DeviceArray, heads: DeviceArray) -> dict[str, DeviceArray]:
        """The matrices of packed weights by the names of `DecoderShape.weights`, and the heads' "biases"."""
        of_layers = {name: segment.of(layers) for name, segment in self._layers.segments.items()}
        return of_layers | {name: segment.of(heads) for name, segment in self._heads.segments.items()}

    def gradient_segments(self, layers: DeviceArray, heads: DeviceArray) -> dict[str, DeviceArray]:
        """The same of gradients, as `DecoderPasses.decode_bwd` writes them: biases (outputs, 1)."""
        found = self.segments(layers, heads)
        biases = found["biases"]
        return found | {"biases": DeviceArray(biases.buffer, (self.shape.outputs, 1), "float32", biases.offset)}

    # Passes ----------------------------------------------------------------------------------------------------------

    def pack_layers(self, commands: Commands, weights: DeviceArray) -> DeviceArray:
        """Record the packing of the layers; the packed ones."""
        packed = self.layers("packed")
        self._pack(commands, self._layers, weights, packed)
        return packed

    def unpack_layers(self, commands: Commands, d_weights: DeviceArray, d_packed: DeviceArray) -> None:
        """Record that the gradients of packed layers are added to those of the weights."""
        self._pack(commands, self._layers, d_weights, d_packed, back=True)

    def pack_heads(self, commands: Commands, weights: DeviceArray, name: str, t: Time) -> DeviceArray:
        """Record the packing of the heads at a time, with the motion folded in; the packed ones.

        name: distinguishes the times that are submitted together.
        """
        packed = self.heads(name)
        self._pack(commands, self._heads, weights, packed)
        if self.shape.motion:
            series = self._pool.array(f"series {name}", (self.config.width,))
            spectrum = self._spectrum(name, t)
            commands.dispatch(
                Kernel.get(self._device, "spectrum"),
                -(-self.config.width // 64),
                spectrum=spectrum,
                weights=weights,
                series=series,
            )
            both = {name: segment.of(packed) for name, segment in self._heads.segments.items()}
            commands.dispatch(
                Kernel.get(self._device, "fold_motion"),
                -(-_HEADS * (self.config.width + 1) // 64),
                spectrum=spectrum,
                weights=weights,
                series=series,
                **both,
            )
        return packed

    def unpack_heads(
        self,
        commands: Commands,
        weights: DeviceArray,
        d_weights: DeviceArray,
        d_packed: DeviceArray,
        name: str,
        t: Time,
    ) -> None:
        """Record that the gradients of heads that `pack_heads` packed are added to those of the weights."""
        self._pack(commands, self._heads, d_weights, d_packed, back=True)
        if not self.shape.motion:
            return
        series = self._pool.array(f"series {name}", (self.config.width,))
        d_series = self._pool.array("d_series", (self.config.width,))
        arrays = {"spectrum": self._spectrum(name, t), "weights": weights, "d_weights": d_weights}
        both = {f"d_{name}": segment.of(d_packed) for name, segment in self._heads.segments.items()}
        fold = Kernel.get(self._device, "fold_motion_bwd")
        commands.dispatch(fold, self.config.width, **arrays, series=series, d_series=d_series, **both)
        back = Kernel.get(self._device, "spectrum_bwd")
        commands.dispatch(back, self.config.components, **arrays, d_series=d_series)

    def _spectrum(self, name: str, t: Time) -> DeviceArray:
        config, places = self.config, {key: self.places[of].first for key, of in _SPECTRUM.items()}
        sizes = {"width": config.width, "components": config.components, "columns": self.shape.placed}
        kernel = Kernel.get(self._device, "spectrum")
        return self._pool.varying(
            f"spectrum {name}", lambda: kernel.uniform("Spectrum", time=t(), unit=config.unit, **sizes, **places)
        )

    def _pack(
        self, commands: Commands, packing: _Packing, weights: DeviceArray, packed: DeviceArray, *, back: bool = False
    ) -> None:
        kernel = Kernel.get(self._device, "pack_weights", BACK=back)
        content = kernel.uniform("Packing", count=packing.count)
        commands.dispatch(
            kernel,
            -(-packing.count // 64),
            packing=self._pool.constant(f"packing {packing.count}", content),
            sources=packing.sources,
            factors=packing.factors,
            weights=weights,
            packed=packed,
        )


_SPECTRUM = {
    "alpha": "motion.alpha",
    "beta": "motion.beta",
    "frequencies": "motion.frequencies",
    "second": "motion.second.weight",
    "second_bias": "motion.second.bias",
    "heads": "heads.weight",
}
