"""Access control: a request needs the key of this start, and must come from pages of this address, over this address.

Every request needs the key, as other users of this computer reach its loopback, too. The printed address has the key
once; then it is kept in a cookie that scripts cannot read. A page can load from and connect to this server only.
"""

import hmac
import re
import secrets
from http.cookies import CookieError, SimpleCookie
from typing import Final
from urllib.parse import parse_qs, urlencode

from starlette.types import ASGIApp, Message, Receive, Scope, Send

POLICY: Final = (
    "default-src 'self'; script-src 'self' 'nonce-{nonce}' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; worker-src 'self' blob:; "
    "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
)
"""Vue and WebGL plots compile their templates in the page, which needs 'unsafe-eval'; an inline script needs the nonce,
which differs for every page."""
HEADERS: Final = (
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
)
_SCRIPT: Final = re.compile(rb"<script\b")


class Guard:
    """Admits only requests with the key; adds the policy to every page.

    Args:
        app: the guarded application.
        token: the key.
        port: port of the server, as ports share cookies.
    """

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self.app, self._token, self._cookie = app, token, f"rtec-studio-{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one request."""
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers = {k.decode("latin-1"): v.decode("latin-1") for k, v in scope["headers"]}
        if scope["type"] == "http" and self._asked_with_token(scope):
            await self._admit(scope, send)
        elif not self._may(headers):
            await _refuse(scope, receive, send)
        else:
            await self.app(scope, receive, _WithPolicy(send) if scope["type"] == "http" else send)

    def _asked_with_token(self, scope: Scope) -> bool:
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        return scope["method"] == "GET" and self._is_token(given)

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self._token.encode())

    def _may(self, headers: dict[str, str]) -> bool:
        origin = headers.get("origin")
        if origin is not None and origin.partition("://")[2] != headers.get("host"):
            return False
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(self._cookie)
        except CookieError:
            return False
        return cookie is not None and self._is_token(cookie.value)

    async def _admit(self, scope: Scope, send: Send) -> None:
        query = parse_qs(scope["query_string"].decode("latin-1"))
        rest = urlencode({k: v[0] for k, v in query.items() if k != "token"})
        secure = "; Secure" if scope["scheme"] == "https" else ""
        cookie = f"{self._cookie}={self._token}; HttpOnly; SameSite=Strict; Path=/{secure}"
        where = scope["path"].lstrip("/")
        where = f"/{where}" + (f"?{rest}" if rest else "")
        headers = [(b"location", where.encode()), (b"set-cookie", cookie.encode()), *HEADERS]
        await send({"type": "http.response.start", "status": 303, "headers": headers})
        await send({"type": "http.response.body", "body": b""})


async def _refuse(scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 4403})
        return
    text = b"Open the whole address that `rtec studio` printed: it holds the key of this start.\n"
    headers = [(b"content-type", b"text/plain; charset=utf-8"), *HEADERS]
    await send({"type": "http.response.start", "status": 403, "headers": headers})
    await send({"type": "http.response.body", "body": text})


class _WithPolicy:
    """Sends an answer with its policy; the scripts of a page get the nonce."""

    def __init__(self, send: Send) -> None:
        self._send, self._nonce = send, secrets.token_urlsafe(16)
        self._is_page = False
        self._kept = b""

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            policy = (b"content-security-policy", POLICY.format(nonce=self._nonce).encode())
            self._is_page = _header(message, b"content-type").startswith(b"text/html")
            # The nonces make a page longer than its header states.
            kept = [(k, v) for k, v in message["headers"] if not self._is_page or k.lower() != b"content-length"]
            message["headers"] = [*kept, policy, *HEADERS]
        elif message["type"] == "http.response.body" and self._is_page:
            # A tag may be split between two messages: its first half waits for the second.
            text = self._kept + message.get("body", b"")
            cut = text.rfind(b"<") if message.get("more_body") else len(text)
            self._kept = text[cut:] if cut >= 0 else b""
            text = text[:cut] if cut >= 0 else text
            message["body"] = _SCRIPT.sub(b'<script nonce="' + self._nonce.encode() + b'"', text)
        await self._send(message)


def _header(message: Message, name: bytes) -> bytes:
    return next((bytes(v) for k, v in message["headers"] if k.lower() == name), b"")
