"""The live page: another process that reads a run's folder and shows it in a browser.

It can ask the session to pause or to stop, and can move nothing. A session knows
nothing of it: the commands start it, and it ends by itself. Nothing here loads a web
framework.
"""

from __future__ import annotations

import functools
import importlib.util
import pathlib
import socket
import subprocess
import sys
import time
from typing import Any

from jaxcal.extras import install

HOST, PORT = "127.0.0.1", 8642  # the usual port; where it is taken, any free one
LOG = "live.log"
SERVER = "rig.workbench.live.server"


def listen() -> tuple[socket.socket, str]:
    """A listening socket of this computer alone, and the line to print."""
    try:
        sock = socket.create_server((HOST, PORT))
    except OSError:
        sock = socket.create_server((HOST, 0))
    return sock, f"live page: http://{HOST}:{sock.getsockname()[1]}/"


def start(folder: pathlib.Path) -> str:
    """Start the page of a run; returns the line to print. Never raises, never waits.

    It has its own process group, so that Ctrl-C in the terminal is not for it, and its
    words go to ``live.log`` in the run's folder.
    """
    if importlib.util.find_spec("nicegui") is None:
        return f"no live page: nicegui is not installed: {install('live')}"
    try:
        sock, line = listen()
        with sock, (folder / LOG).open("ab") as log:
            subprocess.Popen(
                [sys.executable, "-m", SERVER, str(folder), str(sock.fileno())],
                pass_fds=[sock.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
    except OSError as error:
        return f"no live page: {error}"
    return line


def draw(part: str, **values: Any) -> str:
    """A part of the page as HTML, escaped: a macro of page.html.j2."""
    return str(getattr(_template(), part)(**values))


@functools.cache
def _template() -> Any:
    import jinja2

    from rig.workbench.outputs.view import angle

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(pathlib.Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["angles"] = lambda values: " ".join(
        angle(value, 2) for value in values
    )
    environment.filters["clock"] = lambda when: time.strftime(
        "%H:%M:%S", time.localtime(when)
    )
    return environment.get_template("page.html.j2").module
