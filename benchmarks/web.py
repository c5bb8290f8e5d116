"""The web page against the desktop's viewer: python benchmarks/web.py SCENE.html... prints a Markdown table.

Beside each page lies the SCENE.lapgs that it carries. Pictures are compared at three times and two cameras, as floats;
times are the medians of frames at new times, the page's in Chromium on SwiftShader, the desktop's on this machine's
first adapter: in the shape that the page uses, which is that for GPUs, and in the adapter's own.
"""

import dataclasses
import statistics
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from helpers.browser import WEBGPU, Browser, wait_for
from helpers.web_pages import call, page_picture, psnr, shown

from lapgs_wgpu.gpu.device import Device, _adapters, open_device
from lapgs_wgpu.viewer.camera import ViewCamera
from lapgs_wgpu.viewer.frame import Frame, FrameRenderer, FrameRequest
from lapgs_wgpu.viewer.loaded_scene import load_scene

SIZE = (400, 400)
TIMES = (0.0, 0.37, 1.0)
FRAMES = 7


def elsewhere(camera: ViewCamera) -> None:
    """A quarter around, and nearer."""
    camera.orbit(1.2, 0.2)
    camera.zoom(0.8)


def gpu_shaped() -> Device:
    """The first adapter, with the kernels in their shape for GPUs and without subgroups: as the page runs them."""
    info, adapter = _adapters()[0]
    plain = SimpleNamespace(features=(), limits=adapter.limits, request_device_sync=adapter.request_device_sync)
    return Device(plain, dataclasses.replace(info, kind="discrete"))


def row(page: Path, browser: Browser) -> str:
    """Page, smallest PSNR, and ms a frame on the page, on the desktop in the page's shape, and in its own."""
    viewers = [Viewer(page, device) for device in (open_device(), gpu_shaped())]
    browser.open(page.as_uri())
    wait_for(lambda: shown(browser), "the scene", 300)
    worst = np.inf
    camera = viewers[0].scene.camera()
    for change in (lambda camera: None, elsewhere):
        change(camera)
        call(browser, "setCamera", {"position": camera.position.tolist(), "focus": camera.focus.tolist()})
        camera.focus_on(camera.focus)  # as setCamera does
        for time in TIMES:
            call(browser, "setTime", time)
            expected = viewers[0].draw(camera, time).planes.read()[:3].transpose(1, 2, 0)
            worst = min(worst, psnr(page_picture(browser), expected))
    times: list[list[float]] = [[], [], []]
    for time in np.linspace(0.1, 0.9, FRAMES).tolist():
        call(browser, "passes", time)
        times[0].append(browser.value("lapgs.seconds"))
        for viewer, found in zip(viewers, times[1:], strict=True):
            found.append(viewer.draw(camera, time).seconds)
    there, own, shaped = (1000 * statistics.median(found) for found in times)
    ratios = f"{there / shaped:.1f} | {there / own:.1f}"
    return f"| {page.stem} | {worst:.1f} | {there:.0f} | {shaped:.0f} | {own:.0f} | {ratios} |"


class Viewer:
    """The desktop's, on a device."""

    def __init__(self, page: Path, device: Device) -> None:
        self.scene = load_scene(page.with_suffix(".lapgs"), lambda: device)
        self._renderer = FrameRenderer(self.scene.playback)

    def draw(self, camera: ViewCamera, time: float) -> Frame:
        return self._renderer.draw(FrameRequest(camera.camera(*SIZE), time, "rgb", self.scene.background))


def main(pages: list[str]) -> None:
    print("| page | PSNR at least, dB | page, ms | desktop in the page's shape, ms | desktop, ms | ratio | ratio |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as folder, Browser(Path(folder), SIZE, WEBGPU) as browser:
        for page in pages:
            print(row(Path(page).absolute(), browser), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
