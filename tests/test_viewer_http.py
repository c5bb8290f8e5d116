"""The viewer in a browser: who may come in, and, in headless Chromium, that it shows what the desktop draws."""

import asyncio
import re
import signal
import subprocess
import sys
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.browser import CHROMIUM, Browser
from helpers.scene_files import moving_scene
from helpers.waiting import wait_for
from helpers.web_pages import FRAMES, LOOK
from numpy.typing import NDArray

from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.viewer import cli
from lapgs_wgpu.viewer.loaded_scene import load_scene
from lapgs_wgpu.viewer.offscreen import OffscreenRenderer
from lapgs_wgpu.viewer.remote import RemoteCanvas, guarded, listen, welcome

TOKEN = "a-token_of-22-letters"
SIZE = (480, 320)

# The token


def let_in(kind: str, path: str) -> bool:
    """Whether a request comes through to the app."""
    sent: list[Any] = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "inside"})

    async def send(message: Any) -> None:
        sent.append(message)

    asyncio.run(guarded(app, TOKEN)({"type": kind, "path": path}, None, send))  # type: ignore[arg-type]
    if kind == "http" and len(sent) > 1:
        assert sent[0]["status"] == 404
    return sent == [{"type": "inside"}]


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_who_does_not_know_the_token_gets_nothing(kind: str) -> None:
    for path in ("", "/", "/renderview.js", "//", f"/{TOKEN}x/", f"/{TOKEN[:-1]}/", f"/x/{TOKEN}/", "/tökén/"):
        assert not let_in(kind, path), path
    for path in (f"/{TOKEN}/", f"/{TOKEN}/renderview.js", f"/{TOKEN}"):
        assert let_in(kind, path), path


def test_where_it_listens() -> None:
    for package in ("uvicorn", "websockets", "imgui_bundle"):
        pytest.importorskip(package)
    with listen("127.0.0.1", 0) as listening:
        host, port = listening.getsockname()
        assert host == "127.0.0.1"
        told = welcome("a.ply", host, port, TOKEN)
        assert f"http://localhost:{port}/{TOKEN}/ " in told
        assert f"ssh -L {port}:localhost:{port} USER@THIS_MACHINE" in told
        with pytest.raises(InputError, match=f"port {port}"):
            listen("127.0.0.1", port)
    for host in ("192.0.2.1", "no.such.name.example"):
        with pytest.raises(InputError, match="--host"):
            listen(host, 0)


def test_a_missing_library_of_the_system_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "imgui_bundle.py").write_text("raise ImportError('libXext.so.6: cannot open shared object file')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "imgui_bundle", raising=False)
    assert cli.view_command(["scene.ply"]) == 2
    assert "libXext.so.6" in capsys.readouterr().err


# The canvas


@pytest.fixture
def sent(device: Device, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Any, list[tuple[int, str, int]]]]:
    """A canvas that its first browser has just connected to, and who was sent what: browser, kind, number."""
    http = pytest.importorskip("rendercanvas.http")
    log: list[tuple[int, str, int]] = []

    def note(message: dict[str, Any], buffers: list[bytes], id: int) -> None:
        if message["type"] == "framebufferdata":
            log.append((id, message["mimetype"], message["index"]))

    monkeypatch.setattr(http.asgi, "send_to", note)
    canvas = RemoteCanvas()
    canvas._on_event({"type": "_clients_change", "ids": (1,)}, 0)
    yield canvas, log
    canvas.close()


def test_the_lossless_picture_comes_also_after_a_slow_network(sent: Any) -> None:
    canvas, log = sent
    canvas._draw_requested = False

    async def slow() -> None:
        for _ in range(2):
            canvas._encode_frame(np.zeros((8, 8, 4), np.uint8))
        canvas._lossless_draw()  # while both are on their way
        assert [kind for _, kind, _ in log] == ["image/jpeg"] * 2
        canvas._on_event({"type": "_framefeedback", "index": 2, "timestamp": 0.0}, 1)
        canvas._maybe_draw()

    asyncio.run(slow())
    assert log[2:] == [(1, "image/png", 3)]


