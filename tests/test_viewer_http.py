"""The viewer in a browser: who may come in, and, in headless Chromium, that it shows what the painter draws."""

from __future__ import annotations

import asyncio
import re
import signal
import socket
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
import torch
from helpers.browser import CHROMIUM, Browser
from helpers.waiting import wait_for
from numpy.typing import NDArray

from lapgs_wgpu import Scene4D
from lapgs_wgpu.errors import InputError
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.io.initial_view import InitialView
from lapgs_wgpu.motion.fields.config import FieldConfig
from lapgs_wgpu.motion.fields.hash_grid_config import HashConfig
from lapgs_wgpu.splat.camera import Camera
from lapgs_wgpu.viewer import cli
from lapgs_wgpu.viewer.auth import AuthMiddleware, check_entry, new_token
from lapgs_wgpu.viewer.remote import open_entry, pages

TOKEN = "a-token_of-22-letters"
FRAMES = 31
SIZE = (480, 320)

# The guard alone


def request(
    app: Any, kind: str = "http", *, method: str = "GET", path: str = "/", query: str = "", **headers: str
) -> Any:
    """Status, headers and body of the answer. kind: http or websocket, whose status is 101 once it is let in."""
    scope = {
        "type": kind,
        "method": method,
        "path": path,
        "query_string": query.encode(),
        "headers": [(name.encode(), value.encode()) for name, value in headers.items() if value],
    }
    sent: list[Any] = []

    async def send(message: Any) -> None:
        sent.append(message)

    asyncio.run(app(scope, None, send))
    if kind == "websocket":
        return 101 if sent[0]["type"] == "websocket.accept" else 403
    assert sent[0]["type"] == "http.response.start"
    return sent[0]["status"], dict(sent[0]["headers"]), sent[1]["body"]


async def accept(scope: Any, receive: Any, send: Any) -> None:
    await send({"type": "websocket.accept"})


def guarded(**options: Any) -> AuthMiddleware:
    return AuthMiddleware(pages("scene <1>.ply", accept), **options)


@pytest.mark.parametrize("host", ["localhost", "localhost:8080", "127.0.0.1:9000", "[::1]:8080", "LOCALHOST:1"])
def test_local_names_are_let_in(host: str) -> None:
    status, headers, body = request(guarded(), host=host)
    assert status == 200
    assert b"<title>scene &lt;1&gt;.ply</title>" in body
    assert headers[b"cache-control"] == b"no-store"
    assert headers[b"x-content-type-options"] == b"nosniff"
    assert b"frame-ancestors 'none'" in headers[b"content-security-policy"]
    assert f"ws://{host.lower()} ".encode() in headers[b"content-security-policy"]
    assert b"set-cookie" not in headers


FOREIGN = [
    "",
    "evil.example",
    "evil.example:8080",
    "localhost.evil.example",
    "127.0.0.1.evil.example",
    "localhost@evil",
    "10.0.0.1",
    "localhost;x",
    "[::2]:8080",
    "localhost:8080:1",
    "[localhost]",
]


@pytest.mark.parametrize("host", FOREIGN)
def test_foreign_names_are_refused(host: str) -> None:
    status, headers, body = request(guarded(), host=host)
    assert status == 403
    assert b"does not answer to this name" in body
    assert b"<title>" not in body
    assert headers[b"x-content-type-options"] == b"nosniff"
    assert request(guarded(), "websocket", host=host, origin=f"http://{host}") == 403


def test_the_name_given_is_let_in() -> None:
    guard = guarded(names=["Viewer.example"])
    assert request(guard, host="viewer.example:8080")[0] == 200
    assert request(guard, host="10.0.0.1")[0] == 403
    anywhere = guarded(any_address=True)
    assert request(anywhere, host="10.0.0.1:8080")[0] == 200
    assert request(anywhere, host="[fe80::1]:8080")[0] == 200
    assert request(anywhere, host="evil.example")[0] == 403


def test_two_hosts_are_none() -> None:
    sent: list[Any] = []

    async def send(message: Any) -> None:
        sent.append(message)

    headers = [(b"host", b"localhost"), (b"host", b"localhost")]
    scope = {"type": "http", "method": "GET", "path": "/", "query_string": b"", "headers": headers}
    asyncio.run(guarded()(scope, None, send))  # type: ignore[arg-type]
    assert sent[0]["status"] == 403


