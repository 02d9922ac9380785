"""The page's web server: one run, any number of browsers.

``python -m rig.workbench.live.server FOLDER FD`` is the page as `--live` starts it, on
a listening socket.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import pathlib
import signal
import socket
import sys
import time
from collections.abc import AsyncIterator
from typing import Literal

import uvicorn
from fastapi import FastAPI, HTTPException
from fastapi.responses import FileResponse, PlainTextResponse
from nicegui import Client, ui

from rig.core.faults import Fault, Refused
from rig.signals import PAUSE
from rig.workbench.live.guard import Guard
from rig.workbench.live.launch import TOKEN
from rig.workbench.live.page import make_page
from rig.workbench.live.watcher import Watcher

HERE = pathlib.Path(__file__).parent
POLL_S = 0.05
LINGER_S = 600.0  # after the session's end and the last look of a browser


def make_app(watcher: Watcher, linger_s: float | None = None) -> FastAPI:
    """The application, unguarded.

    Args:
        watcher: of the run that is shown.
        linger_s: end the server when no session ran and no browser looked for so long;
            None: never.
    """

    @contextlib.asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        task = asyncio.create_task(_watch(watcher, linger_s))
        yield
        task.cancel()

    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None, lifespan=lifespan)

    def ask(number: signal.Signals) -> PlainTextResponse:
        try:
            return PlainTextResponse(watcher.ask(number))
        except Refused as error:
            return PlainTextResponse(str(error), status_code=409)

    @app.post("/stop")
    async def stop() -> PlainTextResponse:
        since = time.time()
        asked = ask(signal.SIGTERM)
        if asked.status_code != 200:
            return asked
        try:
            units = await asyncio.to_thread(watcher.stopped, since)
        except Fault as fault:
            return PlainTextResponse(str(fault), status_code=503)
        lines = "; ".join(map(str, units)) or "nothing was armed"
        if all(unit.acknowledged and unit.standing for unit in units):
            return PlainTextResponse(f"STOPPED: {lines}")
        text = f"NOT ALL DRIVES STAND: use the emergency stop. {lines}"
        return PlainTextResponse(text, status_code=503)

    @app.post("/pause")
    async def pause() -> PlainTextResponse:
        return ask(PAUSE)

    @app.get("/report")
    async def report() -> FileResponse:
        if watcher.report is None:
            raise HTTPException(404, "this run has no report yet")
        return FileResponse(watcher.report)

    @app.get("/page.{kind}")
    async def file(kind: Literal["css", "js"]) -> FileResponse:
        return FileResponse(
            HERE / f"page.{kind}", headers={"Cache-Control": "no-cache"}
        )

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
    folder: pathlib.Path,
    sock: socket.socket,
    token: str | None,
    linger_s: float | None = None,
) -> None:
    """Serve the page of a run on a listening socket until interrupted."""
    watcher = Watcher(folder)
    watcher.poll()
    host, port = sock.getsockname()[:2]
    app = make_app(watcher, linger_s)
    names = (host, socket.gethostname())
    config = uvicorn.Config(
        Guard(app, port, names, token),
        log_level="warning",
        ws="wsproto",
        proxy_headers=False,
        server_header=False,
        timeout_graceful_shutdown=1,
    )
    uvicorn.Server(config).run(sockets=[sock])


if __name__ == "__main__":
    made = socket.socket(fileno=int(sys.argv[2]))
    token = os.environ.pop(TOKEN, "") or None
    serve(pathlib.Path(sys.argv[1]), made, token, LINGER_S)
