"""What one page process knows of a run, shared by all browsers that look at it."""

from __future__ import annotations

import json
import os
import pathlib
import platform
import signal
import time
from collections import deque
from typing import Any

from rig.core.faults import Refused
from rig.core.stop import UnitStop
from rig.journal import is_written
from rig.signals import PAUSE
from rig.stopping import stop_run
from rig.workbench.live.state import RunState
from rig.workbench.outputs.telemetry import PERIOD_S, TELEMETRY

Record = dict[str, Any]


class Tail:
    """Records of a file of JSON lines, each given once; the file may come later.

    A line counts once its end is written. A file that was replaced by a new one is read
    from its beginning.
    """

    def __init__(self, path: pathlib.Path, last_bytes: int | None = None) -> None:
        self.path = path
        self._inode: int | None = None
        self._offset = 0
        self._last_bytes = last_bytes  # of what stands there at first; None: all of it

    def read(self) -> list[Record]:
        """Records since the last call; a line that is not one is left out."""
        try:
            with self.path.open("rb") as file:
                status = os.fstat(file.fileno())
                if status.st_ino != self._inode or status.st_size < self._offset:
                    first = self._inode is None and self._last_bytes is not None
                    skip = status.st_size - (self._last_bytes or 0) if first else 0
                    self._inode, self._offset = status.st_ino, max(0, skip)
                file.seek(self._offset)
                data = file.read()
        except OSError:
            return []
        whole = data[: data.rfind(b"\n") + 1]
        self._offset += len(whole)
        records = []
        for line in whole.splitlines():
            try:
                record = json.loads(line)
            except ValueError:  # cut in two by last_bytes, or torn by a kill
                continue
            if isinstance(record, dict):
                records.append(record)
        return records


JOURNAL = "journal.jsonl"
SHOWN_S = 30.0  # of telemetry
FIRST_BYTES = 200_000  # of telemetry that stood there before: more than SHOWN_S
ASK_S = 0.5  # between two looks at the journal's lock


class Watcher:
    """State of a run, read anew by ``poll``; asks its session to pause or to stop."""

    def __init__(self, folder: pathlib.Path) -> None:
        self.folder = folder
        self.state = RunState()
        self.samples: deque[Record] = deque(maxlen=int(SHOWN_S / PERIOD_S))
        self.running = False  # a session holds the journal
        self.version = 0  # grows with every change that is not telemetry
        self.summary: dict[str, Any] = {}
        self._journal = Tail(folder / JOURNAL)
        self._telemetry = Tail(folder / TELEMETRY, FIRST_BYTES)
        self._asked = 0.0

    def poll(self) -> None:
        """Take what is new."""
        records = self._journal.read()
        for record in records:
            try:
                self.state.apply(record)
            except (KeyError, ValueError, TypeError, IndexError):
                self.state.damaged = True  # of another version, or edited by hand
        self.samples.extend(self._telemetry.read())
        running, now = self.running, time.monotonic()
        if records or now - self._asked > ASK_S:
            self._asked, running = now, is_written(self.folder / JOURNAL)
        if records or running != self.running:
            self.running = running
            self.version += 1
            if self.state.ended is not None:
                self.summary = self._read_summary()

    def _read_summary(self) -> dict[str, Any]:
        try:
            text = (self.folder / "summary.json").read_text(encoding="utf-8")
            return dict(json.loads(text))
        except (OSError, ValueError):
            return {}

    @property
    def report(self) -> pathlib.Path | None:
        """report.html, where the run has one."""
        path = self.folder / "report.html"
        return path if path.is_file() else None

    @property
    def here(self) -> bool:
        """The session runs on this computer: a signal reaches it."""
        return self.running and self.state.host == platform.node()

    def ask(self, number: signal.Signals) -> str:
        """Send the session SIGTERM (stop now) or PAUSE (after this posture).

        Returns:
            What was done, in words.

        Raises:
            Refused: nothing was sent, and why.
        """
        self.poll()
        pid = self.state.pid
        if not self.here or pid is None or not is_written(self.folder / JOURNAL):
            raise Refused("nothing was sent: no session of this run is running here")
        if number == PAUSE and self.state.phase in ("opening", "finishing"):
            raise Refused("there is nothing to pause: nothing is moving now")
        try:
            os.kill(pid, number)
        except OSError as error:
            raise Refused(
                f"NOT SENT to process {pid}: {error.strerror}. Press Ctrl-C twice in "
                "its terminal, or use the emergency stop"
            ) from None
        if number == PAUSE:
            return "pause asked for: the session finishes this posture first"
        return f"STOP sent to process {pid}"

    def stopped(self, since: float) -> list[UnitStop]:
        """What became of a stop that was asked for at ``since`` (Unix time).

        It is waited for what the session says of its drives; where it says nothing,
        the session is ended and the drives are stopped from here.

        Raises:
            Fault: no drive was told to stop.
        """
        end = time.monotonic() + ASK_S
        while time.monotonic() < end:
            stop = self.state.stop
            if stop is not None and stop["time"] >= since:
                return [UnitStop(**unit) for unit in stop["units"]]
            if not is_written(self.folder / JOURNAL):
                return []  # it had armed nothing
            time.sleep(0.02)
        return stop_run(self.folder)
