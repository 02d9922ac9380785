"""Who may see the page and press its buttons."""

import asyncio
import os
import platform
import re
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request

import pytest

from rig import pages
from rig.faults import PAUSE, Refused
from rig.journal.run_folder import SCHEMA, Journal
from rig_workbench.live.watcher import Watcher
from rig_workbench.outputs import view

HOST = "127.0.0.1:8642"
OWN = f"http://{HOST}"


async def _application(scope, receive, send):
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"inside"})


def answer(headers, method="GET", kind="http", path="/"):
    """Status (101 for a websocket that was accepted) and headers of one request."""
    server = pytest.importorskip("rig_workbench.live.server")
    headers = {"host": HOST} | headers
    scope = {
        "type": kind,
        "path": path,
        "query_string": b"",
        "headers": [(k.encode(), v.encode()) for k, v in headers.items()],
    }
    if kind == "http":
        scope["method"] = method
    sent = []

    async def send(message):
        sent.append(message)

    asyncio.run(server.guarded(_application)(scope, None, send))
    if sent[0]["type"] == "websocket.accept":
        return 101, {}
    return sent[0]["status"], dict(sent[0]["headers"])


def test_the_page_itself_passes():
    assert answer({})[0] == 200
    assert answer({"origin": OWN}, method="POST", path="/stop")[0] == 200
    assert answer({"origin": OWN}, kind="websocket")[0] == 101
    for host in ("localhost:8642", "127.0.0.1", "LOCALHOST:8642"):
        assert answer({"host": host})[0] == 200


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:8642",
        "",
        "127.0.0.1.evil.example",
        "192.0.2.7:8642",
        "a@evil",
        "[::",
    ],
)
def test_a_name_that_was_rebound_to_this_computer_is_refused(host, kind):
    headers = {"host": host, "origin": f"http://{host}"}
    assert answer(headers, kind=kind)[0] == 400


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "https://127.0.0.1:8642", "http://127.0.0.1", ""],
)
def test_other_sites_are_refused(origin):
    headers = {"origin": origin}
    assert answer(headers, "POST", path="/stop")[0] == 403
    assert answer(headers, kind="websocket")[0] == 403


def test_what_changes_anything_must_name_its_origin():
    assert answer({}, method="POST", path="/stop")[0] == 403
    assert answer({}, kind="websocket")[0] == 403


def test_other_sites_may_link_to_the_page_but_not_frame_it():
    status, headers = answer({"sec-fetch-site": "cross-site"})
    assert status == 200
    assert b"frame-ancestors 'none'" in headers[b"content-security-policy"]


# What the buttons may do


def _journal(tmp_path, pid, **more):
    journal = Journal(tmp_path / "journal.jsonl")
    start = {"schema": SCHEMA, "mode": "goto", "config": {}, "host": platform.node()}
    journal.write("start", pid=pid, **start | more)
    journal.write("phase", phase="moving")
    return journal


def test_buttons_reach_the_process_that_holds_the_journal_and_no_other(tmp_path):
    with subprocess.Popen(["sleep", "60"]) as sleeper:
        journal = _journal(tmp_path, sleeper.pid)
        watcher = Watcher(tmp_path)
        watcher.ask(PAUSE)
        assert sleeper.wait(10) == -PAUSE
    with subprocess.Popen(["sleep", "60"]) as sleeper:
        journal.write("resume", pid=sleeper.pid, host=platform.node())
        with pytest.raises(Refused, match="nothing to pause"):  # it waits for the phone
            watcher.ask(PAUSE)
        watcher.ask(signal.SIGTERM)
        assert sleeper.wait(10) == -signal.SIGTERM
    with pytest.raises(Refused, match="emergency stop"):  # the process has gone
        watcher.ask(signal.SIGTERM)
    journal.close()
    with pytest.raises(Refused, match="no session"):
        watcher.ask(signal.SIGTERM)


# A session that moves, whose loop is slow to say that it was asked to pause.
MOVES = """
import time
from rig.faults import StopRequested
from rig.faults import Signals
with Signals() as signals:
    signals.armed = True
    print("armed", flush=True)
    time.sleep(1.0)
    try:
        signals.check_stop()
        print("pausing" if signals.pause else "nothing")
    except StopRequested as stop:
        print(stop)
"""


def test_a_pause_of_two_pages_is_no_stop(tmp_path):
    """And neither is one after Ctrl-C in the terminal."""
    command = [sys.executable, "-c", MOVES]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as moving:
        assert moving.stdout.readline() == "armed\n"
        journal = _journal(tmp_path, moving.pid)
        os.kill(moving.pid, signal.SIGINT)
        for watcher in (Watcher(tmp_path), Watcher(tmp_path)):
            watcher.ask(PAUSE)
        assert moving.stdout.read() == "pausing\n"
        journal.close()


def test_a_pause_that_was_asked_for_is_shown(tmp_path):
    journal = _journal(tmp_path, os.getpid())
    journal.write("pausing")
    watcher = Watcher(tmp_path)
    watcher.poll()
    assert view.headline(watcher.state, True)[1].endswith(", then pausing")
    journal.close()


