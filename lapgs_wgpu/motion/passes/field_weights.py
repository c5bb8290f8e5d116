"""The small layers of a grid field on the device: its weights in one array, and the heads at a time.

The second layer of the Laplacian motion, which only linear layers follow, is folded into the heads at each time; torch
does the same in motion/fields/grid_field.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.matmul import Matrix
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.motion.fields.config import APPEARANCE_SCALE, GEOMETRY, FieldConfig, static_grid, temporal_grids
from lapgs_wgpu.motion.fields.parameter_shapes import parameter_shapes

ALIGNED = 64  # floats; a multiple of 256 bytes, at which a binding may begin
_BIASES = 20  # floats of the heads' biases, as activate.wgsl binds them
# What one product or pass takes lies together.
_FIRST = [f"{name}.weight" for name in ("spatial", "motion.first", "heads", "appearance")]
_FIRST += [f"{name}.bias" for name in ("spatial", "motion.first", "temporal", "heads", "appearance")]
_LAST = "motion.frequencies"  # which has an optimizer of its own
_SPECTRUM = {"second": "motion.second.weight", "second_bias": "motion.second.bias"} | {
    name: f"motion.{name}" for name in ("alpha", "beta", "frequencies")
}

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


class FieldWeights:
    """The weights of a field that `decodes_on_device`, and the passes from them to the heads and back.

    width: channels of a layer. dynamics, static, temporal: columns of the layers' inputs; the first and the last may be
    0. outputs: of the heads. motion: whether there is the inner layer of the Laplacian motion. places: by name of each
    parameter but the tables its place in the array of weights. count: numbers of that array, the frequencies last.
    """

    def __init__(self, device: Device, config: FieldConfig) -> None:
        self.config, self._device, self._pool = config, device, BufferPool(device)
        self.width, self.dynamics, self.static = config.width, config.dynamics_size, static_grid(config).features
        self.temporal = sum(grid.features for grid in temporal_grids(config))
        self.outputs, self.motion = sum(GEOMETRY) + config.appearance_size, config.kind == "laplacian"
        shapes = {name: shape for name, shape in parameter_shapes(config).items() if not name.endswith(".table")}
        order = [*_FIRST, *(name for name in shapes if name not in (*_FIRST, _LAST)), _LAST]
        self.places: dict[str, Segment] = {}
        self.count = 0
        for name in (name for name in order if name in shapes):
            self.places[name] = Segment(self.count, shapes[name])
            self.count += math.prod(shapes[name])

    @property
    def placed(self) -> int:
        """Number of channels that depend on the static features; the heads read as many."""
        return self.width * (2 if self.motion else 1)

    @property
    def channels(self) -> int:
        """Number of channels of all layers: spatial, the motion's inner ones, temporal."""
        return self.placed + self.width

    def matrix(self, array: DeviceArray, name: str, rows: int, columns: int) -> Matrix:
        """A matrix that begins with a parameter, in the array of weights or of their gradients."""
        return Matrix(array, rows, columns, columns, self.places[name].first)

    def heads(self, name: str) -> Heads:
        """Arrays for heads, or for their gradients, by name."""
        first = -(-self.outputs * self.placed // ALIGNED) * ALIGNED
        buffer = self._pool.array(f"heads {name}", (first + _BIASES,)).buffer
        weights = DeviceArray(buffer, (self.outputs, self.placed))
        return Heads(weights, DeviceArray(buffer, (_BIASES,), offset=4 * first))

    def heads_at(self, commands: Commands, weights: DeviceArray, name: str, t: Time) -> Heads:
        """Record the heads at a time. name: distinguishes the times that are submitted together."""
        arrays = {"spectrum": self._spectrum(name, t), "weights": weights, "series": self._series(name)}
        if self.motion:
            commands.dispatch(Kernel.get(self._device, "spectrum"), -(-self.width // 64), **arrays)
        heads = self.heads(name)
        arrays |= {"heads": heads.weights, "biases": heads.biases}
        groups = -(-self.outputs * (self.placed + 1) // 64)
        commands.run(Kernel.get(self._device, "fold_motion", MOTION=self.motion), groups, arrays)
        return heads

    def heads_bwd(
        self, commands: Commands, weights: DeviceArray, d_weights: DeviceArray, d_heads: Heads, name: str, t: Time
    ) -> None:
        """Record that the gradients of heads that `heads_at` gave are added to those of the weights."""
        arrays = {"spectrum": self._spectrum(name, t), "weights": weights, "d_weights": d_weights}
        arrays |= {"series": self._series(name), "d_series": self._series("gradient")}
        arrays |= {"d_heads": d_heads.weights, "d_biases": d_heads.biases}
        fold = Kernel.get(self._device, "fold_motion_bwd", MOTION=self.motion)
        commands.run(fold, self.width, arrays)
        if self.motion:
            commands.run(Kernel.get(self._device, "spectrum_bwd"), self.config.components, arrays)

    def _series(self, name: str) -> DeviceArray:
        return self._pool.array(f"series {name}", (self.width,))

    def _spectrum(self, name: str, t: Time) -> DeviceArray:
        kernel, of = Kernel.get(self._device, "spectrum"), self.places
        given = {key: of[parameter].first if parameter in of else 0 for key, parameter in _SPECTRUM.items()}
        given |= {"width": self.width, "components": self.config.components, "columns": self.placed}
        given |= {"outputs": self.outputs, "heads": of["heads.weight"].first, "head_biases": of["heads.bias"].first}
        factors = {"unit": self.config.unit, "appearance": APPEARANCE_SCALE}
        return self._pool.varying(f"spectrum {name}", lambda: kernel.uniform("Spectrum", time=t(), **factors, **given))
