"""The line and drives of a session whose port another process owns, ``line_process``.

A stop has a channel of its own, and goes before what was asked earlier. Should that
process end, this one opens the port for a stop, and for nothing else.
"""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NoReturn

from rig.config.config import RigConfig
from rig.core.line_process import TIMEOUTS, Channel, perform
from rig.drives import Drive, Line, make_drives
from rig.drives.drive import Status
from rig.drives.line import BusError
from rig.faults import LimitError, Refused
from rig.journal.lock import HELD, BusLock

NORMAL_S = 30.0  # for a reply, or word of it; a board that was reset takes seconds
URGENT_S = 1.0  # for one of a stop, besides an exchange that is under way
END_S = 2.0  # for the process to end
GRACE_S = 0.1  # for one whose channels are closed to be gone
LATE = "does not answer"
# Errors that a line raises of its own accord, by the names that cross the pipe.
KINDS = {kind.__name__: kind for kind in (LimitError, ValueError)}
OF_MAP = (  # what a drive knows by its map alone
    "can_reset", "can_set_zero", "counts_from_home", "tells_homed", "lasting",
    "foreign", "watch_counts",
)  # fmt: skip
GONE = "Find out who ended it. The session stops its drives"


class LineClient(Line):
    """A line whose port is owned by a process of its own."""

    def __init__(self, config: RigConfig, emit: Callable[..., Any]) -> None:
        super().__init__(config.bus, config.silence_s, emit)
        # Never opened, unless the process ends.
        made = make_drives(config.bus, config.axes, config.silence_s)
        self._own, self.own_drives = made
        self.in_turn = self._own.in_turn
        self._config = config
        self._process: subprocess.Popen[bytes] | None = None
        self._channels: list[Channel] = []
        self._locks = threading.Lock(), threading.Lock()
        self._life = -1
        self._gone = ""  # why the process is
        self._owner = self._number = self._epoch = 0  # thread that stops; requests

    def connect(self) -> None:
        if self._process is None and not self._gone:
            self._start()
        self.ask(None, "open")

    def _start(self) -> None:
        pairs = [socket.socketpair() for _ in range(2)]
        far_life, self._life = os.pipe()
        os.set_blocking(self._life, False)
        lock = HELD.get(BusLock(self._config.bus).path, -1)
        far = [pairs[0][1].fileno(), pairs[1][1].fileno(), far_life]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rig.core.line_process", *map(str, [*far, lock])],
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            pass_fds=[*far, *([lock] if lock >= 0 else [])], start_new_session=True,
            env=os.environ | {"JAXCAL_KERNELS_UNCHECKED": "1"},
        )  # fmt: skip
        self._channels = [Channel(near) for near, _ in pairs]
        for _, end in pairs:
            end.close()
        os.close(far_life)
        try:
            self._channels[0].send(self._config.told)
            refused = self._channels[0].receive(NORMAL_S)["refused"]
        except (OSError, EOFError) as error:
            self._lose(f"did not start: {error!r}")
        if refused:
            raise Refused(f"the process of the line did not start: {refused}")

    def close(self) -> None:
        """End the process, after what the drives were told."""
        if self._process is None:
            return
        with contextlib.suppress(Exception), self.urgent():
            self.ask(None, "close")
        with contextlib.suppress(OSError):
            os.close(self._life)
        for channel in self._channels:
            channel.socket.close()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process, self._life = None, -1

    def alive(self) -> None:
        if self._life >= 0:
            with contextlib.suppress(OSError):
                os.write(self._life, b".")

    @contextlib.contextmanager
    def urgent(self, timeout_s: float | None = None) -> Iterator[None]:
        with self._lock:
            self._owner, self._epoch = threading.get_ident(), self._epoch + 1
            with super().urgent(timeout_s):
                yield

    @property
    def quick_s(self) -> float:
        return self._own.quick_s

    def stops_at_once(self, drives: Sequence[Drive]) -> bool:
        return self._own.stops_at_once(self.own_drives)

    def stop_at_once(self, drives: Sequence[Drive]) -> None:
        self.ask(None, "stop_at_once")

    def doubts(self, unit: int) -> bool:
        return bool(self.ask(None, "doubts", unit))

    def ask(self, axis: int | None, method: str, *args: Any) -> Any:
        """What a method of the line, or of the drive of an axis, returns there.
        BusError: as there; or the process has ended, or does not answer."""
        urgent = self._urgent and self._owner == threading.get_ident()
        if self._gone and urgent:
            with self._own.urgent(self._timeout_s):
                return perform(self._own, self.own_drives, axis, method, [*args])
        with self._locks[urgent]:
            try:
                # The lock of the line: nothing is asked after another's stop.
                with self._lock:
                    if not urgent:
                        self.check()
                    self._send(urgent, axis=axis, method=method, args=args)
                    number = self._number
                reply = self._reply(urgent, number)
            except TimeoutError:
                self._lose(LATE)
            except (EOFError, OSError):
                self._lose("has ended")
        return self._result(reply, urgent)

    def _send(self, urgent: bool, **request: Any) -> None:
        if self._gone:
            raise EOFError
        self._number += 1
        request |= {"number": self._number, "epoch": self._epoch}
        self._channels[urgent].send(request | {"wait_s": self._timeout_s})

    def _reply(self, urgent: bool, number: int) -> dict[str, Any]:
        """The reply to a request; those to what was given up are passed over."""
        wait_s = URGENT_S + TIMEOUTS * self.settings.timeout_s if urgent else NORMAL_S
        while True:
            message = self._channels[urgent].receive(wait_s)
            if message.get("number") == number:
                return message
            if not urgent:  # the process goes on with it
                self.check()

    def _result(self, reply: dict[str, Any], urgent: bool) -> Any:
        self.silent = set(reply["silent"])
        for fields in reply["told"]:
            if urgent:  # a journal on a disk that hangs must not hold up a stop
                self._untold.append(fields)
            else:
                self._emit("write", **fields)
        if (error := reply.get("error")) is None:
            return reply["result"]
        text, kind = error["text"], error["kind"]
        if not error["bus"]:
            kinds = KINDS.get(kind)
            raise kinds(text) if kinds else RuntimeError(f"{kind}: {text}")
        raised = BusError(text, error["advice"], error["lost"])
        raised.refused, raised.out_of_reach = error["refused"], error["out_of_reach"]
        raise raised

    def _lose(self, why: str) -> NoReturn:
        assert self._process is not None
        late = why == LATE
        if late:  # a stop must not wait for it
            self._process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(GRACE_S)
        self._process.kill()
        code = self._process.wait()
        by = f" by signal {-code}" if code < 0 and not late else ""
        self._gone = self._gone or f"the process of the line {why}{by}"
        raise BusError(self._gone, GONE, lost=True)