@pytest.mark.parametrize(
    ("origin", "status"),
    [
        ("http://localhost:8080", 101),
        ("https://localhost:8080", 101),
        ("", 403),
        ("null", 403),
        ("http://localhost:3000", 403),
        ("http://127.0.0.1:8080", 403),
        ("http://evil.example", 403),
        ("http://localhost:8080.evil.example", 403),
        ("http://evil.example/http://localhost:8080", 403),
    ],
)
def test_only_our_own_page_opens_a_websocket(origin: str, status: int) -> None:
    assert request(guarded(), "websocket", path="/ws", host="localhost:8080", origin=origin) == status


def test_a_token_is_asked_for_everywhere() -> None:
    guard = guarded(token=TOKEN)
    origin = {"host": "localhost:8080", "origin": "http://localhost:8080"}
    for path in ("/", "/page.js", "/renderview.js", "/nothing"):
        status, headers, body = request(guard, path=path, host="localhost:8080")
        assert (status, body.count(b"\n")) == (403, 1)
        assert b"set-cookie" not in headers
    for wrong in ("", "token=", "token=x", f"token={TOKEN}x", f"token={TOKEN[:-1]}", f"tokens={TOKEN}", "token=%C3%A9"):
        assert request(guard, query=wrong, host="localhost:8080")[0] == 403
        assert request(guard, "websocket", query=wrong, **origin) == 403
        cookie = wrong.replace("token", guard.cookie)
        assert request(guard, "websocket", cookie=cookie, **origin) == 403
    assert request(guard, "websocket", cookie=f"other={TOKEN}", **origin) == 403

    status, headers, _ = request(guard, query=f"token={TOKEN}", host="localhost:8080")
    assert status == 200
    cookie, *attributes = headers[b"set-cookie"].decode().split("; ")
    assert set(attributes) == {"Path=/", "HttpOnly", "SameSite=Strict"}
    assert request(guard, path="/page.js", cookie=f"a=b; {cookie}", host="localhost:8080")[0] == 200
    assert request(guard, "websocket", cookie=cookie, **origin) == 101
    assert request(guard, "websocket", cookie=cookie, host="localhost:8080", origin="http://evil.example") == 403
    assert request(guard, query=f"token={TOKEN}", host="evil.example")[0] == 403
    assert guarded(token=TOKEN + "2").cookie != guard.cookie


def test_pages() -> None:
    guard = guarded()
    assert request(guard, path="/page.js", host="localhost")[1][b"content-type"].startswith(b"text/javascript")
    assert b"class BaseRenderView" in request(guard, path="/renderview.js", host="localhost")[2]
    for path in ("/index.html", "/../guard.py", "//page.js", "/page.js/", "/ws"):
        assert request(guard, path=path, host="localhost")[0] == 404, path
    assert request(guard, method="POST", host="localhost")[0] == 405
    assert request(guard, method="HEAD", host="localhost")[::2] == (200, b"")


# The options


@pytest.mark.parametrize("host", ["0.0.0.0", "::", "192.168.1.5", "viewer.example", "localhost.example"])
def test_other_machines_need_a_token(host: str) -> None:
    with pytest.raises(InputError, match="needs --token"):
        check_entry(host, None)
    check_entry(host, TOKEN)


def test_weak_tokens() -> None:
    for token in ("", "short", "15-letters-long", "x" * 300, "a token with spaces in it", "ü" * 20, "semicolon;" * 3):
        with pytest.raises(InputError, match="16 or more"):
            check_entry("127.0.0.1", token)
    check_entry("127.0.0.1", new_token())
    assert new_token() != new_token()


