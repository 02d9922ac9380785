"""The watchdogs: of the motion loop, in a thread; of the line, in the drives."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from rig.config.registers import decode, registers_of
from rig.device.bus import BusError
from rig.device.drives import Drive
from rig.faults import StopRequested
from rig.guard.stop import Stopper


class Heartbeat(threading.Thread):
    """A thread that stops the drives when the motion loop is silent for too long.

    It also keeps the line alive for drives that watch their communication while the
    plan computes or writes, when nothing moves.
    """

    def __init__(self, stopper: Stopper, silence_s: float, keep_alive_s: float) -> None:
        super().__init__(name="heartbeat", daemon=True)
        self._stopper = stopper
        self._silence_s = silence_s
        self._keep_alive_s = keep_alive_s
        self._moving = False
        self._fed = time.monotonic()
        self._closing = threading.Event()

    def feed(self, moving: bool | None = None) -> None:
        """The motion loop is alive; ``moving``: it must be heard again soon."""
        if moving is not None:
            self._moving = moving
        self._fed = time.monotonic()

    def close(self) -> None:
        self._closing.set()
        if self.is_alive():
            self.join(2.0)

    def run(self) -> None:
        while not self._closing.wait(0.05):
            silence = time.monotonic() - self._fed
            if self._moving and silence > self._silence_s:
                self._stopper.stop(f"heartbeat lost for {silence:.2f} s while moving")
                return
            if not self._moving and self._keep_alive_s and silence > self._keep_alive_s:
                for drive in self._stopper.drives:
                    # The plan's own reads find what is wrong.
                    with contextlib.suppress(BusError, StopRequested):
                        drive.status(retries=0)
                self._fed = time.monotonic()


class LineWatch:
    """The communication timeout of the drives that have one: lent, and given back.

    What the register held is journalled before it is changed, so that a later process
    can put it back for one that was killed.
    """

    def __init__(
        self,
        drives: list[Drive],
        timeouts_s: Mapping[str, float],
        emit: Callable[..., Any],
        left: Mapping[str, Mapping[str, Any]],
    ) -> None:
        self._watched = [drive for drive in drives if drive.axis.name in timeouts_s]
        self._timeouts_s = timeouts_s
        self._emit = emit
        self._left = left
        self._before: dict[str, int] = {}

    def apply(self) -> None:
        """Set the timeouts.

        Raises:
            BusError: a register cannot be written, or not be read and so not restored.
        """
        for drive in self._watched:
            axis, watch = drive.axis, drive.axis.map.comm_timeout
            assert watch is not None
            address, kind = watch.place_of("timeout") or (watch.write[0].address, "u16")
            order = axis.map.word_order
            words = drive.bus.read_words(axis.unit, address, registers_of(kind))
            before = decode(words, kind, order)
            counts = max(1, math.ceil(self._timeouts_s[axis.name] * watch.per_s - 1e-9))
            left = self._left.get(axis.name)
            if left and before == left["counts"]:  # a killed session's, not the drive's
                before = left["before"]
            self._emit(
                "comm_timeout", sync=True, axis=axis.name, before=before, counts=counts
            )
            self._before[axis.name] = before
            drive.write(watch, timeout=counts)

    def restore(self, standing: set[str]) -> None:
        """Give back what was there, of the axes that stand; never raises.

        A drive that was not seen to stand keeps its timeout: it stops itself.
        """
        for drive in self._watched:
            name = drive.axis.name
            if name not in self._before:
                continue
            error = "not seen standing"
            if name in standing:
                try:
                    with drive.bus.urgent():
                        drive.write(
                            drive.axis.map.comm_timeout, timeout=self._before[name]
                        )
                    error = ""
                except Exception as caught:
                    error = str(caught)
            counts = self._before.pop(name)
            self._emit("comm_restored", axis=name, counts=counts, error=error)


def timeouts_left(records: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """The ``comm_timeout`` records of a journal that no restoring has followed."""
    left: dict[str, dict[str, Any]] = {}
    for record in records:
        if record["event"] == "comm_timeout":
            left[record["axis"]] = record
        elif record["event"] == "comm_restored" and not record["error"]:
            left.pop(record["axis"], None)
    return left
