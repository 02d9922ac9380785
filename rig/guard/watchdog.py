"""The watchdog of the motion loop."""

from __future__ import annotations

import contextlib
import threading
import time

from rig.device.bus import BusError
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

    def feed(self, moving: bool) -> None:
        """The motion loop is alive; ``moving``: it must be heard again soon."""
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
                self._stopper.stop(f"heartbeat lost for {silence:.1f} s while moving")
                return
            if not self._moving and self._keep_alive_s and silence > self._keep_alive_s:
                for drive in self._stopper.drives:
                    with contextlib.suppress(BusError):  # the plan's own reads find it
                        drive.status(retries=0)
                self._fed = time.monotonic()