def test_where_it_listens() -> None:
    entry = open_entry("127.0.0.1", 0, None)
    with entry.listening:
        assert entry.listening.getsockname()[0] == "127.0.0.1"
        assert entry.url == f"http://localhost:{entry.port}/"
        assert f"ssh -L {entry.port}:localhost:{entry.port} USER@THIS_MACHINE" in entry.welcome("a.ply")
        with pytest.raises(InputError, match=f"port {entry.port} is in use"):
            open_entry("127.0.0.1", entry.port, None)
    with pytest.raises(InputError, match="no address of this machine"):
        open_entry("192.0.2.1", 0, TOKEN)
    entry = open_entry("0.0.0.0", 0, TOKEN)
    with entry.listening:
        assert entry.url == f"http://{socket.gethostname()}:{entry.port}/?token={TOKEN}"
        assert f"open http://localhost:{entry.port}/?token={TOKEN} there" in entry.welcome("a.ply")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--port", "8080"], "--port goes with --backend http"),
        (["--host", "0.0.0.0"], "--host goes with --backend http"),
        (["--token", TOKEN], "--token goes with --backend http"),
        (["--backend", "http", "--host", "0.0.0.0"], "needs --token"),
        (["--backend", "http", "--token", "short"], "16 or more"),
    ],
)
def test_mistakes_end_in_one_sentence(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.view_command(["scene.ply", *arguments]) == 2
    out, err = capsys.readouterr()
    assert message in err
    assert (out, err.count("\n")) == ("", 1)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")
def test_without_a_display_it_says_what_works(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("glfw")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM"):
        monkeypatch.delenv(name, raising=False)
    assert cli.view_command(["scene.ply"]) == 2
    assert "there is no display): take --backend http" in capsys.readouterr().err


@pytest.mark.parametrize("backend", ["glfw", "http"])
def test_a_missing_library_of_the_system_is_named(
    backend: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for package in ("uvicorn", "websockets"):
        pytest.importorskip(package)
    text = "libXext.so.6: cannot open shared object file: No such file or directory"
    (tmp_path / "imgui_bundle.py").write_text(f"raise ImportError({text!r})")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "imgui_bundle", raising=False)
    assert cli.view_command(["scene.ply", "--backend", backend]) == 2
    error = capsys.readouterr().err
    assert f"imgui-bundle cannot be loaded ({text}); install" in error
    assert "apt-get install -y libx11-6 libxext6" in error
    assert error.count("\n") == 1


# The canvas


@pytest.fixture
def sent(device: Device, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Any, list[tuple[int, str, int]]]]:
    """A canvas that its first browser has just connected to, and who was sent what: browser, kind, number."""
    http = pytest.importorskip("rendercanvas.http")
    from lapgs_wgpu.viewer.remote_canvas import RemoteCanvas

    log: list[tuple[int, str, int]] = []

    def note(message: dict[str, Any], buffers: list[bytes], id: int) -> None:
        if message["type"] == "framebufferdata":
            log.append((id, message["mimetype"], message["index"]))

    monkeypatch.setattr(http.asgi, "send_to", note)
    canvas = RemoteCanvas(device)
    canvas._on_event({"type": "_clients_change", "ids": (1,)}, 0)
    yield canvas, log
    canvas.close()


def test_the_lossless_picture_comes_also_after_a_slow_network(sent: Any) -> None:
    canvas, log = sent
    canvas._on_event({"type": "resize", "pwidth": 8, "pheight": 8, "ratio": 1}, 1)
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


def test_nothing_is_drawn_before_the_browser_has_a_size(sent: Any) -> None:
    canvas, _ = sent
    canvas._draw_requested = True
    canvas._maybe_draw()
    assert canvas._draw_requested
    huge = 1 << 30
    canvas._on_event({"type": "resize", "pwidth": huge, "pheight": 0, "ratio": 1}, 1)
    width, height = canvas.get_physical_size()
    assert 2048 <= width < huge
    assert height == 1


def test_a_watching_browser_cannot_say_who_drives(sent: Any) -> None:
    canvas, _ = sent
    canvas._on_event({"type": "_clients_change", "ids": (1, 2)}, 0)
    for ids in ((2, 1), ()):
        canvas._on_event({"type": "_clients_change", "ids": ids}, 2)
        assert canvas._active_client == 1
        assert set(canvas._frame_info_per_client) == {1, 2}


def test_what_a_leaving_browser_held_is_let_go(sent: Any) -> None:
    canvas, _ = sent
    ends: list[tuple[str, Any]] = []
    canvas.add_event_handler(lambda event: ends.append((event["event_type"], event.get("button"))), "pointer_up")
    canvas.add_event_handler(lambda event: ends.append((event["event_type"], event["key"])), "key_up")
    canvas._on_event({"type": "_clients_change", "ids": (1, 2)}, 0)
    place = {"x": 1, "y": 1, "timestamp": 0.0, "modifiers": []}
    for button in (1, 2):
        canvas._on_event({"type": "pointer_down", "button": button, "buttons": [button], **place}, 1)
    canvas._on_event({"type": "pointer_up", "button": 2, "buttons": [1], **place}, 1)
    canvas._on_event({"type": "key_down", "key": "w", "modifiers": [], "timestamp": 0.0}, 1)
    canvas._on_event({"type": "key_down", "key": "x", "modifiers": [], "timestamp": 0.0}, 2)  # only watches
    canvas._on_event({"type": "close"}, 1)
    assert not canvas.get_closed()
    canvas._on_event({"type": "_clients_change", "ids": (2,)}, 0)
    canvas._events.flush()
    assert ends == [("pointer_up", 2), ("pointer_up", 1), ("key_up", "w")]


# In a browser


@pytest.fixture(scope="module")
def scene(device: Device, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file with Gaussians that move."""
    grid = HashConfig(2, (4, 4, 4), (8, 8, 8), 10)
    random = np.random.default_rng(0)
    points, colors = random.uniform(-1, 1, (200, 3)), random.uniform(0, 1, (200, 3))
    config = FieldConfig(static=grid, temporal=grid, width=8)
    made = Scene4D.from_points(points, colors, np.full(200, 0.12), config, opacity=0.8, device=device)
    assert made.field is not None
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in made.field.parameters():
            parameter.copy_(0.3 * torch.randn(parameter.shape, generator=generator))
    camera = Camera.looking_at([0, -0.5, -4], [0, 0, 0], up=[0, -1, 0], fov_x=0.8, width=400, height=300)
    look = InitialView(camera, np.zeros(3), np.array([0.0, -1.0, 0.0]), FRAMES)
    path = tmp_path_factory.mktemp("scene") / "moving.ply"
    made.save(path, {"view": look.to_json(), "background": "black"})
    return path


class Server:
    """lapgs-view as a process of its own."""

    def __init__(self, scene: Path, *options: str) -> None:
        program = "import sys; from lapgs_wgpu.viewer.cli import view_command; sys.exit(view_command())"
        command = [sys.executable, "-c", program, str(scene), "--backend", "http", "--port", "0", *options]
        self.process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        self.said: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.url = wait_for(self._url, "the server's address")
        self.port = int(self.url.split(":")[2].split("/")[0])

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


@pytest.fixture(scope="module")
def server(scene: Path) -> Iterator[Server]:
    for package in ("uvicorn", "websockets", "imgui_bundle"):
        pytest.importorskip(package)
    started = Server(scene, "--token", TOKEN)
    try:
        yield started
    finally:
        started.process.kill()
        started.process.wait(10)


def expected(scene: Path, device: Device, size: tuple[int, int], time: float) -> NDArray[np.int16]:
    """What the painter draws where the viewer begins."""
    from lapgs_wgpu.viewer.frame import FrameRenderer, FrameRequest
    from lapgs_wgpu.viewer.loaded_scene import load_scene
    from lapgs_wgpu.viewer.present import Offscreen
    from lapgs_wgpu.viewer.viewport import MARGIN

    opened = load_scene(scene, lambda: device)
    frame = FrameRenderer(opened.playback).draw(
        FrameRequest(opened.camera().camera(*size), time, "rgb", opened.background)
    )
    return Offscreen(device)(size, [frame.placed], MARGIN).astype(np.int16)


def apart(a: NDArray[np.int16], b: NDArray[np.int16]) -> float:
    """The largest difference of two pictures, in 255ths."""
    return float(np.abs(a - b).max()) if a.shape == b.shape else np.inf


def connect_with(server: Server, **headers: str) -> None:
    from websockets.sync.client import connect

    url = f"ws://localhost:{server.port}/ws"
    with connect(url, origin=headers.pop("origin", None), additional_headers=headers, open_timeout=30) as ws:
        ws.recv(timeout=30)


def test_a_foreign_page_cannot_connect(server: Server) -> None:
    from websockets.exceptions import InvalidStatus

    cookie = f"{AuthMiddleware(accept, token=TOKEN).cookie}={TOKEN}"
    own = f"http://localhost:{server.port}"
    connect_with(server, origin=own, Cookie=cookie)
    for origin, given in (("http://evil.example", cookie), (f"http://localhost:{server.port + 1}", cookie), (own, "")):
        with pytest.raises(InvalidStatus) as refused:
            connect_with(server, origin=origin, Cookie=given)
        assert refused.value.response.status_code == 403
    with pytest.raises(urllib.error.HTTPError) as forbidden:
        urllib.request.urlopen(own, timeout=30)
    assert forbidden.value.code == 403


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_in_a_browser(server: Server, scene: Path, device: Device, tmp_path: Path) -> None:
    first, last = (expected(scene, device, SIZE, time) for time in (0.0, 1.0))
    assert apart(first, last) > 60, "the scene does not move"

    with Browser(tmp_path / "profile", SIZE) as browser:

        def shows(wanted: NDArray[np.int16]) -> bool:
            return apart(browser.picture(), wanted) <= 1

        def changes(before: NDArray[np.int16], rows: slice = slice(None)) -> bool:
            return apart(browser.picture()[rows], before[rows]) > 60

        browser.open(server.url)
        wait_for(lambda: browser.note() == "" and browser.value("picture.naturalWidth") == SIZE[0], "a picture")
        assert browser.value("document.title") == "moving.ply"
        assert browser.value("location.search") == "", "the token stays in the address"
        # Panels away: the picture is to the last bit what the painter draws.
        browser.key("h")
        wait_for(lambda: shows(first), "the picture at the start")
        browser.key("h")
        wait_for(lambda: changes(first), "the panels")

        # The slider, dragged to the middle with the mouse; from there to the next whole frame.
        scene_rows, bar_rows = slice(115, 235), slice(252, 282)
        middle, row = SIZE[0] / 2, SIZE[1] - 52
        before = browser.picture()
        browser.mouse("mouseMoved", 25, row)
        wait_for(lambda: apart(browser.picture()[bar_rows], before[bar_rows]) > 20, "the slider under the mouse")
        browser.mouse("mousePressed", 25, row, down=True)
        for x in np.linspace(25, middle, 6):
            browser.mouse("mouseMoved", float(x), row, down=True)
        wait_for(lambda: changes(first, scene_rows), "a later time")
        held = browser.picture()
        browser.mouse("mouseReleased", middle, row)
        # Until imgui has seen the release, it keeps the keys to itself.
        wait_for(lambda: apart(browser.picture()[bar_rows], held[bar_rows]) > 20, "the slider let go")
        browser.key(".")
        browser.key("h")
        time = (FRAMES // 2 + 1) / (FRAMES - 1)
        later = expected(scene, device, SIZE, time)
        wait_for(lambda: shows(later), "the frame after the middle")

        # Another size of the window.
        smaller = (400, 280)
        browser.resize(smaller)
        small = expected(scene, device, smaller, time)
        wait_for(lambda: shows(small), "the smaller picture")

        # Space plays, and stops.
        browser.key(" ")
        wait_for(lambda: changes(small), "the playing scene")
        browser.key(" ")
        browser.key("End")
        end = expected(scene, device, smaller, 1.0)
        wait_for(lambda: shows(end), "the end")

        # A second browser watches, and drives once the first one has left.
        with Browser(tmp_path / "other", SIZE) as other:
            other.open(server.url)
            wait_for(lambda: "watches" in other.note(), "the second browser's note")
            other.key("Home")
            browser.open("about:blank")
            wait_for(lambda: apart(other.picture(), last) <= 1, "the end, in the second browser's size")
            other.key("Home")
            wait_for(lambda: apart(other.picture(), first) <= 1, "the start")

            assert server.interrupt() == 130
            assert "Traceback" not in "".join(server.said)
            assert server.said[-1] == "lapgs-view: interrupted.\n"
            wait_for(lambda: "was lost" in other.note(), "the page's word of the lost connection")