# In a browser


@pytest.fixture(scope="module")
def scene(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "moving.ply"
    moving_scene(device, count=200).save(path, {"view": LOOK.to_json(), "background": "black"})
    return path


class Server:
    """lapgs-view as a process of its own, at a port that is free."""

    def __init__(self, scene: Path) -> None:
        program = "import sys; from lapgs_wgpu.viewer.cli import view_command; sys.exit(view_command())"
        command = [sys.executable, "-c", program, str(scene), "--backend", "http", "--port", "0"]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        self.said: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.url = wait_for(self._url, "the server's address")

    def _read(self) -> None:
        assert self.process.stderr is not None
        self.said.extend(self.process.stderr)

    def _url(self) -> str | None:
        assert self.process.poll() is None, self.said
        found = re.search(r"http://\S+", "".join(self.said))
        return found[0] if found else None

    def interrupt(self) -> int:
        """Ctrl-C; the exit code."""
        self.process.send_signal(signal.SIGINT)
        code = self.process.wait(30)
        self._reader.join(10)
        return code


@pytest.fixture
def server(scene: Path) -> Iterator[Server]:
    for package in ("uvicorn", "websockets", "imgui_bundle"):
        pytest.importorskip(package)
    started = Server(scene)
    try:
        yield started
    finally:
        started.process.kill()
        started.process.wait(10)


def expected(scene: Path, device: Device, size: tuple[int, int], time: float) -> NDArray[np.int16]:
    """What the desktop draws where the viewer begins."""
    opened = load_scene(scene, lambda: device)
    return OffscreenRenderer(opened)(opened.camera().camera(*size), time).astype(np.int16)


def apart(a: NDArray[np.int16], b: NDArray[np.int16]) -> float:
    """The largest difference of two pictures in 255ths, but for their first rows, where the page tells its status."""
    return float(np.abs(a - b)[24:].max()) if a.shape == b.shape else np.inf


@pytest.mark.nightly
@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_in_a_browser(server: Server, scene: Path, device: Device, tmp_path: Path) -> None:
    first, last = (expected(scene, device, SIZE, time) for time in (0.0, 1.0))
    assert apart(first, last) > 60, "the scene does not move"
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(re.sub(r"/[\w-]{22,}/$", "/", server.url), timeout=30)
    assert refused.value.code == 404
    with Browser(tmp_path / "profile", SIZE) as browser:
        browser.open(server.url)
        wait_for(lambda: browser.value("document.querySelector('img')?.naturalWidth") == SIZE[0], "a picture")
        assert browser.value("document.title") == "moving.ply"
        for kind in ("mousePressed", "mouseReleased"):  # gives the picture the keys
            browser.mouse(kind, 300, 150, down=kind == "mousePressed")
        wait_for(lambda: browser.value("document.activeElement?.tagName") == "INPUT", "the focus")
        # Panels away: the picture is what the desktop draws.
        browser.key("h")
        wait_for(lambda: apart(browser.picture(), first) <= 1, "the picture at the start")
        browser.key("End")
        wait_for(lambda: apart(browser.picture(), last) <= 1, "the picture at the end")
        browser.key(",")
        small, time = (400, 280), (FRAMES - 2) / (FRAMES - 1)
        browser.resize(small)
        wait_for(lambda: apart(browser.picture(), expected(scene, device, small, time)) <= 1, "another size")
        # A second browser watches, and drives once the first one has left.
        with Browser(tmp_path / "other", SIZE) as other:
            other.open(server.url)
            wait_for(lambda: "passive" in other.value("document.body?.innerText ?? ''"), "a browser that watches")
            browser.open("about:blank")
            before = expected(scene, device, SIZE, time)
            wait_for(lambda: apart(other.picture(), before) <= 1, "the second browser's size")
            assert server.interrupt() == 130
            assert "Traceback" not in "".join(server.said)
            assert server.said[-1] == "lapgs-view: interrupted.\n"
