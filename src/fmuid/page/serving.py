"""Serving the page to this machine alone, at an address that contains a secret token."""

from __future__ import annotations

import secrets
import socket
import webbrowser
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

from fmuid.core.errors import FmuidError

_Scope = MutableMapping[str, Any]
_Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
_Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
_App = Callable[[_Scope, _Receive, _Send], Awaitable[None]]

HOST = "127.0.0.1"
_HEADERS = (
    # The page loads nothing from elsewhere, and the browser makes sure of that.
    (
        b"content-security-policy",
        b"default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
        b"style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
        b"connect-src 'self'; frame-ancestors 'none'; form-action 'none'; base-uri 'self'",
    ),
    (b"referrer-policy", b"no-referrer"),
    (b"x-content-type-options", b"nosniff"),
)


class TokenGuard:
    """An ASGI application that passes on requests with the right token and answers 403 to all others.

    Parameters
    ----------
    app
        The application, mounted at ``/TOKEN``.
    token
        The first part of the path of every request.
    port
        The port that it is served at; requests to another host name are refused.
    """

    def __init__(self, app: _App, token: str, port: int) -> None:
        self.app = app
        self._token = token.encode()
        self._hosts = {f"{name}:{port}".encode() for name in (HOST, "localhost")}

    async def __call__(self, scope: _Scope, receive: _Receive, send: _Send) -> None:
        """Answer one request."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        given = scope["path"].split("/")[1].encode()
        host = dict(scope["headers"]).get(b"host", b"")
        if secrets.compare_digest(given, self._token) and host in self._hosts:
            await self.app(scope, receive, _with_headers(send))
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            plain = [(b"content-type", b"text/plain; charset=utf-8")]
            await send({"type": "http.response.start", "status": 403, "headers": plain})
            await send({"type": "http.response.body", "body": b"Use the address that `fmuid open` printed.\n"})


def _with_headers(send: _Send) -> _Send:
    async def sending(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), *_HEADERS]
        await send(message)

    return sending


def serve(
    build: Callable[[], object],
    *,
    title: str,
    port: int = 0,
    browser: bool = True,
    say: Callable[[str], object] = print,
) -> None:
    """Serve the page that `build` makes for each visitor, until Ctrl-C.

    Parameters
    ----------
    build
        Makes the page's elements.
    title
        Title of the page.
    port
        Port; 0 for a free one.
    browser
        Whether to open the page in the user's browser.
    say
        Called with the address.

    Raises
    ------
    FmuidError
        The port is in use, or the packages of the extra ``page`` are not installed.
    """
    import uvicorn
    from fastapi import FastAPI
    from nicegui import ui

    listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((HOST, port))
        listening.listen()
    except OSError as error:
        listening.close()
        fix = "choose another, or leave --port out"
        raise FmuidError(f"port {port} cannot be used ({error.strerror})", where="--port", fix=fix) from None
    port = listening.getsockname()[1]
    token = secrets.token_urlsafe(24)
    app = FastAPI(openapi_url=None)

    @ui.page("/", title=title, response_timeout=60.0)
    def index() -> None:
        build()

    ui.run_with(
        app,
        mount_path=f"/{token}",
        title=title,
        dark=None,
        tailwind=False,
        show_welcome_message=False,
        reconnect_timeout=30.0,
    )
    address = f"http://{HOST}:{port}/{token}/"
    guard: Any = TokenGuard(app, token, port)
    server = uvicorn.Server(uvicorn.Config(guard, log_level="warning", timeout_graceful_shutdown=1))
    say(address)
    if browser:
        webbrowser.open(address)
    with listening:
        server.run(sockets=[listening])
