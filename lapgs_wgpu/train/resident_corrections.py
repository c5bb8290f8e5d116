"""The corrections of cameras and colors in device arrays, and the passes of a resident step that use and move them."""

import numpy as np
import torch

from lapgs_wgpu.data.views import View
from lapgs_wgpu.gpu.array import BufferPool, DeviceArray
from lapgs_wgpu.gpu.kernel import Commands, Kernel
from lapgs_wgpu.gpu.matmul import sum_columns
from lapgs_wgpu.train.camera_refinement import MOST_POINTS, CameraRefinement
from lapgs_wgpu.train.exposure import Exposures, expose, expose_bwd
from lapgs_wgpu.train.learners import Learners
from lapgs_wgpu.train.optimizer import rate_at
from lapgs_wgpu.train.resident_parameters import Block, Place

_CAMERA_FLOATS, _EXPOSURE_FLOATS = 16, 40  # rows of camera_step.wgsl and exposure_step.wgsl
_MOTION_FLOATS, _MOST_COMMON = 22, 8  # image_motion.wgsl, camera_step.wgsl
_PLACES: dict[str, dict[str, Place]] = {
    "cameras": {
        "learnt": np.s_[:-1, :6],
        "mean": np.s_[:-1, 6:12],
        "steps": np.s_[:-1, 12:13],
        "square": np.s_[-1:, 0:1],
        "moves": np.s_[-1:, 1:2],
    },
    "exposure": {"values": np.s_[:, :12], "mean": np.s_[:, 12:24], "square": np.s_[:, 24:36], "steps": np.s_[:, 36:37]},
}


