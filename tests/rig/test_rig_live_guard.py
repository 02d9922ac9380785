"""Who may see the page and press its buttons."""

import asyncio
import os
import platform
import re
import secrets
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request

import pytest

from rig.core.faults import Refused
from rig.journal import Journal
from rig.signals import PAUSE
from rig.workbench.live import launch, words
from rig.workbench.live.guard import Guard
from rig.workbench.live.watcher import Watcher

HOST = "192.0.2.7:8642"
OWN = f"http://{HOST}"
COOKIE = "jaxcal_live_8642"


async def _application(scope, receive, send):
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"inside"})


def answer(
    headers, token=None, method="GET", kind="http", query="", path="/", names=()
):
    """Status (101 for a websocket that was accepted) and headers of one request."""
    headers = {"host": HOST} | headers
    scope = {
        "type": kind,
        "path": path,
        "query_string": query.encode(),
        "headers": [(k.encode(), v.encode()) for k, v in headers.items()],
    }
    if kind == "http":
        scope["method"] = method
    sent = []

    async def send(message):
        sent.append(message)

    asyncio.run(Guard(_application, 8642, names, token)(scope, None, send))
    match sent[0]["type"]:
        case "websocket.accept":
            return 101, {}
        case "websocket.close":
            return 403, {}
    return sent[0]["status"], dict(sent[0]["headers"])


def test_the_page_itself_passes():
    assert answer({})[0] == 200
    assert answer({"origin": OWN}, method="POST", path="/stop")[0] == 200
    assert answer({"origin": OWN}, kind="websocket")[0] == 101
    for host in ("localhost:8642", "127.0.0.1", "[::1]:8642", "LOCALHOST:8642"):
        assert answer({"host": host})[0] == 200
    assert answer({"host": "rig-pc:8642"}, names=("Rig-PC",))[0] == 200


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:8642",
        "",
        "127.0.0.1.evil.example",
        "a@evil",
        "[::",
    ],
)
def test_a_name_that_was_rebound_to_this_computer_is_refused(host, kind):
    headers = {"host": host, "origin": f"http://{host}"}
    assert answer(headers, kind=kind)[0] == 403


@pytest.mark.parametrize(
    "origin",
    ["http://evil.example", "null", "https://192.0.2.7:8642", "http://192.0.2.7", ""],
)
def test_other_sites_are_refused(origin):
    for more in ({}, {"cookie": f"{COOKIE}=secret"}):
        headers = {"origin": origin} | more
        assert answer(headers, "secret", "POST", path="/stop")[0] == 403
        assert answer(headers, "secret", kind="websocket")[0] == 403
        assert answer(headers, None, "POST", path="/stop")[0] == 403
        assert answer(headers, None, kind="websocket")[0] == 403


def test_what_changes_anything_must_name_its_origin():
    assert answer({}, method="POST", path="/stop")[0] == 403
    assert answer({}, kind="websocket")[0] == 403


def test_other_sites_may_link_to_the_page_but_not_load_or_frame_it():
    link = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}
    status, headers = answer(link)
    assert status == 200
    assert b"frame-ancestors 'none'" in headers[b"content-security-policy"]
    assert headers[b"x-frame-options"] == b"DENY"
    for mode in ("no-cors", "cors"):
        found = answer({"sec-fetch-site": "cross-site", "sec-fetch-mode": mode})
        assert found[0] == 403
    assert answer({"sec-fetch-site": "same-origin", "sec-fetch-mode": "cors"})[0] == 200


def test_the_token_is_taken_once_and_kept_in_a_cookie():
    token = secrets.token_urlsafe(32)
    assert answer({}, token)[0] == 403
    for wrong in ("", "x", token[:-1], token + "x", "ü"):
        assert answer({}, token, query=f"token={wrong}")[0] == 403
        assert answer({"cookie": f"{COOKIE}={wrong}"}, token)[0] == 403
    status, headers = answer({}, token, query=f"token={token}")
    assert (status, headers[b"location"]) == (303, b"/")
    cookie = headers[b"set-cookie"].decode()
    assert "HttpOnly" in cookie and "SameSite=strict" in cookie
    brought = {"cookie": "other=1; " + cookie.split(";")[0], "origin": OWN}
    assert answer(brought, token)[0] == 200
    assert answer(brought, token, "POST", path="/stop")[0] == 200
    assert answer(brought, token, kind="websocket")[0] == 101


def test_the_token_of_an_address_opens_nothing_but_the_page():
    query = {"query": "token=secret"}
    assert answer({"origin": OWN}, "secret", "POST", path="/stop", **query)[0] == 403
    assert answer({"origin": OWN}, "secret", kind="websocket", **query)[0] == 403


