"""Starting the page beside a session, unwaited for. Loads no web framework."""

from __future__ import annotations

import importlib.util
import ipaddress
import os
import pathlib
import secrets
import socket
import subprocess
import sys

LOOPBACK = "127.0.0.1"
PORT = 8642  # the usual one; where it is taken, any free one
TOKEN = "JAXCAL_LIVE_TOKEN"  # an environment variable, which `ps` does not show
LOG = "live.log"
SERVER = "rig.workbench.live.server"


def listen(host: str | None) -> tuple[socket.socket, str | None, str]:
    """A listening socket, the token (None on loopback) and the address to open.

    Args:
        host: an address of this computer; None: loopback.

    Raises:
        OSError: the address is not one of this computer.
        ValueError: it stands for all of its addresses.
    """
    host = LOOPBACK if host is None else host
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        sock = socket.create_server((host, PORT), family=family)
    except OSError:
        sock = socket.create_server((host, 0), family=family)
    address, port = sock.getsockname()[:2]
    bound = ipaddress.ip_address(address)
    if bound.is_unspecified:
        sock.close()
        raise ValueError(
            f"--live-host must be one address of this computer, got {host!r}, which "
            "stands for all of them"
        )
    token = None if bound.is_loopback else secrets.token_urlsafe(32)
    shown = f"[{address}]" if family == socket.AF_INET6 else address
    url = f"http://{shown}:{port}/" + (f"?token={token}" if token else "")
    return sock, token, url


def start(folder: pathlib.Path, host: str | None = None) -> str:
    """Start the page of a run; returns the line to print. Never raises, never waits.

    It has its own process group, so that Ctrl-C in the terminal is not for it, and its
    words go to ``live.log`` in the run's folder.
    """
    if importlib.util.find_spec("nicegui") is None:
        return "no live page: nicegui is not installed: pip install 'jaxcal[live]'"
    try:
        sock, token, url = listen(host)
        with sock, (folder / LOG).open("ab") as log:
            subprocess.Popen(
                [sys.executable, "-m", SERVER, str(folder), str(sock.fileno())],
                pass_fds=[sock.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env=os.environ | {TOKEN: token or ""},
            )
    except (OSError, ValueError) as error:
        return f"no live page on {host or LOOPBACK}: {error}"
    return f"live page: {url}"
