"""The passes that draw an image from Gaussians, and those that carry its gradient back, on buffers of a device.

See docs/architecture.md for the order of the passes. Nothing here waits for the device except `Rasterizer.grow` and,
once a pass, `Rasterizer._subgroup_mismatch`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DeviceMemoryError
from ..gpu.buffer import Buffer, BufferPool, Request, read_all
from ..gpu.device import Device
from ..gpu.kernel import Commands, Kernel
from ..gpu.radix_sort import RadixSort
from ..gpu.scan import Scan
from .camera import Camera
from .raster_config import MOST_TILES, RasterConfig, raster_config

SPLAT_FLOATS = 12  # common/splat.wgsl
_RECORD_BYTES = 32  # rasterize_bwd.wgsl
_DEPTH_BITS = 32
_LANES = 64  # workgroup size of the passes over Gaussians and intersections


def _groups(count: int) -> int:
    return -(-count // _LANES)


@dataclass(frozen=True)
class GaussianBuffers:
    """The inputs of an image on the device, all float32 and activated.

    means (N, 3), quats (N, 4) wxyz, scales (N, 3), opacities (N,), colors (N, 3), or (N, sh_stored, 3) with sh_degree.
    """

    count: int
    means: Buffer
    quats: Buffer
    scales: Buffer
    opacities: Buffer
    colors: Buffer
    sh_degree: int | None
    sh_stored: int


@dataclass(frozen=True)
class GradientBuffers:
    """Gradients on the device, shaped as the inputs; d_splats (N, 12) is laid out as common/splat.wgsl says."""

    means: Buffer
    quats: Buffer
    scales: Buffer
    colors: Buffer | None
    splats: Buffer


class Rasterizer:
    """Draws images on one device; keeps its buffers from image to image.

    capacity: how many intersections (tile, splat) the buffers hold; it grows by `grow` and never changes a result.
    """

    def __init__(self, device: Device, *, config: RasterConfig | None = None, capacity: int = 1 << 16) -> None:
        self.device = device
        self.config = config or raster_config(device)
        self.pool = BufferPool(device)
        self.capacity = capacity
        self.bands = 1
        self.rounds = 1  # in which the lists of tiles are drawn, where the shape limits a round
        self.max_capacity = device.max_binding // _RECORD_BYTES
        self._flags_scan = Scan(device, self.pool, "visible", "flags")
        # A number of intersections that no buffer holds must not come back as a small one.
        self._offset_scan = Scan(device, self.pool, "offsets", "gather", saturating=True)
        self._depth_sort = RadixSort(device, self.pool, "depth sort", lane_runs=self.config.lane_runs)
        self._tile_sort = RadixSort(device, self.pool, "tile sort", lane_runs=self.config.lane_runs)
        self._drawn: _Drawn | None = None
        self._trusted: set[tuple[str, bool, bool]] = set()  # passes whose workgroups are known to be subgroups

    # Forward ---------------------------------------------------------------------------------------------------------

    def draw(
        self,
        gaussians: GaussianBuffers,
        camera: Camera,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        *,
        depth: bool = False,
        profile: Any = None,
    ) -> Buffer:
        """Submit the passes that draw an image. Returns its planes, (4, height, width) float32: red, green, blue and
        transmittance, and with `depth` a fifth, the sum of weight times camera depth.

        The picture is valid once `grow` has returned False.
        """
        before = self._drawn.camera if self._drawn is not None else camera
        if (before.width, before.height) != (camera.width, camera.height):
            self.bands = self.rounds = 1  # what an image of another size needed would slow this one down
        self._drawn = drawn = _Drawn(gaussians, camera, background, depth)
        if self.config.round_splats:
            rows, columns = -(-camera.height // self.config.tile_height), -(-camera.width // self.config.tile_width)
            self.bands = max(self.bands, -(-rows // max(1, MOST_TILES // columns)))
        planes = 5 if depth else 4
        image = self.pool.get("image", 4 * planes * camera.width * camera.height)
        for band in range(self.bands):
            with Commands(self.device, profile) as commands:
                self._draw_band(commands, drawn, band)
        if self._subgroup_mismatch("rasterize", drawn):
            return self.draw(gaussians, camera, background, depth=depth, profile=profile)
        return image

    def grow(self) -> bool:
        """Wait for the last draw and see whether its intersections fitted. Where they did not, the buffers are made
        larger, or the image is cut into more bands of tile rows, or its tiles are drawn in more rounds, and True says
        that it has to be drawn again."""
        return self.fit(read_all(self.needed_requests()))

    def needed_requests(self) -> list[Request]:
        """What to read to know the last draw's number of intersections, which comes first, and whether it asks for more
        rounds, a band at a time (for `read_all`)."""
        return [(self._needed(band), "uint32", (3,), 0) for band in range(self.bands)]

    def fit(self, counts: list[NDArray[np.uint32]]) -> bool:
        """`grow`, from numbers that were already read."""
        assert self._drawn is not None
        needed = [int(count[0]) for count in counts]
        most = max(needed)
        if most <= self.capacity:
            if not self.config.round_splats or not any(count[2] for count in counts):
                return False
            self.rounds *= 2
            return True
        if most > self.max_capacity:
            rows = -(-self._drawn.camera.height // self.config.tile_height)
            if self.bands >= rows:
                raise DeviceMemoryError(
                    f"one row of tiles holds {most} intersections, but the device's bindings hold {self.max_capacity}"
                )
            self.bands = min(rows, max(self.bands + 1, -(-5 * sum(needed) // (4 * self.max_capacity))))
        self.capacity = min(self.max_capacity, (5 * most // 4 + 4095) // 4096 * 4096)
        return True

    def _needed(self, band: int) -> Buffer:
        return self.pool.get(f"needed {band}", 16)

    def _draw_band(self, commands: Commands, drawn: _Drawn, band: int) -> None:
        device, pool, config = self.device, self.pool, self.config
        gaussians, n, capacity = drawn.gaussians, drawn.gaussians.count, self.capacity
        frame = self._frame(drawn, band)
        tiles = self._band_tiles(drawn, band)
        splats = pool.get("splats", 4 * SPLAT_FLOATS * n)
        tile_counts = pool.get("tile counts", 4 * n)
        ranges = pool.get("ranges", 16 * tiles + 16)
        visible, needed = pool.get("visible", 4), self._needed(band)
        if config.round_splats:
            commands.clear(needed)
        length = pool.constant("gaussians", n.to_bytes(4, "little"))
        ids, keys, prefix = (pool.get(name, 4 * n) for name in ("ids", "depth keys", "prefix"))

        commands.dispatch(
            Kernel.get(device, "project", **config.tile_defines),
            _groups(n),
            frame=frame,
            means=gaussians.means,
            quats=gaussians.quats,
            scales=gaussians.scales,
            opacities=gaussians.opacities,
            splats=splats,
            tile_counts=tile_counts,
        )
        self._color(commands, drawn, frame, splats, tile_counts)
        self._flags_scan(commands, length=length, capacity=n, values=tile_counts, prefix=prefix, total=visible)
        commands.dispatch(
            Kernel.get(device, "compact"),
            _groups(n),
            frame=frame,
            splats=splats,
            tile_counts=tile_counts,
            prefix=prefix,
            keys=keys,
            ids=ids,
        )
        _, sorted_ids = self._depth_sort(commands, length=visible, capacity=n, bits=_DEPTH_BITS, keys=keys, payload=ids)
        self._offset_scan(
            commands,
            length=visible,
            capacity=n,
            values=tile_counts,
            indices=sorted_ids,
            prefix=prefix,
            total=needed,
        )
        tile_keys, slot_ids = (pool.get(name, 4 * capacity) for name in ("tile keys", "slot ids"))
        commands.dispatch(
            Kernel.get(device, "duplicate_with_keys", **config.tile_defines),
            _groups(n),
            frame=frame,
            visible=visible,
            splats=splats,
            ids=sorted_ids,
            tile_counts=tile_counts,
            offsets=prefix,
            tile_keys=tile_keys,
            slot_ids=slot_ids,
        )
        bits = max(1, tiles.bit_length())  # one key more than there are tiles, for pads
        sorted_keys, slots = self._tile_sort(
            commands, length=needed, capacity=capacity, bits=bits, keys=tile_keys, payload=None
        )
        commands.clear(ranges)
        commands.dispatch(
            Kernel.get(device, "tile_ranges"),
            _groups(-(-capacity // 4)),
            frame=frame,
            needed=needed,
            tile_keys=sorted_keys,
            ranges=ranges,
        )
        for number in range(self.rounds):
            rounds = {"CONTINUED": number > 0, "LAST_ROUND": number == self.rounds - 1} if config.round_splats else {}
            commands.dispatch(
                Kernel.get(
                    device,
                    "rasterize",
                    **config.raster_defines(depth=drawn.depth),
                    **{name: 1 for name, on in rounds.items() if on},
                ),
                tiles,
                frame=frame,
                ranges=ranges,
                slots=slots,
                slot_ids=slot_ids,
                splats=splats,
                image=pool.get("image", 0),
                **({"needed": needed} if config.round_splats else {}),
            )
        drawn.sorted_ids, drawn.slots = sorted_ids, slots

    def _color(self, commands: Commands, drawn: _Drawn, frame: Buffer, splats: Buffer, tile_counts: Buffer) -> None:
        kernel = Kernel.get(self.device, "color", **drawn.sh_defines)
        means = {} if drawn.gaussians.sh_degree is None else {"means": drawn.gaussians.means}
        for part, colors, count in self._color_parts(kernel, drawn, drawn.gaussians.colors):
            buffers = {"colors": colors, "tile_counts": tile_counts, "splats": splats} | means
            commands.dispatch(kernel, _groups(count), frame=frame, part=part, **buffers)

    def _color_parts(self, kernel: Kernel, drawn: _Drawn, colors: Buffer) -> list[tuple[Buffer, Any, int]]:
        """Ranges of Gaussians whose colours fit into one binding: (uniform, part of the buffer, Gaussians)."""
        stride = 12 * drawn.gaussians.sh_stored
        most = self.device.max_binding // stride // 64 * 64  # bindings start at multiples of 256 bytes
        parts = []
        for first in range(0, drawn.gaussians.count, most):
            count = min(most, drawn.gaussians.count - first)
            uniform = self.pool.constant(f"part {first}", kernel.uniform("Part", first=first, count=count))
            parts.append((uniform, (colors, first * stride, max(16, count * stride)), count))
        return parts

    def _band_rows(self, drawn: _Drawn, band: int) -> tuple[int, int]:
        rows = -(-drawn.camera.height // self.config.tile_height)
        return rows * band // self.bands, rows * (band + 1) // self.bands

    def _band_tiles(self, drawn: _Drawn, band: int) -> int:
        first, last = self._band_rows(drawn, band)
        return (last - first) * -(-drawn.camera.width // self.config.tile_width)

    def _frame(self, drawn: _Drawn, band: int) -> Buffer:
        camera = drawn.camera
        content = Kernel.get(self.device, "compact").uniform(
            "Frame",
            view=camera.T_cam_world.T.reshape(-1).tolist(),
            focal=(camera.K[0, 0], camera.K[1, 1]),
            center=(camera.K[0, 2], camera.K[1, 2]),
            position=camera.position.tolist(),
            gaussians=drawn.gaussians.count,
            background=drawn.background,
            capacity=self.capacity,
            size=(camera.width, camera.height),
            tiles=(-(-camera.width // self.config.tile_width), -(-camera.height // self.config.tile_height)),
            band=self._band_rows(drawn, band),
        )
        return self.pool.constant(f"frame {band}", content)

    def _subgroup_mismatch(self, name: str, drawn: _Drawn) -> bool:
        """Whether the driver has cut the workgroups of a pass, which was submitted for the first time, into several
        subgroups. The shape then does without subgroups, and the pass has to be done again. Waits for the device, but
        once a pass."""
        key = (name, drawn.depth, self.rounds > 1)
        if not self.config.subgroups or key in self._trusted:
            return False
        self._trusted.add(key)
        ranges = self.pool.get("ranges", 0)
        last = ranges.read("uint32", (4,), ranges.nbytes - 16)
        if not last[3 if name == "rasterize_bwd" else 2]:
            return False
        self.config = replace(self.config, subgroups=False)
        return True

    # Backward --------------------------------------------------------------------------------------------------------

    def backward(self, d_image: Buffer, *, profile: Any = None) -> GradientBuffers:
        """Submit the passes that carry the gradient of the last drawn image back to its Gaussians.

        d_image: planes as those of the image, with the gradient by alpha in place of the transmittance.
        """
        drawn = self._drawn
        assert drawn is not None, "backward needs a draw before it"
        pool, n = self.pool, drawn.gaussians.count
        d_splats = pool.get("d_splats", 4 * SPLAT_FLOATS * n)
        d_means, d_scales = pool.get("d_means", 12 * n), pool.get("d_scales", 12 * n)
        d_quats = pool.get("d_quats", 16 * n)
        for band in range(self.bands):
            with Commands(self.device, profile) as commands:
                if band == 0:
                    commands.clear(d_splats)
                if self.bands > 1:
                    self._draw_band(commands, drawn, band)  # the lists of the other bands are gone
                self._backward_band(commands, drawn, band, d_image, d_splats)
        if self._subgroup_mismatch("rasterize_bwd", drawn):
            return self.backward(d_image, profile=profile)
        d_colors = None
        with Commands(self.device, profile) as commands:
            commands.dispatch(
                Kernel.get(self.device, "project_bwd"),
                _groups(n),
                frame=self._frame(drawn, 0),
                means=drawn.gaussians.means,
                quats=drawn.gaussians.quats,
                scales=drawn.gaussians.scales,
                d_splats=d_splats,
                d_means=d_means,
                d_quats=d_quats,
                d_scales=d_scales,
            )
            if drawn.gaussians.sh_degree is not None:
                d_colors = pool.get("d_colors", 12 * drawn.gaussians.sh_stored * n)
                self._color_bwd(commands, drawn, d_splats, d_means, d_colors)
        return GradientBuffers(d_means, d_quats, d_scales, d_colors, d_splats)

    def _backward_band(self, commands: Commands, drawn: _Drawn, band: int, d_image: Buffer, d_splats: Buffer) -> None:
        device, pool, n = self.device, self.pool, drawn.gaussians.count
        records = pool.get("records", _RECORD_BYTES * self.capacity)
        tails_size = (3 if drawn.depth else 2) * self.capacity
        pixels = drawn.camera.width * drawn.camera.height if self.rounds > 1 else 0
        record_tails = pool.get("record tails", 4 * tails_size + 8 * pixels)
        gather = Kernel.get(device, "gather_gradients", **({"DEPTH": 1} if drawn.depth else {}))
        tails = pool.constant("tails", gather.uniform("Tails", capacity=self.capacity))
        splats = pool.get("splats", 0)
        kernel = Kernel.get(
            device,
            "rasterize_bwd",
            **self.config.raster_defines(depth=drawn.depth),
            **({"ROUNDS": 1} if self.rounds > 1 else {}),
        )
        commands.clear(record_tails, 4 * self.capacity)  # no slot has a record yet
        for number in range(self.rounds):
            piece = {}
            if self.rounds > 1:
                uniform = kernel.uniform("Piece", number=number, state=tails_size)
                piece["piece"] = pool.constant(f"piece {number}", uniform)
            commands.dispatch(
                kernel,
                self._band_tiles(drawn, band),
                frame=self._frame(drawn, band),
                ranges=pool.get("ranges", 0),
                slots=drawn.slots,
                slot_ids=pool.get("slot ids", 0),
                splats=splats,
                image=pool.get("image", 0),
                d_image=d_image,
                records=records,
                record_tails=record_tails,
                **piece,
            )
        commands.dispatch(
            gather,
            _groups(n),
            visible=pool.get("visible", 0),
            ids=drawn.sorted_ids,
            tile_counts=pool.get("tile counts", 0),
            offsets=pool.get("prefix", 0),
            splats=splats,
            records=records,
            record_tails=record_tails,
            d_splats=d_splats,
            tails=tails,
        )

    def _color_bwd(
        self, commands: Commands, drawn: _Drawn, d_splats: Buffer, d_means: Buffer, d_colors: Buffer
    ) -> None:
        kernel = Kernel.get(self.device, "color_bwd", **drawn.sh_defines)
        inputs = self._color_parts(kernel, drawn, drawn.gaussians.colors)
        outputs = self._color_parts(kernel, drawn, d_colors)
        for (part, colors, count), (_, gradient, _) in zip(inputs, outputs, strict=True):
            commands.dispatch(
                kernel,
                _groups(count),
                frame=self._frame(drawn, 0),
                part=part,
                colors=colors,
                means=drawn.gaussians.means,
                d_splats=d_splats,
                d_colors=gradient,
                d_means=d_means,
            )


@dataclass
class _Drawn:
    """What the backward passes need to know of the last draw."""

    gaussians: GaussianBuffers
    camera: Camera
    background: tuple[float, float, float]
    depth: bool
    sorted_ids: Buffer | None = None  # by depth; here and below: set when a band is drawn
    slots: Buffer | None = None  # of the intersections, by tile and depth

    @property
    def sh_defines(self) -> dict[str, int]:
        degree = self.gaussians.sh_degree
        if degree is None:
            return {}
        flags = {f"SH_{d}": 1 for d in range(1, degree + 1)}
        return {"SH": 1, "SH_COUNT": (degree + 1) ** 2, "SH_STORED": self.gaussians.sh_stored} | flags
