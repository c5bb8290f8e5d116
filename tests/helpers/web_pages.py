"""Scenes as web pages in headless Chromium, on SwiftShader, and the same picture on the desktop."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from helpers.browser import Browser
from helpers.waiting import wait_for
from numpy.typing import NDArray

from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.motion.scene import Scene4D
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.viewer.camera import ViewCamera
from lapgs_wgpu.viewer.export import export_compact
from lapgs_wgpu.viewer.frame import FrameRenderer, FrameRequest
from lapgs_wgpu.viewer.loaded_scene import LoadedScene, load_scene
from lapgs_wgpu.viewer.render_modes import BACKGROUNDS

SIZE = (320, 240)
FRAMES = 31
LOOK = InitialView(
    Camera.looking_at([0.5, -4.0, 1.5], [0, 0, 0], up=[0, 0, 1], fov_x=0.7, width=400, height=300),
    np.zeros(3),
    np.array([0.0, 0.0, 1.0]),
    FRAMES,
)


def export_scene(scene: Scene4D, folder: Path, device: Device, name: str = "scene") -> Path:
    """folder/NAME.html; beside it NAME.lapgs, the very file inside of it, and NAME.ply."""
    with (
        torch.no_grad()
    ):  # at the rim of a Gaussian, where alpha reaches 1/255, rounding decides: fewer and fainter rims
        scene.parameters["log_scales"] -= 1.2
        scene.parameters["sh_dc"] *= 0.4
        scene.parameters["sh_rest"] *= 0.4
    checkpoint = folder / f"{name}.ply"
    scene.save(checkpoint, {"view": LOOK.to_json(), "background": "grey"})
    loaded = load_scene(checkpoint, lambda: device)
    for ending in (".lapgs", ".html"):
        export_compact(loaded, folder / f"{name}{ending}")
    return folder / f"{name}.html"


def open_page(browser: Browser, url: str, *, first: str = "") -> None:
    """Open a page and wait until it shows its scene. first: a script that runs before the page's own."""
    made = browser.call("Page.addScriptToEvaluateOnNewDocument", source=first)
    browser.open(url)
    wait_for(lambda: shown(browser), "the scene")
    browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=made["identifier"])


def shown(browser: Browser) -> bool:
    """Whether the page shows its scene. Fails where it says why it does not."""
    note = browser.note()
    assert not {"cannot", "failed"} & set(note.split()), note
    return bool(browser.value("Boolean(window.lapgs)")) and note == ""


def page_picture(browser: Browser) -> NDArray[np.float32]:
    """(height, width, 3) of the final picture."""
    width, height, values = browser.value(
        "lapgs.picture().then(({width, height, values}) => [width, height, Array.from(values)])"
    )
    return np.array(values, np.float32).reshape(4, height, width)[:3].transpose(1, 2, 0)


class Desktop:
    """Draws a compact scene on the device of the tests."""

    def __init__(self, page: Path, device: Device) -> None:
        self.scene: LoadedScene = load_scene(page.with_suffix(".lapgs"), lambda: device)
        self.renderer = FrameRenderer(self.scene.playback)

    def picture(
        self,
        time: float,
        change: Callable[[ViewCamera], object] = lambda camera: None,
        size: tuple[int, int] = SIZE,
        background: str = "grey",
    ) -> NDArray[np.float32]:
        """(height, width, 3) of a time, from where the scene begins or where `change` moves the camera."""
        camera = self.scene.camera()
        change(camera)
        frame = self.renderer.draw(FrameRequest(camera.camera(*size), time, "rgb", BACKGROUNDS[background]))
        planes: NDArray[np.float32] = frame.planes.read()
        return planes[:3].transpose(1, 2, 0)


def psnr(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    assert a.shape == b.shape
    return float(-10 * np.log10(max(np.mean((a.astype(np.float64) - b) ** 2), 1e-30)))


def call(browser: Browser, method: str, *arguments: Any) -> Any:
    """A function of the page's API."""
    return browser.value(f"lapgs.{method}({', '.join(map(json.dumps, arguments))})")
