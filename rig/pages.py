"""Pages of a run, the live one and the report, each made by a command of its own: a
session loads nothing of what they need."""

from __future__ import annotations

import importlib.util
import pathlib
import socket
import subprocess
import sys

from jaxcal.extras import install
from rig.faults import Fault
from rig.parts import require

HOST, PORT = "127.0.0.1", 8642  # the usual port; where it is taken, any free one
LOG = "live.log"
REPORT = "report.html"
REPORT_S = 120.0  # that it may take


def listen() -> tuple[socket.socket, str]:
    """A listening socket of this computer alone, and the line to print."""
    try:
        sock = socket.create_server((HOST, PORT))
    except OSError:
        sock = socket.create_server((HOST, 0))
    return sock, f"live page: http://{HOST}:{sock.getsockname()[1]}/"


def start(folder: pathlib.Path) -> str:
    """Start the live page of a run, whose words go to LOG; returns the line to print.
    Never raises or waits."""
    if importlib.util.find_spec("nicegui") is None:
        return f"no live page: nicegui is not installed: {install('live')}"
    try:
        sock, line = listen()
        with sock, (folder / LOG).open("ab") as log:
            subprocess.Popen(
                [*_command("watch", folder), "--socket", str(sock.fileno())],
                pass_fds=[sock.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,  # Ctrl-C is not for it
            )
    except OSError as error:
        return f"no live page: {error}"
    return line


def write_report(folder: pathlib.Path) -> None:
    """Have ``report.html`` of a run written; MissingExtraError, or Fault: it is not."""
    require("report")
    try:
        subprocess.run(
            _command("report", folder),
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=True,
            timeout=REPORT_S,
            start_new_session=True,  # Ctrl-C is not for it
        )
    except subprocess.SubprocessError as error:
        told = str(getattr(error, "stderr", None) or "").strip()
        text = told.rpartition("\n")[2] or error
        raise Fault(f"no {REPORT} was written: {text}") from None


def _command(name: str, folder: pathlib.Path) -> list[str]:
    return [sys.executable, "-m", "rig", name, str(folder)]
