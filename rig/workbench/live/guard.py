"""Who may see the page and press its buttons: a layer around the whole web application.

Every request must name this computer by an address or a known name (which defeats DNS
rebinding), come from the page itself and not from another site, and, where there is a
token, carry it.
"""

from __future__ import annotations

import hmac
import ipaddress
import urllib.parse

from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

HEADERS = {
    "content-security-policy": "default-src 'self'; "
    "script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "font-src 'self' data:; object-src 'none'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'",
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
}


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
        self,
        app: ASGIApp,
        port: int,
        names: tuple[str, ...] = (),
        token: str | None = None,
    ) -> None:
        self.app = app
        self._names = {"localhost", *(name.lower() for name in names)}
        self._token = token
        self._cookie = f"jaxcal_live_{port}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            return await self.app(scope, receive, send)

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        answer = self._answer(HTTPConnection(scope))
        if answer is None:
            await self.app(scope, receive, sent)
        elif scope["type"] == "websocket":  # before it is accepted: answered with 403
            await send({"type": "websocket.close", "code": 1008})
        else:
            await answer(scope, receive, sent)

    def _answer(self, asked: HTTPConnection) -> Response | None:
        """What a request is answered; None: it may pass."""
        why = self._foreign(asked)
        if not why:
            if self._is_token(asked.cookies.get(self._cookie, "")):
                return None
            why = "no valid token: open the address that the session printed"
            given = asked.query_params.get("token", "")
            if asked.scope.get("method") == "GET" and self._is_token(given):
                # Kept in a cookie, and taken out of the address bar.
                welcome = RedirectResponse("/", 303)
                welcome.set_cookie(
                    self._cookie, given, httponly=True, samesite="strict"
                )
                return welcome
        return PlainTextResponse(f"Refused: {why}.\n", 403)

    def _foreign(self, asked: HTTPConnection) -> str:
        """Why a request does not come from this page; empty where it does."""
        headers = asked.headers
        host, origin = headers.get("host", ""), headers.get("origin")
        if not self._is_own(host):
            return f"unknown host name {host!r}: use the address that was printed"
        if origin is not None and origin.lower() != f"http://{host}".lower():
            return "a request of another site"
        if origin is None and asked.scope.get("method") not in ("GET", "HEAD"):
            return "a request without an origin"
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            if headers.get("sec-fetch-mode") != "navigate":
                return "a request of another site"
        return ""

    def _is_own(self, host: str) -> bool:
        try:
            name = urllib.parse.urlsplit(f"//{host}").hostname or ""
            return name in self._names or bool(ipaddress.ip_address(name))
        except ValueError:
            return False

    def _is_token(self, text: str) -> bool:
        """It is the token, or none is wanted."""
        known = self._token
        return known is None or hmac.compare_digest(text.encode(), known.encode())
