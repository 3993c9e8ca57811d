"""Who may open the pages. Oracle: the rules of docs/studio.md, asked of the ASGI interface itself."""

import asyncio
from typing import Any

import pytest

from rtec.studio.server.guard import Guard

TOKEN = "a-token-for-tests-only"  # noqa: S105
PAGE = b"<html><script>1</script></html>"


async def _page(scope: Any, receive: Any, send: Any) -> None:
    del receive
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    head = [(b"content-type", b"text/html"), (b"content-length", str(len(PAGE)).encode())]
    await send({"type": "http.response.start", "status": 200, "headers": head})
    await send({"type": "http.response.body", "body": PAGE[:10], "more_body": True})
    await send({"type": "http.response.body", "body": PAGE[10:]})


def _ask(kind: str = "http", query: str = "", **headers: str) -> list[dict[str, Any]]:
    sent: list[dict[str, Any]] = []
    scope = {
        "type": kind, "method": "GET", "path": "/compare", "query_string": query.encode(), "scheme": "http",
        "headers": [(k.encode(), v.encode()) for k, v in {"host": "127.0.0.1:8371", **headers}.items()],
    }  # fmt: skip

    async def receive() -> dict[str, Any]:
        return {"type": "websocket.connect"}

    async def send(message: Any) -> None:
        sent.append(message)

    asyncio.run(Guard(_page, TOKEN, 8371)(scope, receive, send))
    return sent


COOKIE = f"rtec-studio-8371={TOKEN}"


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"cookie": "rtec-studio-8371=wrong"},
        {"cookie": f"rtec-studio-8372={TOKEN}"},
        {"cookie": COOKIE, "origin": "http://127.0.0.1:9999"},
        {"cookie": COOKIE, "origin": "https://evil.example"},
    ],
)
def test_without_the_key_or_from_elsewhere_nothing_is_shown(headers: dict[str, str]) -> None:
    """Pages and sockets alike; another port of this computer is elsewhere too."""
    assert _ask(**headers)[0]["status"] == 403
    assert [m["type"] for m in _ask("websocket", **headers)] == ["websocket.close"]


def test_the_key_is_taken_out_of_the_address() -> None:
    """It is kept in a cookie that no script reads and no other site sends."""
    (start, _) = _ask(query=f"token={TOKEN}&x=1")
    head = dict(start["headers"])
    assert start["status"] == 303
    assert head[b"location"] == b"/compare?x=1"
    assert {b"HttpOnly", b"SameSite=Strict"} <= set(head[b"set-cookie"].split(b"; "))


def test_a_page_comes_with_a_policy_that_lets_nothing_out() -> None:
    """Scripts need the nonce of this page, wherever the page is cut in two; it says no length, as that has changed."""
    (start, *bodies) = _ask(cookie=COOKIE, origin="http://127.0.0.1:8371")
    head = dict(start["headers"])
    policy = head[b"content-security-policy"].decode()
    nonce = policy.split("'nonce-")[1].split("'")[0]
    sent = b"".join(body["body"] for body in bodies)
    assert sent == PAGE.replace(b"<script", f'<script nonce="{nonce}"'.encode())
    assert b"content-length" not in head
    assert "default-src 'self'" in policy
    assert "http" not in policy.replace("https", "http").split("script-src")[0]
    assert "'unsafe-inline'" not in policy.split("script-src")[1].split(";")[0]
    assert policy != dict(_ask(cookie=COOKIE)[0]["headers"])[b"content-security-policy"].decode()
