"""The viewer in a browser: a web server on this machine that draws, and sends pictures.

Any user of this machine, and any page in a browser on it, can reach the server. So all of its addresses begin with a
token that is made anew each time: who does not know it gets no page and no websocket.
"""

from __future__ import annotations

import asyncio
import errno
import html
import importlib.util
import secrets
import socket
import sys
from collections.abc import Awaitable, Callable, MutableMapping
from functools import partial
from typing import Any, NamedTuple

from lapgs_wgpu.errors import InputError, pip_install
from lapgs_wgpu.viewer.loaded_scene import LoadedScene
from lapgs_wgpu.viewer.view_state import ViewState
from lapgs_wgpu.viewer.web_page import web_file
from lapgs_wgpu.viewer.window import check_imgui

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Message, Receive, Send], Awaitable[None]]

_LOCAL = ("localhost", "127.0.0.1", "::1")
_EVERYWHERE = ("0.0.0.0", "::")


class Entry(NamedTuple):
    """Where the server listens. host: as given. token: with which all addresses begin."""

    listening: socket.socket
    host: str
    token: str

    @property
    def port(self) -> int:
        return int(self.listening.getsockname()[1])

    def welcome(self, file: str) -> str:
        """Say which address to open, here and on another machine."""
        name = end = f"[{self.host}]" if ":" in self.host else self.host
        if self.host in _LOCAL:
            name = end = "localhost"
        if self.host in _EVERYWHERE:
            name, end = socket.gethostname(), "localhost"
        port, place = self.port, f"{self.port}/{self.token}/"
        lines = [
            f"lapgs-view: {file} is shown at http://{name}:{place} until Ctrl-C.",
            f"From another machine: ssh -L {port}:{end}:{port} USER@THIS_MACHINE, then open "
            f"http://localhost:{place} there.",
        ]
        if self.host not in _LOCAL:
            lines.append("Pictures and token go over the network as they are; through the tunnel they are encrypted.")
        return "\n".join(lines)


def open_entry(host: str, port: int) -> Entry:
    """Listen. Raises InputError where that is not possible, or a package is missing."""
    missing = [name for name in ("uvicorn", "websockets", "imgui_bundle") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"--backend http needs {', '.join(missing)}: {pip_install('remote')}.")
    check_imgui()
    address = "127.0.0.1" if host == "localhost" else host
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        return Entry(socket.create_server((address, port), family=family), host, secrets.token_urlsafe(24))
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise InputError(f"port {port} is in use; name another with --port, 0 for any that is free.") from None
        raise InputError(f"--host {host} --port {port} cannot be listened on: {error.strerror}.") from None


def run_remote(scene: LoadedScene, entry: Entry, start: Callable[[ViewState], None]) -> None:
    """Show it to browsers until Ctrl-C, which raises KeyboardInterrupt. start: as for run_window."""
    import uvicorn
    from rendercanvas.http import asgi, loop, resources

    from lapgs_wgpu.viewer.app import App
    from lapgs_wgpu.viewer.remote_canvas import RemoteCanvas

    # The page is rendercanvas's, whose scripts it uses, but its canvas fills the window.
    # rendercanvas takes Ctrl-C from uvicorn when its loop starts, closes the canvas and leaves the server running.
    loop._BaseLoop__setup_interrupt_hooks = dict
    name = scene.path.name
    resources["index.html"] = "text/html", web_file("remote.html").replace("{{title}}", html.escape(name))
    app = App(RemoteCanvas(title=name, update_mode="ondemand", max_fps=60), loop, scene)
    start(app.state)
    config = uvicorn.Config(
        guarded(asgi, entry.token),
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
    print(entry.welcome(str(scene.path)), file=sys.stderr, flush=True)
    server = uvicorn.Server(config)
    app.end = partial(setattr, server, "should_exit", True)
    asyncio.run(server.serve(sockets=[entry.listening]))
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
