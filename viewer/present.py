"""The pass `present`: draws a frame onto a window's texture, or one of our own, without a host copy."""

from typing import Any

import numpy as np
import wgpu
from numpy.typing import NDArray

from lapgs_wgpu.gpu.array import BufferPool
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.gpu.shader import compose, pack
from lapgs_wgpu.viewer.frame import Frame
from lapgs_wgpu.viewer.render_modes import Mode

# The scale of colors for values, from low to high.
HEAT = (
    (0.05, 0.03, 0.20),
    (0.33, 0.06, 0.43),
    (0.73, 0.21, 0.33),
    (0.95, 0.45, 0.15),
    (0.98, 0.75, 0.25),
    (0.99, 0.99, 0.80),
)
_NUMBERS: dict[Mode, int] = {"rgb": 0, "alpha": 1, "depth": 2, "motion": 3}  # of the modes in the shader


class Presenter:
    """Draws frames onto textures of one format of one device."""

    def __init__(self, device: Device, target_format: str = "rgba8unorm") -> None:
        self.device, self._format = device, target_format
        self._pool = BufferPool(device)
        self._source = compose("present", {})
        native = device.wgpu_device
        module = native.create_shader_module(label="present", code=self._source)
        self._pipeline = native.create_render_pipeline(
            label="present",
            layout="auto",
            vertex={"module": module, "entry_point": "vertex"},
            fragment={"module": module, "entry_point": "fragment", "targets": [{"format": target_format}]},
            primitive={"topology": "triangle-list"},
        )
        self._layout = self._pipeline.get_bind_group_layout(0)

    def __call__(self, target: Any, size: tuple[int, int], frame: Frame) -> None:
        """Submit: the frame on all of `target`, a texture view of (width, height)."""
        request = frame.request
        values = {
            **{f"heat{i}": (*color, 1.0) for i, color in enumerate(HEAT)},
            "background": (*request.background, 1.0),
            "size": size,
            "picture": (request.camera.width, request.camera.height),
            "value": _NUMBERS[request.mode],
            "low": frame.low,
            "high": frame.high,
        }
        uniform = self._pool.varying("present", lambda: pack(self._source, "Present", values))
        entries = [{"binding": i, "resource": array.resource} for i, array in enumerate((uniform, frame.planes))]
        native = self.device.wgpu_device
        encoder = native.create_command_encoder()
        attachment = {"view": target, "load_op": "clear", "store_op": "store"}
        render = encoder.begin_render_pass(color_attachments=[attachment])
        render.set_pipeline(self._pipeline)
        render.set_bind_group(0, native.create_bind_group(layout=self._layout, entries=entries))
        render.draw(3)
        render.end()
        self.device.queue.submit([encoder.finish()])

    def picture(self, size: tuple[int, int], frame: Frame) -> NDArray[np.uint8]:
        """Draw a frame on a texture of (width, height), by default rgba8unorm; returns (height, width, 3) uint8."""
        usage = wgpu.TextureUsage.RENDER_ATTACHMENT | wgpu.TextureUsage.COPY_SRC
        texture = self.device.wgpu_device.create_texture(size=(*size, 1), format=self._format, usage=usage)
        self(texture.create_view(), size, frame)
        layout = {"bytes_per_row": 4 * size[0], "rows_per_image": size[1]}
        data = self.device.queue.read_texture({"texture": texture}, layout, (*size, 1))
        return np.frombuffer(data, np.uint8).reshape(size[1], size[0], 4)[..., :3].copy()