def _asked(name: str) -> Any:
    """A method of a drive that is asked of its process."""

    def method(self: DriveClient, *args: Any) -> Any:
        return self.line.ask(self.number, name, *args)

    return method


class DriveClient(Drive):
    """One drive of a line that another process owns."""

    ids, arm, move, stop, alarm = map(_asked, ("ids", "arm", "move", "stop", "alarm"))
    position, standing, enabled = map(_asked, ("position", "standing", "enabled"))
    reset, hold, held, home = map(_asked, ("reset", "hold", "held", "home"))
    set_zero, mirror_limits = map(_asked, ("set_zero", "mirror_limits"))
    watch, set_watch = map(_asked, ("watch", "set_watch"))
    pulses_per_rev = _asked("pulses_per_rev")
    says_homed = False

    def __init__(self, line: LineClient, number: int, own: Drive) -> None:
        self.line, self.number, self.axis, self._own = line, number, own.axis, own
        self.last: Status | None = None
        self._origin: int | None = None
        for name in OF_MAP:
            setattr(self, name, getattr(own, name, None))

    def status(self, retries: int | None = None) -> Status:
        values, homed, origin = self.line.ask(self.number, "status", retries)
        self.says_homed, self._origin = homed, origin
        self.last = Status(*values)
        return self.last

    def forget_origin(self) -> None:
        self.line.ask(self.number, "forget_origin")
        self._origin = None


def line_of(
    config: RigConfig, emit: Callable[..., Any]
) -> tuple[LineClient, list[Drive]]:
    """The line of a session, to be opened, and the drive of each axis on it."""
    line = LineClient(config, emit)
    return line, [DriveClient(line, *made) for made in enumerate(line.own_drives)]
