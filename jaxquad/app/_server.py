"""The server of the page: of this machine alone, behind a token, and gone after the last tab."""

import asyncio
import os
import re
import secrets
import socket
import sys
import tempfile
import webbrowser
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from urllib.parse import parse_qs

import uvicorn
from fastapi import FastAPI, Response
from nicegui import ui
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ._page import Page
from ._session import Sessions


LARGEST = 2 << 30  # bytes of a log
_FIRST = 600.0  # s, for which the server waits for the first tab
_TITLE = "jaxquad"


def serve(
    log: Path | None = None, *, port: int = 0, browser: bool = True, largest: int = LARGEST,
    linger: float = 60.0,
) -> None:  # fmt: skip
    """Serve the page until its last tab has been closed for a minute, or Ctrl-C.

    **Arguments:**

    - `log`: a file to open at once.
    - `port`: of 127.0.0.1; by default a free one.
    - `browser`: whether to open a browser.
    - `largest`: bytes of a log.
    - `linger`: for how long the server waits after the last tab has been closed, in s.

    **Raises:** `OSError` where the port is taken.
    """
    place = socket.socket()
    with place, tempfile.TemporaryDirectory(prefix="jaxquad-app-") as folder:
        if os.name != "nt":  # where it would let another program share the port
            place.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        place.bind(("127.0.0.1", port))
        place.listen()  # a browser that is quicker than the server waits
        os.environ["TMPDIR"] = tempfile.tempdir = folder  # of uploads and of what tasks write
        port, token = place.getsockname()[1], secrets.token_urlsafe(24)
        sessions = Sessions(Path(folder), log)
        server = uvicorn.Server(uvicorn.Config(
            Guard(_application(sessions), port, token, largest), log_level="warning",
            lifespan="on", ws_max_size=1 << 24,
        ))  # fmt: skip
        address = f"http://127.0.0.1:{port}/?token={token}"

        async def run() -> None:
            watch = asyncio.create_task(sessions.watch(server, _FIRST, linger))
            print(f"{address}\nCtrl-C ends it, and so does closing its last tab", flush=True)
            if browser:
                await asyncio.to_thread(webbrowser.open, address)
            try:
                await server.serve(sockets=[place])
            finally:
                watch.cancel()
                sessions.close()

        try:
            asyncio.run(run())
        except KeyboardInterrupt:
            print("ended", file=sys.stderr)
        finally:
            tempfile.tempdir = None
            os.environ.pop("TMPDIR", None)


def _application(sessions: Sessions) -> FastAPI:
    application = FastAPI(openapi_url=None)

    @ui.page("/")
    async def page() -> None:
        client = ui.context.client
        await client.connected()  # what follows reaches the page as data, never as a script
        if client.tab_id is not None:
            page = Page(sessions.of_tab(client))
            page.build()
            if (log := sessions.take_log()) is not None:
                page.start(page.session.open(log))

    @application.get("/results/{key}/{name:path}")
    def result(key: str, name: str, save: bool = False) -> Response:
        content = sessions.file(key, name)
        if content is None:
            return Response(status_code=404)
        shown = name.endswith(".html") and not save
        headers = {"Content-Security-Policy": "sandbox allow-scripts", "Cache-Control": "no-store"}
        if not shown:
            headers["Content-Disposition"] = f'attachment; filename="{Path(name).name}"'
        kind = "text/html; charset=utf-8" if shown else "application/octet-stream"
        return Response(content, media_type=kind, headers=headers)

    ui.run_with(
        application, title=_TITLE, dark=None, tailwind=False, language="en-US",
        show_welcome_message=False, reconnect_timeout=10.0,
    )  # fmt: skip
    return application


class Guard:
    """Lets through what the page's own browser asks for, and gives the page its policy.

    Another page that makes the browser ask has another Origin, a name that was turned to this
    machine (DNS rebinding) is another Host, and other programs do not know the token.
    """

    def __init__(self, app: ASGIApp, port: int, token: str, largest: int):
        self._app, self._token, self._largest = app, token, largest
        self._hosts = {f"127.0.0.1:{port}", f"localhost:{port}"}
        self._cookie = f"jaxquad_{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {
            key.decode("latin-1").lower(): value.decode("latin-1")
            for key, value in scope["headers"]
        }
        status = self._refused(scope, headers)
        if status:
            await _refuse(scope, send, status)
        elif scope["type"] == "http" and scope["path"] == "/":
            plain = [pair for pair in scope["headers"] if pair[0].lower() != b"accept-encoding"]
            await self._page({**scope, "headers": plain}, receive, send)
        else:
            await self._app(scope, self._bounded(receive), send)

    def _refused(self, scope: Scope, headers: dict[str, str]) -> int:
        """0, or the status of a refusal."""
        if headers.get("host") not in self._hosts:
            return 421
        origin = headers.get("origin")
        if origin is not None and origin.removeprefix("http://") not in self._hosts:
            return 403
        if scope["path"].startswith("/results/"):  # the path holds a secret of its own
            return 0
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(self._cookie)
        except CookieError:
            cookie = None
        query = parse_qs(scope.get("query_string", b"").decode("latin-1"))
        tokens = [cookie.value] if cookie is not None else []
        tokens += query.get("token", []) if scope["path"] == "/" else []
        if not any(secrets.compare_digest(text.encode(), self._token.encode()) for text in tokens):
            return 403
        length = headers.get("content-length", "0")
        return 0 if length.isdigit() and int(length) <= self._largest else 413

    def _bounded(self, receive: Receive) -> Receive:
        """A body that names no length ends where it becomes too long."""
        size = 0

        async def bounded() -> Message:
            nonlocal size
            message = await receive()
            size += len(message.get("body", b"")) if message["type"] == "http.request" else 0
            return message if size <= self._largest else {"type": "http.disconnect"}

        return bounded

    async def _page(self, scope: Scope, receive: Receive, send: Send) -> None:
        """The scripts of NiceGUI's page, and no other inline script, get the nonce."""
        nonce = secrets.token_urlsafe(16)
        start: Message = {}
        body = b""

        async def collected(message: Message) -> None:
            nonlocal start, body
            if message["type"] == "http.response.start":
                start = message
                return
            body += message.get("body", b"")
            if message.get("more_body"):
                return
            body = re.sub(rb"<script\b", f'<script nonce="{nonce}"'.encode(), body)
            policy = _POLICY.format(nonce=nonce)
            cookie = f"{self._cookie}={self._token}; HttpOnly; SameSite=Strict; Path=/"
            fixed = {
                "content-length": str(len(body)), "content-security-policy": policy,
                "set-cookie": cookie, "cache-control": "no-store",
                "referrer-policy": "no-referrer", "x-content-type-options": "nosniff",
            }  # fmt: skip
            others = [x for x in start["headers"] if x[0].decode("latin-1").lower() not in fixed]
            ours = [(key.encode(), value.encode()) for key, value in fixed.items()]
            await send({**start, "headers": [*others, *ours]})
            await send({"type": "http.response.body", "body": body})

        await self._app(scope, receive, collected)


_POLICY = (
    "default-src 'none'; script-src 'self' 'nonce-{nonce}' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self'; "
    "connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)


async def _refuse(scope: Scope, send: Send, status: int) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    text = {413: "the file is too large", 421: "open the page by the address that jaxquad printed"}
    body = text.get(
        status, "the address lacks the token: use the one that jaxquad printed"
    ).encode()
    headers = [
        (b"content-type", b"text/plain; charset=utf-8"),
        (b"content-length", str(len(body)).encode()),
    ]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
