"""Renders without a window: screenshots, and videos (H.264 in MP4)."""

import sys
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lapgs_wgpu.data.images import encode_png, size_text
from lapgs_wgpu.errors import InputError, optional_module
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.atomic import atomic_write
from lapgs_wgpu.progress import counted
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.viewer.camera import ViewCamera, orbit_views
from lapgs_wgpu.viewer.frame import FrameRenderer, FrameRequest
from lapgs_wgpu.viewer.loaded_scene import LoadedScene, given_scene
from lapgs_wgpu.viewer.options import SIZE
from lapgs_wgpu.viewer.present import Presenter
from lapgs_wgpu.viewer.render_modes import BACKGROUNDS, Mode


class OffscreenRenderer:
    """Renders images of a scene."""

    def __init__(
        self, scene: LoadedScene, mode: Mode = "rgb", background: tuple[float, float, float] | None = None
    ) -> None:
        self._renderer, self._presenter = FrameRenderer(scene.playback), Presenter(scene.playback.device)
        self._mode, self._background = mode, scene.background if background is None else background

    def __call__(self, camera: Camera, time: float) -> NDArray[np.uint8]:
        """Draw what the camera sees at a time in [0, 1]: (height, width, 3) uint8."""
        frame = self._renderer.draw(FrameRequest(camera, time, self._mode, self._background))
        return self._presenter.picture((camera.width, camera.height), frame)


def framed(camera: Camera, width: int, height: int) -> Camera:
    """Put the camera on a picture of another size and aspect: its vertical field of view stays, pixels stay square
    where they were, and what was in the middle stays there."""
    scale = height / camera.height
    K = camera.K.copy()
    K[:2] *= scale
    K[0, 2] += 0.5 * (width - scale * camera.width)
    return Camera(K, camera.T_cam_world, width, height, camera.near)


class GivenRenderer(OffscreenRenderer):
    """What the options of lapgs-view ask for. view: the captured one that --view names; size and time are given, or of
    that view. Raises InputError where the file cannot be opened, or the capture lacks the view."""

    def __init__(self, given: Any, device: Callable[[], Device]) -> None:
        self.scene = scene = given_scene(given, device)
        super().__init__(scene, given.mode or "rgb", BACKGROUNDS.get(given.background))
        self.view = view = scene.views[scene.view_number(given.view)] if given.view is not None else None
        self.size: tuple[int, int] = given.size or ((view.camera.width, view.camera.height) if view else SIZE)
        self.time: float = given.time if given.time is not None else view.time if view else 0.0

    def camera(self, size: tuple[int, int]) -> Camera:
        return framed(self.view.camera, *size) if self.view else self.scene.camera().camera(*size)


def write_screenshot(given: Any, device: Callable[[], Device]) -> None:
    """Write the PNG file that the options of lapgs-view ask for. Raises InputError where it cannot be written."""
    picture = GivenRenderer(given, device)
    with atomic_write(given.screenshot) as target:
        target.write(encode_png(picture(picture.camera(picture.size), picture.time)))
    print(f"{given.screenshot}: {size_text(picture.size)}, time {picture.time:g}")


def write_video(given: Any, device: Callable[[], Device]) -> None:
    """Write the MP4 file that the options of lapgs-view ask for. Atomic. Raises InputError where PyAV is missing or it
    cannot be written."""
    picture = GivenRenderer(given, device)
    scene = picture.scene
    path = given.path or ("time" if scene.playback.moves else "view")
    if path != "view" and given.time is not None:
        raise InputError(f"--time has no use with --path {path}, along which time passes.")
    size = max(2, picture.size[0] // 2 * 2), max(2, picture.size[1] // 2 * 2)  # as the pixel format yuv420p needs it
    if size != picture.size:
        print(f"note: mp4 needs even sizes: {size_text(picture.size)} becomes {size_text(size)}", file=sys.stderr)
    fps = given.fps or 30.0
    seconds = given.seconds or (6.0 if path == "view" else scene.clock().frames / fps)
    frames = max(1, round(seconds * fps))
    if path == "time":
        standing = picture.camera(size)
        cameras: Iterator[tuple[Camera, float]] = ((standing, share) for share in np.linspace(0, 1, frames).tolist())
    else:
        first, start = scene.initial_view, picture.view.camera if picture.view else scene.initial_view.camera
        turning = ViewCamera(start, first.focus, first.up)
        cameras = orbit_views(turning, size, frames, None if path == "both" else picture.time, first.arc_from(start))
    av = optional_module("av", "writing mp4 needs PyAV", "video")
    rate = Fraction(fps).limit_denominator(65535)
    with atomic_write(given.video) as target, av.open(f"file:{target.name}", "w", format="mp4") as container:
        options = {"crf": "18", "preset": "medium"}  # hardly distinguishable from no loss
        stream = container.add_stream("libx264", rate, options=options)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"
        # Without these, players guess the color space from the image size: BT.601's matrix and limited range, as
        # swscale converts, and sRGB's primaries.
        context = stream.codec_context
        context.colorspace, context.color_primaries, context.color_trc, context.color_range = 6, 1, 13, 1
        for camera, time in counted(cameras, frames, "frames"):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture(camera, time), "rgb24")))
        container.mux(stream.encode(None))
    print(f"{given.video}: {frames} frames of {size_text(size)} at {fps:g} a second")
