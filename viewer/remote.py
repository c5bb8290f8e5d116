"""The viewer in a browser: a web server on this machine that draws, and sends pictures."""

from __future__ import annotations

import asyncio
import errno
import html
import importlib.util
import socket
import sys
from functools import partial
from importlib import resources
from typing import Any, NamedTuple

from lapgs_wgpu.errors import InputError, pip_install
from lapgs_wgpu.viewer.auth import LOCAL, Application, AuthMiddleware, Receive, Scope, Send, answer, check_entry
from lapgs_wgpu.viewer.gui_library import check_imgui
from lapgs_wgpu.viewer.initial_state import InitialState

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8080
_EVERYWHERE = ("0.0.0.0", "::")
_TYPES = {"index.html": "text/html", "page.css": "text/css", "page.js": "text/javascript"}


class Entry(NamedTuple):
    """Where the server listens. host: as given. token: what every request needs, or None."""

    listening: socket.socket
    host: str
    token: str | None

    @property
    def port(self) -> int:
        return int(self.listening.getsockname()[1])

    @property
    def url(self) -> str:
        """To open in a browser."""
        name = "localhost" if self.host in LOCAL else socket.gethostname() if self.host in _EVERYWHERE else self.host
        query = f"?token={self.token}" if self.token else ""
        return f"http://{_bracketed(name)}:{self.port}/{query}"

    def welcome(self, name: str) -> str:
        """What the user should know: where to look, and how from another machine."""
        end = "localhost" if self.host in (*LOCAL, *_EVERYWHERE) else _bracketed(self.host)
        here = self.url.replace(self.url.split("/")[2], f"localhost:{self.port}")
        lines = [
            f"lapgs-view: {name} is shown at {self.url} until Ctrl-C.",
            f"From another machine: ssh -L {self.port}:{end}:{self.port} USER@THIS_MACHINE, then open {here} there.",
        ]
        if self.host not in LOCAL:
            lines.append("Pictures and token go over the network as they are; through the tunnel they are encrypted.")
        elif not self.token:
            lines.append("Every user of this machine can open it; with --token only who knows the address.")
        return "\n".join(lines)


def open_entry(host: str, port: int, token: str | None) -> Entry:
    """Listen. Raises InputError where that is not allowed or not possible, or a package is missing."""
    check_entry(host, token)
    missing = [name for name in ("uvicorn", "websockets", "imgui_bundle") if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"--backend http needs {', '.join(missing)}: {pip_install('remote')}.")
    check_imgui()
    address = "127.0.0.1" if host == "localhost" else host
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        return Entry(socket.create_server((address, port), family=family), host, token)
    except socket.gaierror:
        raise InputError(f"--host {host} is no address of this machine.") from None
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise InputError(f"port {port} is in use; name another with --port, 0 for any that is free.") from None
        if error.errno == errno.EADDRNOTAVAIL:
            raise InputError(f"--host {host} is no address of this machine.") from None
        raise InputError(f"--host {host} --port {port} cannot be listened on: {error.strerror}.") from None


def run_remote(scene: Any, entry: Entry, *, transport: bool | None, start: InitialState) -> None:
    """Show it to browsers until Ctrl-C, which raises KeyboardInterrupt. transport, start: as for run_window."""
    import uvicorn
    from rendercanvas.http import asgi, loop

    from lapgs_wgpu.viewer.app import App
    from lapgs_wgpu.viewer.remote_canvas import RemoteCanvas

    # rendercanvas takes Ctrl-C from uvicorn when its loop starts, closes the canvas and leaves the server running.
    loop._BaseLoop__setup_interrupt_hooks = dict
    name = scene.path.name if scene.path else "lapgs-view"
    canvas = RemoteCanvas(scene.playback.device, title=name, update_mode="ondemand", max_fps=60)
    viewer = App(canvas, loop, scene, transport=transport)
    start.apply(viewer.state)
    everywhere = entry.host in _EVERYWHERE
    names = [entry.host, entry.listening.getsockname()[0], *([socket.gethostname()] if everywhere else [])]
    guard = AuthMiddleware(pages(name, asgi), names=names, any_address=everywhere, token=entry.token)
    config = uvicorn.Config(
        guard,
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
    print(entry.welcome(str(scene.path or name)), file=sys.stderr, flush=True)
    server = uvicorn.Server(config)
    viewer.end = partial(setattr, server, "should_exit", True)
    asyncio.run(server.serve(sockets=[entry.listening]))
    if viewer.failed is not None:
        raise viewer.failed
    raise KeyboardInterrupt  # nothing else ends the server, but on a busy machine it may come to end without a word


def pages(title: str, sockets: Application) -> Application:
    """ASGI: the page and its parts, with everything that is no http left to `sockets`."""
    folder = resources.files(__package__) / "page"
    files = {name: (kind, (folder / name).read_bytes()) for name, kind in _TYPES.items()}
    page = files.pop("index.html")
    files[""] = (page[0], page[1].replace(b"TITLE", html.escape(title).encode()))
    view = resources.files("rendercanvas.core") / "renderview.js"
    files["renderview.js"] = ("text/javascript", view.read_bytes())

    async def serve(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await sockets(scope, receive, send)
        elif scope["method"] not in ("GET", "HEAD"):
            await answer(scope, send, 405, "text/plain", b"Only GET.\n")
        else:
            kind, body = files.get(scope["path"].removeprefix("/"), (None, b""))
            status = 200 if kind else 404
            await answer(scope, send, status, f"{kind or 'text/plain'}; charset=utf-8", body or b"Not here.\n")

    return serve


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