class ResidentCorrections:
    """The corrections of a training and the state by which they learn, on a device.

    on_host: whether the host may have changed them since they were pushed. moves_camera: whether this step moves its
    camera.
    """

    def __init__(self, learners: Learners) -> None:
        device = self._device = learners.scene.device
        self._pool = BufferPool(device)
        self._cameras, self._exposures, self._numbers = learners.cameras, learners.exposures, learners.image_numbers
        self._blocks: list[tuple[Block, CameraRefinement | Exposures]] = []
        if self._cameras is not None:
            self._camera_rows = self._add(self._cameras, (len(self._cameras.numbers) + 1, _CAMERA_FLOATS))
            common = torch.zeros(6 * len(self._cameras.numbers), _MOST_COMMON)
            common[:, : self._cameras.common.shape[1]] = self._cameras.common
            self._common = self._pool.upload("common motions", common.numpy())
        if self._exposures is not None:
            self._exposure_rows = self._add(self._exposures, (len(self._exposures.values), _EXPOSURE_FLOATS))
        self._d_camera, self._d_exposure = self._pool.array("d_camera", (8,)), self._pool.array("d_exposure", (12,))
        self.on_host, self.moves_camera = True, False

    def _add(self, of: CameraRefinement | Exposures, shape: tuple[int, int]) -> DeviceArray:
        rows = self._pool.array(of.name, shape)
        self._blocks.append((Block(of.name, shape, None, _PLACES[of.name], arrays={"value": rows}), of))
        return rows

    def push(self) -> None:
        """Upload what the host has had since the last step."""
        if self.on_host:
            for block, of in self._blocks:
                block.arrays["value"].write(block.gather(of.state()))
        self.on_host = False

    @torch.no_grad()
    def pull(self) -> None:
        """Make the host's corrections the newest ones."""
        if not self.on_host:
            for block, of in self._blocks:
                block.scatter(block.arrays["value"].read(), of.state())
        self.on_host = True

    def begin(self, view: View, step: int) -> None:
        """Say what is recorded or replayed next: a step, counted from 1, and its view."""
        self._step, self._image = step, self._numbers[view.name]
        if self._cameras is not None:
            self._camera, pace = self._cameras.numbers[view.camera], self._cameras.pace(step)
            self.moves_camera, self._pace = pace is not None, pace._asdict() if pace else {}

    # Passes, in their order ------------------------------------------------------------------------------------------

    def move(self, commands: Commands, frame: DeviceArray, band: int) -> DeviceArray:
        """Record the frame of a band's passes with the view's camera corrected."""
        if self._cameras is None:
            return frame
        kernel, unit = Kernel.get(self._device, "move_camera"), self._cameras.extent
        moved = self._pool.varying("moved", lambda: kernel.uniform("Moved", row=self._camera, unit=unit))
        corrected = self._pool.array(f"frame {band}", frame.shape, frame.dtype)
        commands.dispatch(kernel, 1, moved=moved, placed=frame, cameras=self._camera_rows, frame=corrected)
        return corrected

    def expose(self, commands: Commands, image: DeviceArray) -> DeviceArray:
        """Record the image with its colors corrected."""
        if self._exposures is None:
            return image
        return expose(commands, self._pool, image, self._exposure_rows, self._first_row)

    def expose_bwd(self, commands: Commands, image: DeviceArray, d_exposed: DeviceArray) -> DeviceArray:
        """Record the gradient by the image, and that by the correction of its colors."""
        if self._exposures is None:
            return d_exposed
        rows = self._exposure_rows
        d_image, d_rows = expose_bwd(commands, self._pool, image, d_exposed, rows, self._first_row)
        sum_columns(commands, self._pool, d_rows, self._d_exposure, columns=12)
        return d_image

    def sum_camera(self, commands: Commands, sums: DeviceArray | None) -> None:
        """Record the gradient by the camera. sums: of `GaussianGradients.camera`."""
        if sums is None or self._cameras is None:
            return
        for half, factor in enumerate((-1.0, -self._cameras.extent)):
            rows, total = sums.rows(half, 1), self._d_camera
            sum_columns(commands, self._pool, rows, total, columns=4, place=4 * half, factor=factor)

    def gradients(self) -> list[DeviceArray]:
        """Of all that the step moves."""
        of_camera = [self._d_camera] if self.moves_camera else []
        return of_camera if self._exposures is None else [*of_camera, self._d_exposure]

    def record_step(self, commands: Commands, guard: DeviceArray, frame: DeviceArray, geometry: DeviceArray) -> None:
        """Record a step of the corrections, after the one of the Gaussians. frame: that `move` gave; geometry: (N, 12)
        of the Gaussians."""
        if self.moves_camera:
            self._step_camera(commands, guard, frame, geometry)
        if (exposures := self._exposures) is None:
            return
        kernel, count = Kernel.get(self._device, "exposure_step"), len(exposures.values)
        descent = self._pool.varying(
            "exposure step",
            lambda: kernel.uniform(
                "ExposureStep", number=self._image, count=count, rate=rate_at(exposures.rate, self._step)
            ),
        )
        arrays = {"guard": guard, "d_exposure": self._d_exposure, "exposures": self._exposure_rows}
        commands.dispatch(kernel, 1, descent=descent, **arrays)

    def _step_camera(self, commands: Commands, guard: DeviceArray, frame: DeviceArray, geometry: DeviceArray) -> None:
        assert self._cameras is not None
        unit, cameras, count = self._cameras.extent, len(self._cameras.numbers), geometry.shape[0]
        motion, motion_kernel = self._pool.array("motion", (_MOTION_FLOATS,)), Kernel.get(self._device, "image_motion")
        content = motion_kernel.uniform("Seen", gaussians=count, spacing=-(-count // MOST_POINTS), unit=unit)
        seen = self._pool.constant(content)
        commands.dispatch(motion_kernel, 1, seen=seen, frame=frame, geometry=geometry, motion=motion)
        kernel = Kernel.get(self._device, "camera_step")
        descent = self._pool.varying(
            "camera step", lambda: kernel.uniform("CameraStep", number=self._camera, cameras=cameras, **self._pace)
        )
        arrays = {"guard": guard, "motion": motion, "d_camera": self._d_camera, "common_motions": self._common}
        commands.dispatch(kernel, 1, descent=descent, cameras=self._camera_rows, **arrays)

    def _first_row(self) -> int:
        return self._image * _EXPOSURE_FLOATS // 4