def test_a_session_on_another_computer_is_not_signalled(tmp_path):
    journal = _journal(tmp_path, os.getpid(), host="elsewhere")
    watcher = Watcher(tmp_path)
    with pytest.raises(Refused, match="running on this computer"):
        watcher.ask(signal.SIGTERM)
    assert watcher.running and not watcher.here
    journal.close()


# The real server


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """Port of the page of a run that was killed."""
    pytest.importorskip("nicegui")
    folder = tmp_path_factory.mktemp("served")
    _journal(folder, os.getpid()).close()
    sock = socket.create_server(("127.0.0.1", 0))
    command = [sys.executable, "-m", "rig", "watch", str(folder), "--socket"]
    page = subprocess.Popen([*command, str(sock.fileno())], pass_fds=[sock.fileno()])
    port = sock.getsockname()[1]
    sock.close()
    yield port
    page.terminate()
    assert page.wait(20) is not None


def fetch(port, path, method="GET", **headers):
    url = f"http://127.0.0.1:{port}{path}"
    asked = urllib.request.Request(url, method=method, headers=headers)
    try:
        with urllib.request.urlopen(asked, timeout=60) as reply:
            return reply.status, dict(reply.headers), reply.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, dict(error.headers), error.read().decode()


def test_the_served_page_refers_to_no_other_host(served):
    status, headers, html = fetch(served, "/")
    assert status == 200
    assert "default-src 'self'" in headers["content-security-policy"]
    assert not re.findall(r"(?:src|href|url|from)\W{1,3}(?:https?:)?//", html)
    style, script = fetch(served, "/page.css")[2], fetch(served, "/page.js")[2]
    assert "//" not in re.sub(r"(?m)^//.*$", "", style + script)


def test_the_served_page_stops_nothing_where_nothing_runs(served):
    own = {"Origin": f"http://127.0.0.1:{served}"}
    for what in ("/stop", "/pause"):
        assert fetch(served, what, "POST")[0] == 403
        status, _, text = fetch(served, what, "POST", **own)
        assert status == 409 and "nothing was sent" in text
    assert fetch(served, "/report")[0] == 404


def _handshake(port, origin):
    """The status line of a websocket request to the page."""
    path = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    lines = [
        f"GET {path} HTTP/1.1", f"Host: 127.0.0.1:{port}", "Upgrade: websocket",
        "Connection: Upgrade", "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", f"Origin: {origin}",
    ]  # fmt: skip
    with socket.create_connection(("127.0.0.1", port), timeout=30) as sock:
        sock.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        return sock.recv(200).split(b"\r\n")[0].decode()


def test_the_served_page_refuses_a_websocket_of_another_site(served):
    assert "101" in _handshake(served, f"http://127.0.0.1:{served}")
    assert "403" in _handshake(served, "http://evil.example")


def test_watch_shows_a_run_until_it_is_interrupted(tmp_path):
    pytest.importorskip("nicegui")
    _journal(tmp_path, os.getpid()).close()
    command = [sys.executable, "-m", "rig", "watch", str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as watch:
        port = int(watch.stdout.readline().rstrip("/\n").rpartition(":")[2])
        status, _, html = fetch(port, "/")
        assert status == 200 and "Ended without a last record" in html
        watch.send_signal(signal.SIGINT)
        assert watch.wait(30) == 0


@pytest.mark.slow
def test_a_page_without_a_viewer_ends(tmp_path):
    pytest.importorskip("nicegui")
    _journal(tmp_path, os.getpid()).close()
    code = (
        "import pathlib, socket; from rig_workbench.live.server import serve;"
        "sock = socket.create_server(('127.0.0.1', 0));"
        f"serve(pathlib.Path({str(tmp_path)!r}), sock, linger_s=0.2)"
    )
    ended = subprocess.run([sys.executable, "-c", code], timeout=60, check=False)
    assert ended.returncode == -signal.SIGTERM  # which uvicorn raises again at its end


def test_without_the_extra_a_session_says_so_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(pages.importlib.util, "find_spec", lambda name: None)
    line = pages.start(tmp_path)
    assert line.startswith("no live page: nicegui is not installed: ")
    assert line.endswith("[live]'")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_takes_no_log_only_costs_the_page(tmp_path):
    assert pages.start(tmp_path / "none").startswith("no live page: ")


def test_starting_the_page_takes_no_time_of_the_session(tmp_path, monkeypatch):
    """The started process may hang for good: nothing waits for it."""
    made = []
    popen = subprocess.Popen

    def hanging(command, **more):
        made.append(popen(["sleep", "60"], **more))
        return made[-1]

    monkeypatch.setattr(pages.subprocess, "Popen", hanging)
    line = pages.start(tmp_path)
    assert line.startswith("live page: http://127.0.0.1:")
    assert made[0].poll() is None
    assert os.getpgid(made[0].pid) != os.getpgrp()
    made[0].kill()
    made[0].wait()
