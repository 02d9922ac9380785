"""What one page process knows of a run, shared by all browsers that look at it."""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import platform
import signal
import threading
import time
from collections import deque
from typing import Any

from rig.core.stop import UnitStop
from rig.faults import PAUSE, Fault, Refused
from rig.journal.lock import armed_files, read_armed
from rig.journal.run_folder import JOURNAL, Record, is_written
from rig.outputs.run_state import RunState
from rig.outputs.telemetry import PERIOD_S, TELEMETRY
from rig.stopping import NOTHING, armed_bus, stop_units
from rig_workbench.live.charts import SHOWN_S

ASK_S = 0.5  # between two looks at the journal's lock; for a session to say it stopped


class Tail:
    """Records of a file of JSON lines that may come later, each given once its end is
    written; a file that was replaced is read from its beginning."""

    def __init__(self, path: pathlib.Path) -> None:
        self.path = path
        self._inode, self._offset = -1, 0

    def read(self) -> list[Record]:
        """Records since the last call; a line that is not one is left out."""
        try:
            with self.path.open("rb") as file:
                if (inode := os.fstat(file.fileno()).st_ino) != self._inode:
                    self._inode, self._offset = inode, 0
                file.seek(self._offset)
                data = file.read()
        except OSError:
            return []
        whole = data[: data.rfind(b"\n") + 1]
        self._offset += len(whole)
        records = []
        for line in whole.splitlines():
            try:
                records.append(json.loads(line))
            except ValueError:  # torn by a kill
                continue
        return [record for record in records if isinstance(record, dict)]


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
        self._telemetry = Tail(folder / TELEMETRY)
        self._asked = 0.0
        self._polling = threading.Lock()

    def poll(self) -> None:
        """Take what is new; the server's loop and a stop's thread both ask."""
        with self._polling:
            records = self._journal.read()
            for record in records:
                self.state.apply(record)
            self.samples.extend(self._telemetry.read())
            before, now = self.running, time.monotonic()
            if records or now - self._asked > ASK_S:
                self._asked, self.running = now, is_written(self.folder / JOURNAL)
            if not records and self.running == before:
                return
            self.version += 1
            if self.state.ended is not None:
                with contextlib.suppress(OSError, ValueError):  # it may have none
                    text = (self.folder / "summary.json").read_text(encoding="utf-8")
                    self.summary = dict(json.loads(text))

    @property
    def report(self) -> pathlib.Path | None:
        path = self.folder / "report.html"
        return path if path.is_file() else None

    @property
    def here(self) -> bool:
        """The session runs on this computer: a signal reaches it."""
        return self.running and self.state.host == platform.node()

    def ask(self, number: signal.Signals) -> None:
        """Send the session SIGTERM (stop now) or PAUSE (after this posture); Refused
        where nothing was sent, and why."""
        self.poll()
        pid = self.state.pid
        if not self.here or pid is None or not is_written(self.folder / JOURNAL):
            raise Refused(
                "nothing was sent: no session of this run is running on this computer. "
                "If the device moves, use the emergency stop"
            )
        if number == PAUSE and self.state.phase in ("opening", "finishing"):
            raise Refused("nothing to pause: nothing is moving now")
        try:
            os.kill(pid, number)
        except OSError as error:
            raise Refused(
                f"NOT SENT to process {pid}: {error.strerror}. Press Ctrl-C twice in "
                "its terminal, or use the emergency stop"
            ) from None

    def stop(self) -> list[UnitStop]:
        """Ask the session to stop; what it says of its drives. Where it says nothing,
        it is ended and the drives are stopped from here.

        Raises:
            Refused: nothing was sent. Fault: no drive was told to stop.
        """
        since, end = time.time(), time.monotonic() + ASK_S
        self.ask(signal.SIGTERM)
        while time.monotonic() < end:
            ended = not is_written(self.folder / JOURNAL)
            self.poll()  # after the look at the lock: its last word is written before
            stop = self.state.stop
            if stop is not None and stop["time"] >= since:
                return [UnitStop(**unit) for unit in stop["units"]]
            if ended:
                return []  # it had armed nothing
            time.sleep(0.02)
        for path in armed_files():
            target = armed_bus(read_armed(path))
            holder = target and target.lock.holder()
            if target and holder and holder.get("run") == str(self.folder.resolve()):
                target.ask()
                return stop_units(target)
        name = self.folder.name
        raise Fault(f"{NOTHING}: no session of this computer moves {name}")
