"""Who may come in: the checks in front of the viewer's web pages and websockets.

Any page that somebody opens in a browser may send requests to servers on the same machine, and any user of a machine
may connect to its ports. So the name by which we were called is checked (a foreign name that was made to resolve to our
address, DNS rebinding), the page that opens a websocket (browsers let every page do so), and, where there is one, the
token.
"""

from __future__ import annotations

import hashlib
import ipaddress
import re
import secrets
from collections.abc import Awaitable, Callable, Iterable, MutableMapping
from typing import Any
from urllib.parse import parse_qs

from lapgs_wgpu.errors import InputError

Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

LOCAL = ("localhost", "127.0.0.1", "::1")
_TOKEN = re.compile(r"[A-Za-z0-9_-]{16,256}")  # stands in an address and in a cookie as it is
_AUTHORITY = re.compile(r"(?:\[([0-9a-f:.]+)\]|([a-z0-9_.-]+))(?::\d{1,5})?")


def new_token() -> str:
    """One that nobody guesses."""
    return secrets.token_urlsafe(24)


def check_entry(host: str, token: str | None) -> None:
    """Raises InputError where the server would be open to others than those on this machine, or the token is weak."""
    if token is not None and not _TOKEN.fullmatch(token):
        raise InputError(
            "--token needs 16 or more letters, digits, - and _; without a text after it one is made for you, "
            f"such as {new_token()}."
        )
    if host not in LOCAL and token is None:
        raise InputError(
            f"--host {host} lets other machines in, which needs --token, too (one is made where no text follows it); "
            "without both, tunnel from the other machine: ssh -L 8080:localhost:8080 USER@THIS_MACHINE."
        )


class AuthMiddleware:
    """ASGI: an app behind the checks, and with headers that keep other pages from using its answers.

    names: by which we may be called besides LOCAL, without a port. any_address: by any number, too, where we listen on
    all of them; a number cannot be made to resolve to something else.
    """

    def __init__(
        self, app: Application, *, names: Iterable[str] = (), any_address: bool = False, token: str | None = None
    ) -> None:
        self._app = app
        self._names = {name.lower() for name in (*LOCAL, *names)}
        self._any_address = any_address
        self._token = token
        # Browsers send a host's cookies to all of its ports: another viewer's must have another name.
        self.cookie = f"lapgs-view-{hashlib.sha256((token or '').encode()).hexdigest()[:8]}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        kind = scope["type"]
        if kind not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        host = _only(scope, b"host")
        reason = self._refusal(scope, host)
        if kind == "websocket":
            if reason is None:
                await self._app(scope, receive, send)
            else:
                await send({"type": "websocket.close", "code": 1008, "reason": reason})  # http's 403
            return
        headers = _headers(host if reason is None else "")
        if reason is None and self._token and self._has_token(_asked(scope)):
            headers.append((b"set-cookie", f"{self.cookie}={self._token}; Path=/; HttpOnly; SameSite=Strict".encode()))

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", []), *headers]}
            await send(message)

        if reason is None:
            await self._app(scope, receive, send_with_headers)
        else:
            await answer(scope, send_with_headers, 403, "text/plain; charset=utf-8", f"{reason}\n".encode())

    def _refusal(self, scope: Scope, host: str) -> str | None:
        """Why this request may not come in, in one sentence."""
        if not self._called(host):
            return (
                f"lapgs-view does not answer to this name; open it as localhost, or name it with --host: {host[:80]!r}."
            )
        # Only a page of ours opens a websocket to us; a program without a browser sends no origin and has no business.
        if scope["type"] == "websocket" and _only(scope, b"origin") not in (f"http://{host}", f"https://{host}"):
            return "Only lapgs-view's own page may connect."
        if self._token and not self._has_token([*_asked(scope), *_cookies(scope, self.cookie)]):
            return "lapgs-view wants its token: open the address that it printed when it started."
        return None

    def _called(self, host: str) -> bool:
        found = _AUTHORITY.fullmatch(host)
        if found is None:
            return False
        name = found[1] or found[2]
        return name in self._names or (self._any_address and _is_address(name))

    def _has_token(self, given: list[str]) -> bool:
        assert self._token is not None
        wanted = self._token.encode()
        # Every one in full, so that the time says nothing about which was nearly right.
        return any([secrets.compare_digest(wanted, text.encode()) for text in given])  # noqa: C419


async def answer(scope: Scope, send: Send, status: int, content: str, body: bytes) -> None:
    """A whole http response; HEAD gets no body."""
    headers = [(b"content-type", content.encode()), (b"content-length", str(len(body)).encode())]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": b"" if scope["method"] == "HEAD" else body})


def _headers(host: str) -> list[tuple[bytes, bytes]]:
    sockets = f" ws://{host} wss://{host}" if host else ""  # not every browser counts them as 'self'
    policy = (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src blob: data:; "
        f"connect-src 'self'{sockets}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return [
        (b"content-security-policy", policy.encode()),
        (b"cache-control", b"no-store"),
        (b"x-content-type-options", b"nosniff"),
        (b"x-frame-options", b"DENY"),
        (b"referrer-policy", b"no-referrer"),  # the address may hold the token
        (b"cross-origin-opener-policy", b"same-origin"),
        (b"cross-origin-resource-policy", b"same-origin"),
    ]


def _only(scope: Scope, name: bytes) -> str:
    """A header's value in lower case; empty where it is missing or stands there twice."""
    values = [value for key, value in scope["headers"] if key == name]
    return values[0].decode("latin-1").lower() if len(values) == 1 else ""


def _asked(scope: Scope) -> list[str]:
    """The tokens in the address."""
    return parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [])


def _cookies(scope: Scope, name: str) -> list[str]:
    lines = [value.decode("latin-1") for key, value in scope["headers"] if key == b"cookie"]
    pairs = [part.strip().partition("=") for line in lines for part in line.split(";")]
    return [value for key, _, value in pairs if key == name]


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
