"""What the server of the page lets through: the page's own browser, and nothing else."""

import asyncio
import subprocess
import sys
from typing import Any

import pytest


pytest.importorskip("nicegui", reason="the extra app is not installed")
from jaxquad.app._server import Guard  # noqa: E402


TOKEN = "a" * 32
HOST, COOKIE = "127.0.0.1:8000", f"jaxquad_8000={TOKEN}"
PAGE = b'<html><script type="module">own</script><script>also</script></html>'


class Behind:
    """An application that answers with a page, and reads what it is sent."""

    def __init__(self):
        self.paths: list[str] = []
        self.read = 0

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        self.paths.append(scope["path"])
        while (message := await receive())["type"] == "http.request":
            self.read += len(message["body"])
            if not message["more_body"]:
                break
        headers = [(b"content-type", b"text/html"), (b"content-length", str(len(PAGE)).encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": PAGE})


def ask(
    path: str = "/", query: str = "", headers: dict[str, str] | None = None,
    chunks: tuple[bytes, ...] = (b"",), kind: str = "http",
) -> tuple[int, dict[str, str], bytes, Behind]:  # fmt: skip
    """Status (1008 of a websocket that is closed), headers, body, and what stands behind."""
    behind, sent = Behind(), []
    guard = Guard(behind, 8000, TOKEN, largest=1000)
    given = {"host": HOST} | (headers or {})
    scope = {
        "type": kind, "path": path, "query_string": query.encode(),
        "headers": [(k.encode(), v.encode()) for k, v in given.items()],
    }  # fmt: skip
    waiting = [
        {"type": "http.request", "body": x, "more_body": k + 1 < len(chunks)}
        for k, x in enumerate(chunks)
    ]

    async def receive() -> Any:
        return waiting.pop(0) if waiting else {"type": "http.disconnect"}

    async def send(message: Any) -> None:
        sent.append(message)

    asyncio.run(guard(scope, receive, send))
    if kind == "websocket":
        return sent[0].get("code", sent[0].get("status", 200)), {}, b"", behind
    answered = {k.decode().lower(): v.decode() for k, v in sent[0]["headers"]}
    return sent[0]["status"], answered, sent[1]["body"], behind


def test_the_token_in_the_address_opens_the_page_and_becomes_a_cookie():
    status, headers, _, behind = ask(query=f"token={TOKEN}")
    assert status == 200 and behind.paths == ["/"]
    assert COOKIE in headers["set-cookie"]
    assert {"HttpOnly", "SameSite=Strict"} <= set(headers["set-cookie"].split("; "))
    assert ask(headers={"cookie": COOKIE})[0] == 200


@pytest.mark.parametrize(
    ("path", "query", "headers", "status"),
    [
        ("/", "", {}, 403),
        ("/", f"token={TOKEN[:-1]}b", {}, 403),
        ("/", f"token={TOKEN}", {"host": "evil.example:8000"}, 421),
        ("/", f"token={TOKEN}", {"host": "127.0.0.1:8001"}, 421),
        ("/", f"token={TOKEN}", {"origin": "http://evil.example"}, 403),
        ("/", f"token={TOKEN}", {"origin": "null"}, 403),
        ("/_nicegui/static/x", f"token={TOKEN}", {}, 403),
        ("/_nicegui_ws/socket.io", "", {"cookie": "jaxquad_8000=other"}, 403),
        ("/_nicegui/client/1/upload/2", "", {"cookie": COOKIE, "content-length": "1001"}, 413),
        ("/_nicegui/client/1/upload/2", "", {"cookie": COOKIE, "content-length": "-1"}, 413),
    ],
)
def test_others_are_refused_before_anything_is_read(path, query, headers, status):
    answer, _, _, behind = ask(path, query, headers, (b"x",))
    assert answer == status and behind.paths == [] and behind.read == 0


def test_a_websocket_of_another_page_is_closed():
    path = "/_nicegui_ws/socket.io"
    assert ask(path, headers={"cookie": COOKIE, "origin": "http://x"}, kind="websocket")[0] == 1008
    assert ask(path, kind="websocket")[0] == 1008


def test_a_body_without_a_length_ends_at_the_limit():
    chunks = (b"x" * 600, b"x" * 600, b"x" * 600)
    assert ask("/upload", headers={"cookie": COOKIE}, chunks=chunks)[3].read == 600


def test_the_scripts_of_the_page_have_the_nonce_of_its_policy():
    _, headers, body, _ = ask(query=f"token={TOKEN}", headers={"accept-encoding": "gzip"})
    policy = dict(x.strip().split(" ", 1) for x in headers["content-security-policy"].split(";"))
    nonces = [x for x in policy["script-src"].split() if x.startswith("'nonce-")]
    nonce = nonces[0][7:-1]
    assert body.count(f'<script nonce="{nonce}"'.encode()) == body.count(b"<script") == 2
    assert "unsafe-inline" not in policy["script-src"]
    assert policy["default-src"] == policy["form-action"] == policy["frame-ancestors"] == "'none'"
    assert int(headers["content-length"]) == len(body)
    again = ask(query=f"token={TOKEN}")[1]["content-security-policy"]
    assert again != headers["content-security-policy"]


def test_the_process_of_the_page_holds_neither_jax_nor_matplotlib():
    code = "import jaxquad.app, sys; print({'jax', 'matplotlib'} & set(sys.modules))"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.stdout.strip() == "set()", answer.stderr
