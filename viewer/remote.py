"""The viewer in a browser: a web server on this machine that draws, and sends pictures.

Any user of this machine, and any page in a browser on it, can reach the server. So all of its addresses begin with a
token that is made anew each time: who does not know it gets no page and no websocket.
"""

import asyncio
import errno
import html
import secrets
import socket
import sys
from collections.abc import Awaitable, Callable, MutableMapping
from functools import partial
from typing import Any

from rendercanvas.http import HttpRenderCanvas, asgi, loop, resources

from lapgs_wgpu.errors import InputError, optional_module
from lapgs_wgpu.gpu.device import Device
from lapgs_wgpu.viewer.app import App
from lapgs_wgpu.viewer.loaded_scene import given_scene
from lapgs_wgpu.viewer.web_page import web_file
from lapgs_wgpu.viewer.window import check_imgui

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Message, Receive, Send], Awaitable[None]]

_LOCAL = ("localhost", "127.0.0.1", "::1")
_EVERYWHERE = ("0.0.0.0", "::")


def listen(host: str, port: int) -> socket.socket:
    """Listen. Raises InputError where that is not possible, or a package is missing."""
    for name in ("uvicorn", "websockets"):
        optional_module(name, f"--backend http needs {name}", "remote")
    check_imgui()
    address = "127.0.0.1" if host == "localhost" else host
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        return socket.create_server((address, port), family=family)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise InputError(f"port {port} is in use; name another with --port, 0 for any that is free.") from None
        raise InputError(f"--host {host} --port {port} cannot be listened on: {error.strerror}.") from None


def welcome(file: str, host: str, port: int, token: str) -> str:
    """Say which address to open, here and on another machine. host: as given."""
    end = "localhost" if host in _LOCAL + _EVERYWHERE else f"[{host}]" if ":" in host else host
    name, place = socket.gethostname() if host in _EVERYWHERE else end, f"{port}/{token}/"
    text = f"""lapgs-view: {file} is shown at http://{name}:{place} until Ctrl-C.
From another machine: ssh -L {port}:{end}:{port} USER@THIS_MACHINE, then open http://localhost:{place} there."""
    if host in _LOCAL:
        return text
    return f"{text}\nPictures and token go over the network as they are; through the tunnel they are encrypted."


def run_remote(given: Any, device: Callable[[], Device]) -> None:
    """Show the file to browsers, as run_window does, until Ctrl-C, which raises KeyboardInterrupt."""
    host = given.host or "127.0.0.1"
    listening = listen(host, 8080 if given.port is None else given.port)
    import uvicorn

    scene = given_scene(given, device)
    # The page is rendercanvas's, whose scripts it uses, but its canvas fills the window.
    # rendercanvas takes Ctrl-C from uvicorn when its loop starts, closes the canvas and leaves the server running.
    loop._BaseLoop__setup_interrupt_hooks = dict
    name, token = scene.path.name, secrets.token_urlsafe(24)
    resources["index.html"] = "text/html", web_file("remote.html").replace("{{title}}", html.escape(name))
    app = App(RemoteCanvas(title=name, update_mode="ondemand", max_fps=60), loop, scene)
    app.state.begin(given)
    config = uvicorn.Config(
        guarded(asgi, token),
        log_level="warning",
        access_log=False,  # it would show the token
        server_header=False,
        proxy_headers=False,
        ws_max_size=1 << 16,  # events are small
        ws_per_message_deflate=False,  # pictures are compressed already
        # A browser that vanished without a word must not drive for ever; the server itself may be busy for seconds.
        ws_ping_interval=10,
        ws_ping_timeout=30,
        timeout_graceful_shutdown=2,
    )
    print(welcome(str(scene.path), host, listening.getsockname()[1], token), file=sys.stderr, flush=True)
    server = uvicorn.Server(config)
    app.end = partial(setattr, server, "should_exit", True)
    asyncio.run(server.serve(sockets=[listening]))
    if app.failed is not None:
        raise app.failed
    raise KeyboardInterrupt  # nothing else ends the server, but on a busy machine it may come to end without a word


def guarded(app: Application, token: str) -> Application:
    """ASGI: an app behind its token. Addresses that do not begin with it are not found, websockets are closed."""

    async def serve(scope: Message, receive: Receive, send: Send) -> None:
        given = scope.get("path", "").removeprefix("/").partition("/")[0]
        if scope["type"] == "lifespan" or secrets.compare_digest(given.encode(), token.encode()):
            await app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})  # http's 403
        else:
            await send({"type": "http.response.start", "status": 404, "headers": [(b"content-type", b"text/plain")]})
            await send({"type": "http.response.body", "body": b"Open the address that lapgs-view printed.\n"})

    return serve


class RemoteCanvas(HttpRenderCanvas):
    """rendercanvas's canvas for browsers, which is experimental, with corrections. The first browser that is connected
    drives, the others watch. Pictures go out as JPEG, and once more as PNG when nothing has moved for 0.3 seconds."""

    def __init__(self, **options: Any) -> None:
        self._sizes: dict[int, dict[str, Any]] = {}  # last resize event of each browser
        super().__init__(**options)

    def _on_event(self, event: dict[str, Any], id: int) -> None:
        driver, kind = self._active_client, event.get("type")
        if kind == "close":  # upstream closes the canvas for everybody
            return
        if kind == "resize":
            self._sizes[id] = dict(event)
        super()._on_event(event, id)
        if self._active_client != driver and self._active_client in self._sizes:  # another one, with another window
            super()._on_event(dict(self._sizes[self._active_client]), self._active_client)

    def _maybe_draw(self) -> None:
        """Also sends a picture later that could not be sent when it was made, since two were on their way: often it is
        the lossless one. Upstream does so only for several browsers."""
        super()._maybe_draw()
        if self._last_frame[0] is not None:
            self._send_last_frame_to_ready_clients()
