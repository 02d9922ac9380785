"""The process that owns a session's port, and stops the drives when the session dies.

Asked over JSON lines for ``METHODS``, over a channel of its own for a stop, it refuses
what leaves its own reading of bus, units, maps, limits and pace. Where the session's
sign of life, written every 50 ms, ends while a drive moves, or its pipe is closed, it
stops the drives and holds the lock till then. It loads no package but pyserial.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import os
import select
import signal
import socket
import sys
import threading
import time
from typing import Any

from rig.core import stop
from rig.drives import Drive, Line, make_drives
from rig.drives.drive import START_S
from rig.drives.line import BusError
from rig.faults import EXIT_FAULT, EXIT_OK, LimitError, Refused
from rig.journal.lock import ENDING, BusLock
from rig.stop_config import read_armed

TICK_S = 0.02
TICKS = 13  # without a sign of life: counted, so that a busy computer has more time
BUSY_S = 0.05  # after which a session is told that its request is under way
ROUNDING = 1e-6
METHODS = (
    "ids", "arm", "position", "move", "standing", "stop", "alarm", "enabled", "reset",
    "hold", "held", "home", "set_zero", "mirror_limits", "pulses_per_rev", "watch",
    "set_watch", "forget_origin", "status",
)  # fmt: skip
ARMS = ("arm", "move", "home")  # from here on drives are stopped when the session ends
OF_LINE = ("open", "close", "doubts", "stop_at_once")
TIMEOUTS = 4  # of the line, in one exchange at most: it may connect, and is emptied
GONE = "the session has ended"
WHY = "Find out who ended or suspended the session. Is the computer overloaded?"
IGNORED = (
    signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP, signal.SIGTTOU,
)  # fmt: skip


class Channel:
    """JSON lines on a socket, for one thread at each end."""

    def __init__(self, end: socket.socket) -> None:
        self.socket = end
        self._came = b""

    def send(self, message: dict[str, Any]) -> None:
        self.socket.sendall(json.dumps(message).encode() + b"\n")

    def receive(self, seconds: float | None = None) -> dict[str, Any]:
        """The next message; EOFError where the other end is gone, TimeoutError."""
        while b"\n" not in self._came:
            if not select.select([self.socket], [], [], seconds)[0]:
                raise TimeoutError
            if not (data := self.socket.recv(65536)):
                raise EOFError
            self._came += data
        line, _, self._came = self._came.partition(b"\n")
        message: dict[str, Any] = json.loads(line)
        return message


def told_of_error(error: Exception) -> dict[str, Any]:
    names = ("advice", "lost", "refused", "out_of_reach")
    more = {name: getattr(error, name) for name in names if hasattr(error, name)}
    bus = isinstance(error, BusError)
    return {"text": str(error), "kind": type(error).__name__, "bus": bus, **more}


def perform(
    line: Line, drives: list[Drive], axis: int | None, method: str, args: list[Any]
) -> Any:
    """What a session asks of its line, or of the drive of an axis by its number."""
    if axis is None:
        assert method in OF_LINE
        args = [drives] if method == "stop_at_once" else args
        result = getattr(line, method)(*args)
        return result if method == "doubts" else None
    assert method in METHODS
    drive = drives[axis]
    result = getattr(drive, method)(*args)
    if method == "status":
        return [dataclasses.astuple(result), drive.says_homed, drive.origin]
    return result


class Owner:
    """The line and its drives, and whoever may move them now."""

    def __init__(self, told: dict[str, Any], lock_fd: int) -> None:
        config = read_armed(told)
        if config.faults or config.lost or config.bus is None:
            raise Refused(f"bus or maps cannot be read: {'; '.join(config.faults)}")
        self._rows = told["drives"]
        for axis, row in zip(config.axes, self._rows, strict=True):
            vars(axis).update(row["scale"])
        bus: Any = config.bus
        axes: list[Any] = config.axes
        self.line, self.drives = make_drives(bus, axes, config.silence_s, self._emit)
        self.line.check = self._check
        self.lock, self._lock_fd = BusLock(bus), lock_fd
        self.reason = ""  # why the drives were stopped from here
        self.ends = ""  # why this process does, unless the line was closed
        self.stood = self.closed = self._armed = False
        self._begun: dict[int, float] = {}  # axes that move, and since when
        self._epoch = 0  # of the last stop; what was asked before it is not done
        self._fed = self._busy = 0  # signs of life; requests under way
        self._here = threading.local()  # of a thread: request, channel, writes told

    def _emit(self, event: str, **fields: Any) -> None:
        getattr(self._here, "told", []).append(fields)

    def _check(self) -> None:
        """Before each exchange of the session that is not of a stop."""
        if self.reason or self._here.request["epoch"] < self._epoch:
            raise BusError(self.reason or "a stop was requested meanwhile", WHY)
        self._fed += 1
        if time.monotonic() > self._here.tell:
            self._here.tell = time.monotonic() + BUSY_S
            self._here.channel.send({"busy": True})

    def serve(self, channel: Channel, urgent: bool) -> None:
        """Answer what a session asks, until it is gone."""
        here = self._here
        with contextlib.suppress(EOFError, OSError):
            while True:
                here.request = request = channel.receive()
                here.channel = channel
                self._busy, self._fed = self._busy + 1, self._fed + 1
                here.tell, here.told = time.monotonic() + BUSY_S, []
                reply: dict[str, Any] = {"number": request["number"]}
                try:
                    reply["result"] = self._answer(request, urgent)
                except Exception as error:
                    reply["error"] = told_of_error(error)
                self._busy, self._fed = self._busy - 1, self._fed + 1
                reply |= {"told": here.told, "silent": sorted(self.line.silent)}
                channel.send(reply)

    def _answer(self, request: dict[str, Any], urgent: bool) -> Any:
        axis, method, args = (request[key] for key in ("axis", "method", "args"))
        with contextlib.ExitStack() as stack:
            if urgent:
                self._epoch = request["epoch"]
                stack.enter_context(self.line.urgent(request["wait_s"]))
            else:
                self._armed |= method in ARMS
                if method == "move":
                    self._require(axis, *args)
                    self._begun[axis] = time.monotonic()
                elif method == "home":  # which may seem to stand on its way
                    self._begun[axis] = math.inf
            result = perform(self.line, self.drives, axis, method, args)
        if method == "status":
            self._look(axis)
        self.closed |= method == "close"
        return result

    def _require(self, axis: int, count: int, speed: float, accel: float) -> None:
        """LimitError where a move leaves the axis's limits or its pace."""
        drive, (fastest, hardest) = self.drives[axis], self._rows[axis]["pace"]
        here: Any = drive.axis
        pulses = count - drive.origin
        if not here.min_pulses <= pulses <= here.max_pulses:
            within = f"{here.min_pulses}..{here.max_pulses}"
            raise LimitError(f"{here.name}: {pulses} pulses are outside {within}")
        for per, asked, most in (("s", speed, fastest), ("s^2", accel, hardest)):
            if not 0 < asked <= most * (1 + ROUNDING):
                text = f"{here.name}: {asked:g} pulses/{per} are outside {most:g}"
                raise LimitError(text)

    def _look(self, axis: int) -> bool:
        """Whether a drive that was moved was now seen to stand."""
        begun, status = self._begun.get(axis), self.drives[axis].last
        if begun is not None and status is not None:
            if not status.moving and status.asked - begun > START_S:
                self._begun.pop(axis, None)
        return axis not in self._begun

    def _goes_on(self) -> bool:
        """Whether a drive that was moved may be moving still."""
        for axis in [*self._begun]:
            with contextlib.suppress(Exception), self.line.urgent(self.line.quick_s):
                self.drives[axis].status(retries=0)
                self._look(axis)
        return bool(self._begun)

    def watch(self, life: int) -> int:
        """Wait until the session closes the line, or is gone; returns the exit code."""
        silent, before = 0, self._fed
        exchange = int(TIMEOUTS * self.line.settings.timeout_s / TICK_S)
        while not (self.closed or self.ends):
            if select.select([life], [], [], TICK_S)[0]:
                self._fed += 1
                if not os.read(life, 4096):
                    self.ends = GONE
                continue
            silent, before = silent + 1 if self._fed == before else 0, self._fed
            most = TICKS + exchange * bool(self._busy)
            if silent >= most and not self.reason and self._goes_on():
                self.halt(f"the session gave no sign of life for {TICKS * TICK_S:g} s")
        if self.closed or not self._armed:
            return EXIT_OK
        if self.ends == GONE:
            self.lock.adopt(self._lock_fd, ENDING)
        if not self.stood or self._begun:
            self.halt(self.ends)
        if self.ends == GONE:
            self.lock.release()
        return EXIT_FAULT

    def halt(self, reason: str) -> None:
        """Stop all drives, say what became of them, and leave word for `stop`."""
        self.reason = f"{reason} while the drives were armed: they were stopped"
        self.stood = False
        results = stop.stop_all(self.drives)
        self.stood = all(result.standing for result in results)
        if self.stood:
            self.lock.stood()
            self._begun.clear()
        say("\n".join([self.reason, *map(str, results)]))
        if not self.ends:
            return  # the session goes on, perhaps, and looks whether they stay
        for text in stop.stay(self.drives, results, stop.stand_s(self.drives)):
            say(f"WARNING: {text}, and was stopped again")
        if not all(result.standing for result in results):
            self.lock.stood(standing=False)


def say(text: str) -> None:
    """A terminal that is gone does not end a stop."""
    with contextlib.suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


def main(words: list[str]) -> int:
    """With the descriptors of both channels, of the signs of life and of the lock."""
    normal, urgent, life, lock_fd = map(int, words)
    for number in IGNORED:
        signal.signal(number, signal.SIG_IGN)
    channels = [Channel(socket.socket(fileno=fd)) for fd in (normal, urgent)]
    try:
        owner = Owner(channels[0].receive(), lock_fd)
    except Exception as error:
        channels[0].send({"refused": f"{type(error).__name__}: {error}"})
        return EXIT_FAULT

    def end(*_: object) -> None:
        owner.ends = owner.ends or "SIGTERM came"
        if owner.stood:  # it only looks whether they stay
            sys.exit(EXIT_FAULT)

    signal.signal(signal.SIGTERM, end)
    channels[0].send({"refused": ""})
    for channel in channels:
        args = (channel, channel is channels[1])
        threading.Thread(target=owner.serve, args=args, daemon=True).start()
    try:
        return owner.watch(life)
    finally:
        owner.line.close()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