def test_only_another_address_than_loopback_needs_a_token():
    for host in (None, "127.0.0.1", "127.0.0.5", "localhost"):
        sock, token, url = launch.listen(host)
        sock.close()
        assert token is None and "token" not in url
        assert url.startswith("http://127.0.0.")
    for host in ("0.0.0.0", "0", ""):
        with pytest.raises(ValueError, match="one address of this computer"):
            launch.listen(host)


def test_another_address_of_this_computer_gets_a_fresh_long_token(monkeypatch):
    """No such address may be here, so one is made of a loopback socket."""
    create = socket.create_server

    class Elsewhere(socket.socket):
        def getsockname(self):
            return "192.0.2.7", 8642

    def elsewhere(address, family):
        with create(("127.0.0.1", 0)) as sock:
            return Elsewhere(fileno=sock.detach())

    monkeypatch.setattr(launch.socket, "create_server", elsewhere)
    found = []
    for _ in range(2):
        sock, token, url = launch.listen("192.0.2.7")
        sock.close()
        assert url.startswith("http://192.0.2.7:8642/")
        assert url.endswith(f"/?token={token}")
        found.append(token)
    assert found[0] != found[1] and min(map(len, found)) >= 43


# What the buttons may do


def _journal(tmp_path, pid, **more):
    journal = Journal(tmp_path / "journal.jsonl")
    journal.write(
        "start", mode="goto", config={}, pid=pid, **{"host": platform.node()} | more
    )
    journal.write("phase", phase="moving")
    return journal


def test_buttons_reach_the_process_that_holds_the_journal_and_no_other(tmp_path):
    with subprocess.Popen(["sleep", "60"]) as sleeper:
        journal = _journal(tmp_path, sleeper.pid)
        watcher = Watcher(tmp_path)
        assert "pause asked for" in watcher.ask(PAUSE)
        assert sleeper.wait(10) == -PAUSE
    with subprocess.Popen(["sleep", "60"]) as sleeper:
        journal.write("resume", pid=sleeper.pid, host=platform.node())
        with pytest.raises(Refused, match="nothing to pause"):  # it waits for the phone
            watcher.ask(PAUSE)
        assert str(sleeper.pid) in watcher.ask(signal.SIGTERM)
        assert sleeper.wait(10) == -signal.SIGTERM
    with pytest.raises(Refused, match="emergency stop"):  # the process has gone
        watcher.ask(signal.SIGTERM)
    journal.close()
    with pytest.raises(Refused, match="no session"):
        watcher.ask(signal.SIGTERM)


