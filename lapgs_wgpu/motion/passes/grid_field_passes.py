"""The grid fields for training on the device, without torch: from Gaussians and weights to the heads' outputs and back.

Everything stays in device arrays. Gradients are added to arrays that the caller has cleared.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from lapgs_wgpu.gpu.array import DeviceArray
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.pool import BufferPool
from lapgs_wgpu.motion.fields.config import FieldConfig, static_grid, temporal_grids
from lapgs_wgpu.motion.passes.decoder_passes import DecoderPasses, Decoding, Time
from lapgs_wgpu.motion.passes.hash_encoder_passes import HashEncoderPasses, PointSet
from lapgs_wgpu.motion.passes.samples import SamplePasses, Sampling


class FieldArrays(NamedTuple):
    """What a field computes with, or the gradients of it.

    geometry: (N, 12), as common/geometry.wgsl has it; its gradient is not the field's. beside: (N, D + 1) dynamics
    attributes, then ones. tables: (entries, 2) of each grid, the spatial one first. weights: of `DecoderPasses`.
    """

    geometry: DeviceArray
    beside: DeviceArray
    tables: list[DeviceArray]
    weights: DeviceArray


class GridFieldPasses:
    """Records the passes of a field that `decodes_on_device`."""

    def __init__(self, device: Device, config: FieldConfig) -> None:
        self.config = config
        self.decoder = DecoderPasses(device, config)
        self._pool = BufferPool(device)
        self._samples = SamplePasses(device, self._pool)
        self._encoders = [HashEncoderPasses(device, [static_grid(config)], config.bound)]
        if temporal := temporal_grids(config):
            self._encoders.append(HashEncoderPasses(device, temporal, config.bound, first_table=1))
        self._device = device

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
        inputs = dict(zip(("beside", "static", "temporal"), [beside, *encodings], strict=False))
        return self.decoder.decode(commands, arrays.weights, t, sampling, points, inputs)

    def decode_bwd(self, commands: Commands, decoding: Decoding, arrays: FieldArrays, gradients: FieldArrays) -> None:
        """Record the backward pass, from the outputs, which have become their gradient.

        The gradient of `beside` is written for all Gaussians, and added for samples.
        """
        d_beside = gradients.beside
        if decoding.sampling is not None:
            d_beside = self._pool.array("d_beside", decoding.inputs["beside"].shape)
        self.decoder.decode_bwd(commands, arrays.weights, decoding, d_beside, gradients.weights)
        if decoding.sampling is not None:
            number = decoding.points.number
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
        for group, (a, b, weight) in enumerate(zip(here, there, weights, strict=False)):
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
