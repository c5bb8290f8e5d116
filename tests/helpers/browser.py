"""Headless Chromium, driven over its DevTools protocol: real mouse and key events, and what is on the screen."""

import base64
import contextlib
import io
import json
import shutil
import subprocess
import urllib.request
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from helpers.waiting import wait_for
from numpy.typing import NDArray
from PIL import Image

CHROMIUM = next((path for path in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if path), None)
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--force-color-profile=srgb",
    "--remote-debugging-port=0",
)
NO_GPU = ("--disable-gpu",)
# WebGPU, and a canvas that it draws on, by SwiftShader, which comes with Chromium.
WEBGPU = (
    "--enable-unsafe-webgpu",
    "--use-webgpu-adapter=swiftshader",
    "--enable-features=Vulkan",
    "--use-vulkan=swiftshader",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-watchdog",
)


class Browser:
    """One window of a fresh profile, of `size` pixels. Leave the `with` block to end it.

    graphics: NO_GPU or WEBGPU.
    """

    def __init__(self, profile: Path, size: tuple[int, int], graphics: tuple[str, ...] = NO_GPU) -> None:
        from websockets.sync.client import connect

        assert CHROMIUM is not None
        self._open = contextlib.ExitStack()
        self._process = subprocess.Popen(
            [CHROMIUM, *_FLAGS, *graphics, f"--user-data-dir={profile}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            active = profile / "DevToolsActivePort"
            port = int(wait_for(lambda: active.is_file() and active.read_text().split(), "Chromium's port")[0])
            page = wait_for(lambda: _page(port), "Chromium's page")
            self._socket = self._open.enter_context(connect(page, max_size=None, open_timeout=30))
            self._calls = 0
            self.call("Page.enable")
            self.resize(size)
            self.call("Emulation.setFocusEmulationEnabled", enabled=True)
        except BaseException:
            self._end()
            raise

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._end()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """A command of the protocol, and its result."""
        self._calls += 1
        self._socket.send(json.dumps({"id": self._calls, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=300))
            if message.get("id") == self._calls:
                assert "error" not in message, message
                return message["result"]

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)

    def resize(self, size: tuple[int, int]) -> None:
        width, height = size
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def value(self, script: str) -> Any:
        """What a JavaScript expression, or the promise that it is, gives on the page. Fails where it throws."""
        done = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def note(self) -> str:
        """What the page says, empty while it shows pictures."""
        return self.value("document.getElementById('note')?.textContent ?? 'no page'")

    def picture(self) -> NDArray[np.int16]:
        """(height, width, 3): what is on the screen."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")).astype(np.int16)

    def mouse(self, kind: str, x: float, y: float, *, down: bool = False) -> None:
        """kind: mouseMoved, mousePressed or mouseReleased, of the left button."""
        pressed = {"button": "left", "clickCount": 1} if kind != "mouseMoved" or down else {}
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, buttons=int(down), **pressed)

    def key(self, key: str) -> None:
        self.call("Input.dispatchKeyEvent", type="keyDown", key=key, text=key if len(key) == 1 else "")
        self.call("Input.dispatchKeyEvent", type="keyUp", key=key)

    def _end(self) -> None:
        self._open.close()
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(10)


def _page(port: int) -> str | None:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=10) as answer:
            pages = [target for target in json.load(answer) if target["type"] == "page"]
    except OSError:
        return None
    return pages[0]["webSocketDebuggerUrl"] if pages else None