# A session that moves, whose loop is slow to say that it was asked to pause.
MOVES = """
import time
from rig.core.faults import StopRequested
from rig.signals import Signals
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
            assert "pause asked for" in watcher.ask(PAUSE)
        assert moving.stdout.read() == "pausing\n"
        journal.close()


def test_a_pause_that_was_asked_for_is_shown(tmp_path):
    journal = _journal(tmp_path, os.getpid())
    journal.write("pausing")
    watcher = Watcher(tmp_path)
    watcher.poll()
    assert words.headline(watcher.state, True)[1].endswith(", then pausing")
    journal.close()


def test_a_session_on_another_computer_is_not_signalled(tmp_path):
    journal = _journal(tmp_path, os.getpid(), host="elsewhere")
    watcher = Watcher(tmp_path)
    with pytest.raises(Refused, match="running here"):
        watcher.ask(signal.SIGTERM)
    assert watcher.running and not watcher.here
    journal.close()


# The real server


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """Port and token of the page of a run that was killed."""
    pytest.importorskip("nicegui")
    folder = tmp_path_factory.mktemp("served")
    _journal(folder, os.getpid()).close()
    sock = socket.create_server(("127.0.0.1", 0))
    token = secrets.token_urlsafe(32)
    command = [sys.executable, "-m", launch.SERVER, str(folder), str(sock.fileno())]
    page = subprocess.Popen(
        command, pass_fds=[sock.fileno()], env=os.environ | {launch.TOKEN: token}
    )
    port = sock.getsockname()[1]
    sock.close()
    yield port, token, page
    page.terminate()
    assert page.wait(20) is not None


def fetch(port, path, method="GET", **headers):
    url = f"http://127.0.0.1:{port}{path}"
    asked = urllib.request.Request(url, method=method, headers=headers)
    opener = urllib.request.build_opener(_NoRedirect)
    try:
        with opener.open(asked, timeout=60) as reply:
            return reply.status, dict(reply.headers), reply.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, dict(error.headers), error.read().decode()


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, *_):
        return None


def test_the_served_page_needs_its_token_and_refers_to_no_other_host(served):
    port, token, _ = served
    assert fetch(port, "/")[0] == 403
    assert fetch(port, "/?token=wrong")[0] == 403
    status, headers, _ = fetch(port, f"/?token={token}")
    assert status == 303
    cookie = headers["set-cookie"].split(";")[0]
    status, headers, html = fetch(port, "/", Cookie=cookie)
    assert status == 200
    assert "default-src 'self'" in headers["content-security-policy"]
    assert not re.findall(r"(?:src|href|url|from)\W{1,3}(?:https?:)?//", html)
    style = fetch(port, "/page.css", Cookie=cookie)[2]
    script = fetch(port, "/page.js", Cookie=cookie)[2]
    assert "//" not in re.sub(r"(?m)^//.*$", "", style + script)
    assert fetch(port, "/page.css")[0] == 403


def test_the_served_page_stops_nothing_where_nothing_runs(served):
    port, token, _ = served
    cookie = {"Cookie": f"jaxcal_live_{port}={token}"}
    own = {"Origin": f"http://127.0.0.1:{port}"}
    for what in ("/stop", "/pause"):
        assert fetch(port, what, "POST", **cookie)[0] == 403
        status, _, text = fetch(port, what, "POST", **cookie, **own)
        assert status == 409 and "nothing was sent" in text
    assert fetch(port, "/report", **cookie)[0] == 404


def _handshake(port, origin, cookie):
    """The status line of a websocket request to the page."""
    path = "/_nicegui_ws/socket.io/?EIO=4&transport=websocket"
    lines = [
        f"GET {path} HTTP/1.1", f"Host: 127.0.0.1:{port}", "Upgrade: websocket",
        "Connection: Upgrade", "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", f"Cookie: {cookie}",
        f"Origin: {origin}",
    ]  # fmt: skip
    with socket.create_connection(("127.0.0.1", port), timeout=30) as sock:
        sock.sendall(("\r\n".join(lines) + "\r\n\r\n").encode())
        return sock.recv(200).split(b"\r\n")[0].decode()


def test_the_served_page_refuses_a_websocket_of_another_site(served):
    port, token, _ = served
    cookie = f"jaxcal_live_{port}={token}"
    assert "101" in _handshake(port, f"http://127.0.0.1:{port}", cookie)
    assert "403" in _handshake(port, "http://evil.example", cookie)
    assert "403" in _handshake(port, f"http://127.0.0.1:{port}", "other=1")


def test_the_token_is_not_on_the_command_line(served):
    _, token, page = served
    shown = subprocess.run(
        ["ps", "-o", "args=", "-p", str(page.pid)], capture_output=True, text=True
    ).stdout
    assert "rig.workbench.live" in shown and token not in shown


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


def test_a_page_that_nobody_looks_at_ends_by_itself(tmp_path):
    pytest.importorskip("nicegui")
    _journal(tmp_path, os.getpid()).close()
    code = (
        "import pathlib, socket; from rig.workbench.live.server import serve;"
        "sock = socket.create_server(('127.0.0.1', 0));"
        f"serve(pathlib.Path({str(tmp_path)!r}), sock, None, linger_s=0.2)"
    )
    ended = subprocess.run([sys.executable, "-c", code], timeout=60, check=False)
    assert ended.returncode == -signal.SIGTERM  # which uvicorn raises again at its end


def test_without_the_extra_a_session_says_so_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(launch.importlib.util, "find_spec", lambda name: None)
    line = launch.start(tmp_path, "127.0.0.1")
    assert line == "no live page: nicegui is not installed: pip install 'jaxcal[live]'"
    assert not list(tmp_path.iterdir())


def test_an_address_that_is_not_this_computers_only_costs_the_page(tmp_path):
    line = launch.start(tmp_path, "192.0.2.1")
    assert line.startswith("no live page on 192.0.2.1: ")


def test_starting_the_page_takes_no_time_of_the_session(tmp_path, monkeypatch):
    """The started process may hang for good: nothing waits for it."""
    made = []
    popen = subprocess.Popen

    def hanging(command, **more):
        made.append(popen(["sleep", "60"], **more))
        return made[-1]

    monkeypatch.setattr(launch.subprocess, "Popen", hanging)
    line = launch.start(tmp_path, "127.0.0.1")
    assert line.startswith("live page: http://127.0.0.1:")
    assert made[0].poll() is None
    assert os.getpgid(made[0].pid) != os.getpgrp()
    made[0].kill()
    made[0].wait()
