"""Who may see the page and press its buttons: a layer around the whole web application.

Every request must name this computer by an address or a known name (which defeats DNS
rebinding), come from the page itself and not from another site, and, where there is a
token, carry it.
"""

from __future__ import annotations

import hmac
import ipaddress
import urllib.parse
from collections.abc import Awaitable, Callable, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Any]]
Send = Callable[[Any], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "font-src 'self' data:; object-src 'none'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)
HEADERS = [
    (b"content-security-policy", POLICY.encode()),
    (b"x-frame-options", b"DENY"),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"same-origin"),
]
READS = ("GET", "HEAD")


class Guard:
    """Lets through what may pass, and answers 403 to everything else.

    Args:
        app: the application.
        port: of this server; part of the cookie's name, as a browser sends the cookies
            of one host to all its ports.
        names: host names by which it may be called, besides addresses and localhost.
        token: what a browser must bring once as ``/?token=``; None: nothing.
    """

    def __init__(
        self, app: App, port: int, names: tuple[str, ...] = (), token: str | None = None
    ) -> None:
        self.app = app
        self._names = {"localhost", *(name.lower() for name in names)}
        self._token = token
        self._cookie = f"jaxcal_live_{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            return await self.app(scope, receive, send)
        headers = {
            name.decode("latin-1").lower(): value.decode("latin-1")
            for name, value in scope["headers"]
        }
        if refusal := self._foreign(scope, headers):
            return await _refuse(scope, send, refusal)
        if self._token is not None and not self._known(headers):
            given = urllib.parse.parse_qs(scope["query_string"].decode("latin-1"))
            if scope["type"] == "http" and scope["method"] == "GET":
                if self._is_token(given.get("token", [""])[0]):
                    return await self._welcome(send)
            text = "no valid token: open the address that the session printed"
            return await _refuse(scope, send, text)

        async def sent(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *HEADERS]
            await send(message)

        await self.app(scope, receive, sent)

    def _foreign(self, scope: Scope, headers: dict[str, str]) -> str:
        """Why a request does not come from this page; empty where it does."""
        host, origin = headers.get("host", ""), headers.get("origin")
        if not self._is_own(host):
            return f"unknown host name {host!r}: use the address that was printed"
        if origin is not None and origin.lower() != f"http://{host}".lower():
            return "a request of another site"
        changes = scope["type"] == "websocket" or scope["method"] not in READS
        if changes and origin is None:
            return "a request without an origin"
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            if headers.get("sec-fetch-mode") != "navigate":
                return "a request of another site"
        return ""

    def _is_own(self, host: str) -> bool:
        try:
            name = urllib.parse.urlsplit(f"//{host}").hostname or ""
            if name in self._names:
                return True
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True

    def _known(self, headers: dict[str, str]) -> bool:
        try:
            cookie = SimpleCookie(headers.get("cookie", "")).get(self._cookie)
        except CookieError:
            return False
        return cookie is not None and self._is_token(cookie.value)

    def _is_token(self, text: str) -> bool:
        return hmac.compare_digest(text.encode(), str(self._token).encode())

    async def _welcome(self, send: Send) -> None:
        """Keep the token in a cookie, and take it out of the address bar."""
        cookie = f"{self._cookie}={self._token}; HttpOnly; SameSite=Strict; Path=/"
        more = [(b"location", b"/"), (b"set-cookie", cookie.encode())]
        await _answer(send, 303, "", more)


async def _refuse(scope: Scope, send: Send, text: str) -> None:
    if scope["type"] == "websocket":  # before it is accepted: answered with 403
        await send({"type": "websocket.close", "code": 1008, "reason": text})
    else:
        await _answer(send, 403, f"Refused: {text}.\n", [])


async def _answer(
    send: Send, status: int, text: str, more: list[tuple[bytes, bytes]]
) -> None:
    body = text.encode()
    headers = [
        (b"content-type", b"text/plain; charset=utf-8"),
        (b"content-length", str(len(body)).encode()),
        (b"cache-control", b"no-store"),
        *HEADERS,
        *more,
    ]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
