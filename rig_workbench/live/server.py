"""The page's web server: one run, any number of browsers of this computer."""

from __future__ import annotations

import asyncio
import contextlib
import pathlib
import signal
import socket
import time
from collections.abc import AsyncIterator
from typing import Literal

import uvicorn
from fastapi import FastAPI, HTTPException
from fastapi.responses import FileResponse, PlainTextResponse
from nicegui import Client, ui
from starlette.datastructures import Headers, MutableHeaders
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rig.faults import PAUSE, Fault, Refused
from rig.pages import HOST
from rig_workbench.live.page import make_page
from rig_workbench.live.watcher import Watcher

HERE = pathlib.Path(__file__).parent
POLL_S = 0.05
LINGER_S = 600.0  # after the session's end and the last look of a browser
HEADERS = {
    "content-security-policy": "default-src 'self'; "
    "script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "font-src 'self' data:; object-src 'none'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "same-origin",
}


def guarded(app: ASGIApp) -> ASGIApp:
    """Only requests of the page itself reach it: the name by which it is called defeats
    DNS rebinding; what another site's page sends, by its origin, is answered 403."""

    async def guard(scope: Scope, receive: Receive, send: Send) -> None:
        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(HEADERS)
            await send(message)

        if scope["type"] in ("http", "websocket"):
            headers = Headers(scope=scope)
            origin = f"http://{headers['host']}"
            reads = scope.get("method") in ("GET", "HEAD")
            if headers.get("origin", origin if reads else "").lower() != origin.lower():
                text = "Refused: a request from another site.\n"
                return await PlainTextResponse(text, 403)(scope, receive, send)
        await app(scope, receive, sent)

    return TrustedHostMiddleware(guard, [HOST, "localhost"])


def make_app(watcher: Watcher, linger_s: float | None = None) -> FastAPI:
    """The application, unguarded. The server ends when no session ran and no browser
    looked for ``linger_s``; None: never."""

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        task = asyncio.create_task(_watch(watcher, linger_s))
        yield
        task.cancel()

    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None, lifespan=lifespan)

    @app.exception_handler(Refused)
    @app.exception_handler(Fault)
    async def failed(request: object, error: Exception) -> PlainTextResponse:
        return PlainTextResponse(str(error), 409 if isinstance(error, Refused) else 503)

    @app.post("/stop")
    async def stop() -> PlainTextResponse:
        units = await asyncio.to_thread(watcher.stop)
        lines = "; ".join(map(str, units)) or "nothing was armed"
        if all(unit.acknowledged and unit.standing for unit in units):
            return PlainTextResponse(f"STOPPED: {lines}")
        raise Fault(f"NOT ALL DRIVES ARE AT REST: use the emergency stop. {lines}")

    @app.post("/pause")
    async def pause() -> PlainTextResponse:
        watcher.ask(PAUSE)
        return PlainTextResponse("pause requested: it finishes this posture first")

    @app.get("/report")
    async def report() -> FileResponse:
        if watcher.report is None:
            raise HTTPException(404, "no report yet: jaxcal-rig report writes one")
        return FileResponse(watcher.report)

    @app.get("/page.{kind}")
    async def file(kind: Literal["css", "js"]) -> FileResponse:
        fresh = {"Cache-Control": "no-cache"}
        return FileResponse(HERE / f"page.{kind}", headers=fresh)

    ui.run_with(
        app,
        root=make_page(watcher),
        title=f"jaxcal {watcher.folder.name}",
        dark=None,
        favicon="🦶",
        tailwind=False,
        show_welcome_message=False,
        reconnect_timeout=10.0,
    )
    return app


async def _watch(watcher: Watcher, linger_s: float | None) -> None:
    needed = time.monotonic()
    while True:
        watcher.poll()
        looked_at = any(c.has_socket_connection for c in Client.instances.values())
        if watcher.running or looked_at:
            needed = time.monotonic()
        elif linger_s is not None and time.monotonic() - needed > linger_s:
            signal.raise_signal(signal.SIGTERM)  # uvicorn closes in good order
            return
        await asyncio.sleep(POLL_S)


def serve(
    folder: pathlib.Path, sock: socket.socket, linger_s: float | None = None
) -> None:
    """Serve the page of a run on a listening socket until interrupted."""
    watcher = Watcher(folder)
    watcher.poll()
    config = uvicorn.Config(
        guarded(make_app(watcher, linger_s)),
        log_level="warning",
        ws="wsproto",
        proxy_headers=False,
        server_header=False,
        timeout_graceful_shutdown=1,
    )
    uvicorn.Server(config).run(sockets=[sock])
