"""The rasterizer's forward and backward passes on arrays of a device (docs/architecture.md lists them in order).

Only `grow_on_overflow` and, the first time that a pass runs, `Rasterizer._subgroup_mismatch` wait for the device.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.errors import DeviceMemoryError
from lapgs_wgpu.gpu.array import BufferPool, DeviceArray, read_all
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.radix_sort import radix_sort
from lapgs_wgpu.gpu.scan import scan
from lapgs_wgpu.splat.buffer_plan import BufferPlans, roomy
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.splat.constants import SPLAT_FLOATS
from lapgs_wgpu.splat.drawing import Drawing, GaussianGradients, sh_defines
from lapgs_wgpu.splat.gaussians import Gaussians
from lapgs_wgpu.splat.raster_config import MAX_BAND_TILES, RasterConfig, raster_config

_RECORD_FLOATS = 8  # rasterize_bwd.wgsl
_BAND_CAPACITY = 1 << 24  # intersections: 1 GB of buffers in a training, and no submission that a watchdog would end
_LANES = 64  # workgroup size of the passes over Gaussians and intersections


def _groups(count: int) -> int:
    return -(-count // _LANES)


class Rasterizer:
    """Draws images on one device. Buffers and plan are reused from image to image.

    capacity: of the plan of the first image, see BufferPlan.
    """

    def __init__(self, device: Device, *, config: RasterConfig | None = None, capacity: int = 1 << 16) -> None:
        self.device = device
        self.config = config or raster_config(device)
        self.pool = BufferPool(device)
        self.plans = BufferPlans(capacity)
        self.max_capacity = device.max_binding // (4 * _RECORD_FLOATS)
        self._drawings = 0
        self._trusted: set[tuple[str, bool, bool]] = set()  # passes whose subgroups were checked

    # Forward ---------------------------------------------------------------------------------------------------------

    def draw(
        self,
        gaussians: Gaussians[DeviceArray],
        camera: Camera,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        *,
        depth: bool = False,
        gradient: bool = False,
    ) -> Drawing:
        """Submit the passes that draw an image, which is valid once `grow_on_overflow` has returned False.

        gradient: whether `backward` may follow.
        """
        with Commands(self.device) as commands:
            drawing = self.record(commands, gaussians, camera, background, depth=depth, gradient=gradient)
        if self._subgroup_mismatch("rasterize", drawing):
            return self.draw(gaussians, camera, background, depth=depth, gradient=gradient)
        return drawing

    def draw_whole(self, *given: Any, **how: Any) -> Drawing:
        """Draw with the arguments of `draw` until the buffers are large enough. Waits for the device."""
        while self.grow_on_overflow(drawing := self.draw(*given, **how)):
            pass
        return drawing

    def record(
        self,
        commands: Commands,
        gaussians: Gaussians[DeviceArray],
        camera: Camera,
        background: tuple[float, float, float],
        move: Callable[[Commands, DeviceArray, int], DeviceArray] | None = None,
        *,
        depth: bool = False,
        gradient: bool = True,
    ) -> Drawing:
        """Record the passes of an image, once `draw` and `backward` have checked subgroups. move: as in Drawing."""
        self.plans.turn_to((camera.width, camera.height, gradient))
        if self.config.round_splats:
            rows, columns = self._tiles(camera)
            bands = max(self.plans.now.bands, -(-rows // max(1, MAX_BAND_TILES // columns)))
            self.plans.now = replace(self.plans.now, bands=bands)
        self._drawings += 1
        plan, pool = self.plans.now, self.pool
        image = pool.array("image", (5 if depth else 4, camera.height, camera.width))
        splats = pool.array("splats", (len(gaussians), SPLAT_FLOATS))
        needed = [pool.array(f"needed {band}", (3,), "uint32") for band in range(plan.bands)]
        drawing = Drawing(gaussians, camera, background, depth, plan, self._drawings, image, splats, needed, move)
        for band in range(plan.bands):
            self._draw_band(commands, drawing, band)
            commands.flush()
        return drawing

    def holds(self, drawing: Drawing) -> bool:
        """Return whether the arrays still hold this drawing: no other image was drawn since."""
        return drawing.number == self._drawings

    def grow_on_overflow(self, drawing: Drawing, needed: list[NDArray[np.uint32]] | None = None) -> bool:
        """Return whether the intersections overflowed the plan. The drawing is then invalid and has to be drawn again,
        with a plan that now has larger buffers, more bands or more rounds.

        needed: content of `drawing.needed`; None reads it and waits for the device.
        Raises DeviceMemoryError if a row of tiles does not fit into the largest buffers.
        """
        counts = read_all(drawing.needed) if needed is None else needed
        totals, plan = [int(count[0]) for count in counts], drawing.plan
        most = max(totals)
        if most <= plan.capacity:
            if not self.config.round_splats or not any(count[2] for count in counts):
                if plan == self.plans.now:
                    self.plans.fitted(most)
                return False
            self.plans.now = replace(plan, rounds=2 * plan.rounds)
            return True
        bands, (rows, _) = plan.bands, self._tiles(drawing.camera)
        limit = min(self.max_capacity, _BAND_CAPACITY) if bands < rows else self.max_capacity
        if most > limit:
            if bands >= rows:
                raise DeviceMemoryError(
                    f"one row of tiles holds {most} intersections, but the device's bindings hold {limit}"
                )
            bands = min(rows, max(bands + 1, -(-5 * sum(totals) // (4 * limit))))
        self.plans.now = replace(plan, capacity=min(limit, roomy(most)), bands=bands)
        return True

    def _draw_band(self, commands: Commands, drawing: Drawing, band: int) -> None:
        device, pool, config, gaussians = self.device, self.pool, self.config, drawing.gaussians
        n, capacity, tiles = len(gaussians), drawing.plan.capacity, self._band_tiles(drawing, band)
        frame = pool.varying(f"frame {band}", lambda: self._frame(drawing, band))
        frame = drawing.move(commands, frame, band) if drawing.move else frame
        names = ("tile counts", "ids", "depth keys", "offsets")
        tile_counts, ids, keys, offsets = (pool.array(name, (n,), "uint32") for name in names)
        needed, visible = drawing.needed[band], pool.array("visible", (1,), "uint32")
        tile_keys, slot_ids = (pool.array(name, (capacity,), "uint32") for name in ("tile keys", "slot ids"))
        ranges = pool.array("ranges", (tiles + 1, 4), "uint32")
        length = pool.constant(n.to_bytes(4, "little"))
        arrays = drawing.arrays = gaussians.arrays() | {"frame": frame, "needed": needed}
        arrays |= {"splats": drawing.splats, "image": drawing.image}
        arrays |= {"tile_counts": tile_counts, "ids": ids, "keys": keys, "prefix": offsets, "visible": visible}
        arrays |= {"offsets": offsets, "tile_keys": tile_keys, "slot_ids": slot_ids, "ranges": ranges}
        if config.round_splats:
            commands.clear(needed)
        commands.run(Kernel.get(device, "project", **config.tile_defines), _groups(n), arrays)
        self._color(commands, "color", drawing, arrays, colors=gaussians.sh)
        scan(commands, pool, "visible", length=length, values=tile_counts, prefix=offsets, total=visible, flags=True)
        commands.run(Kernel.get(device, "compact"), _groups(n), arrays)
        _, ids = radix_sort(commands, pool, "depth sort", visible, keys, ids, bits=32, lane_runs=config.lane_runs)
        arrays["ids"] = ids
        scan(commands, pool, "offsets", length=visible, values=tile_counts, prefix=offsets, total=needed, indices=ids)
        commands.run(Kernel.get(device, "duplicate_with_keys", **config.tile_defines), _groups(n), arrays)
        bits = max(1, tiles.bit_length())  # one key more than there are tiles, for pads
        arrays["tile_keys"], arrays["slots"] = radix_sort(
            commands, pool, "tile sort", needed, tile_keys, None, bits=bits, lane_runs=config.lane_runs
        )
        commands.clear(ranges)
        commands.run(Kernel.get(device, "tile_ranges"), _groups(-(-capacity // 4)), arrays)
        for number in range(drawing.plan.rounds):
            defines = config.raster_defines(depth=drawing.depth)
            if config.round_splats:
                defines |= {"CONTINUED": number > 0, "LAST_ROUND": number == drawing.plan.rounds - 1}
            commands.run(Kernel.get(device, "rasterize", **defines), tiles, arrays)

    def _color(
        self, commands: Commands, name: str, drawing: Drawing, arrays: Mapping[str, DeviceArray], **rows: DeviceArray
    ) -> None:
        """Record a pass over colors (N, K, 3), once for each range of Gaussians whose `rows` fit into one binding."""
        n, sh = len(drawing.gaussians), drawing.gaussians.sh
        kernel = Kernel.get(self.device, name, **sh_defines(drawing.gaussians.sh_degree))
        most = self.device.max_binding // (4 * math.prod(sh.shape[1:])) // 64 * 64  # ranges begin at 256 bytes
        for first in range(0, n, most):
            count = min(most, n - first)
            part = self.pool.constant(kernel.uniform("Part", first=first, count=count))
            bound = {key: array.rows(first, count) for key, array in rows.items()}
            commands.run(kernel, _groups(count), {**arrays, **bound, "part": part})

    def _tiles(self, camera: Camera) -> tuple[int, int]:
        """Return the numbers of rows and columns of tiles."""
        return -(-camera.height // self.config.tile_height), -(-camera.width // self.config.tile_width)

    def _band_rows(self, drawing: Drawing, band: int) -> tuple[int, int]:
        rows, _ = self._tiles(drawing.camera)
        return rows * band // drawing.plan.bands, rows * (band + 1) // drawing.plan.bands

    def _band_tiles(self, drawing: Drawing, band: int) -> int:
        first, last = self._band_rows(drawing, band)
        return (last - first) * self._tiles(drawing.camera)[1]

    def _frame(self, drawing: Drawing, band: int) -> bytes:
        camera = drawing.camera
        rows, columns = self._tiles(camera)
        return Kernel.get(self.device, "compact").uniform(
            "Frame",
            view=camera.T_cam_world.T.reshape(-1).tolist(),
            focal=(camera.K[0, 0], camera.K[1, 1]),
            center=(camera.K[0, 2], camera.K[1, 2]),
            position=camera.position.tolist(),
            gaussians=len(drawing.gaussians),
            background=drawing.background,
            capacity=drawing.plan.capacity,
            size=(camera.width, camera.height),
            tiles=(columns, rows),
            band=self._band_rows(drawing, band),
            low_pass=drawing.gaussians.low_pass,
            antialiased=int(bool(drawing.gaussians.antialiased)),
            near=camera.near,
        )

    def _subgroup_mismatch(self, name: str, drawing: Drawing) -> bool:
        """Return whether the driver has split a pass's workgroups into several subgroups, checked after its first run.

        If so, no pass uses subgroups from now on, and the image has to be drawn again.
        """
        key = (name, drawing.depth, drawing.plan.rounds > 1)
        if not self.config.subgroups or key in self._trusted:
            return False
        self._trusted.add(key)
        ranges = drawing.arrays["ranges"]
        flags = ranges.rows(ranges.shape[0] - 1, 1).read()[0]
        if not flags[3 if name == "rasterize_bwd" else 2]:
            return False
        self.config = self.config.without_subgroups()
        return True

    # Backward --------------------------------------------------------------------------------------------------------

    def backward(self, drawing: Drawing, d_image: DeviceArray, *, camera: bool = False) -> GaussianGradients:
        """Submit the backward passes of a drawing.

        d_image: gradient of the image's planes, with that of alpha instead of the transmittance. camera: whether the
        gradient by the camera is wanted, too.
        Raises RuntimeError if another image was drawn since, which has overwritten the drawing's arrays.
        """
        if not self.holds(drawing):
            raise RuntimeError("backward needs the drawing that was drawn last; its buffers now hold another image")
        with Commands(self.device) as commands:
            gradients = self.record_bwd(commands, drawing, d_image, camera=camera)
        if self._subgroup_mismatch("rasterize_bwd", drawing):
            given, depth = (drawing.gaussians, drawing.camera, drawing.background), drawing.depth
            return self.backward(self.draw_whole(*given, depth=depth, gradient=True), d_image, camera=camera)
        return gradients

    def record_bwd(
        self, commands: Commands, drawing: Drawing, d_image: DeviceArray, *, camera: bool
    ) -> GaussianGradients:
        """Record the backward passes of the drawing that `record` has recorded last; arguments as for `backward`."""
        gaussians, n = drawing.gaussians, len(drawing.gaussians)
        d_splats = self.pool.array("d_splats", (n, SPLAT_FLOATS))
        commands.clear(d_splats)
        for band in range(drawing.plan.bands):
            self._backward_band(commands, drawing, band, d_image, d_splats)
            commands.flush()
        d_means, d_scales = self.pool.array("d_means", (n, 3)), self.pool.array("d_scales", (n, 3))
        d_quats = self.pool.array("d_quats", (n, 4))
        d_sh = d_camera = None
        arrays = drawing.arrays | {"d_splats": d_splats}
        arrays |= {"d_means": d_means, "d_quats": d_quats, "d_scales": d_scales}
        commands.run(Kernel.get(self.device, "project_bwd"), _groups(n), arrays)
        if camera:  # a row for each workgroup of camera_bwd, twice; each half begins at a multiple of 256 bytes
            d_camera = self.pool.array("d_camera", (2, (_groups(n) + 15) // 16 * 16, 4))
            commands.clear(d_camera)  # the last rows pad it
            commands.run(Kernel.get(self.device, "camera_bwd"), _groups(n), arrays | {"d_camera": d_camera.rows(0, 1)})
        if gaussians.sh_degree is not None:
            d_sh = self.pool.array("d_sh", gaussians.sh.shape)
            self._color(commands, "color_bwd", drawing, arrays, colors=gaussians.sh, d_colors=d_sh)
        if d_camera is not None:
            kernel = Kernel.get(self.device, "camera_bwd", FORCE=True)
            commands.run(kernel, _groups(n), arrays | {"d_camera": d_camera.rows(1, 1)})
        return GaussianGradients(d_splats, d_means, d_quats, d_scales, d_sh, d_camera)

    def _backward_band(
        self, commands: Commands, drawing: Drawing, band: int, d_image: DeviceArray, d_splats: DeviceArray
    ) -> None:
        if drawing.plan.bands > 1:  # the lists of the other bands are gone
            self._draw_band(commands, drawing, band)
        plan = drawing.plan
        records = self.pool.array("records", (plan.capacity, _RECORD_FLOATS))
        tails = (3 if drawing.depth else 2) * plan.capacity
        states = 2 * drawing.camera.width * drawing.camera.height if plan.rounds > 1 else 0
        record_tails = self.pool.array("record tails", (tails + states,), "uint32")
        defines = self.config.raster_defines(depth=drawing.depth)
        kernel = Kernel.get(self.device, "rasterize_bwd", ROUNDS=plan.rounds > 1, **defines)
        gather = Kernel.get(self.device, "gather_gradients", DEPTH=drawing.depth)
        arrays = drawing.arrays | {"d_image": d_image, "d_splats": d_splats}
        arrays |= {"records": records, "record_tails": record_tails}
        arrays["tails"] = self.pool.constant(gather.uniform("Tails", capacity=plan.capacity))
        commands.clear(record_tails.rows(0, plan.capacity))  # no slot has a record yet
        for number in range(plan.rounds):
            if plan.rounds > 1:
                arrays["piece"] = self.pool.constant(kernel.uniform("Piece", number=number, state=tails))
            commands.run(kernel, self._band_tiles(drawing, band), arrays)
        commands.run(gather, _groups(len(drawing.gaussians)), arrays)
