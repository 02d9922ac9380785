"""What a run remembers: its folder, its events, and the results written from them."""

from __future__ import annotations

import csv
import datetime
import io
import json
import os
import pathlib
import platform
import sys
from collections.abc import Callable
from typing import Any

from jaxcal.files import write_text
from rig.config import AXIS_NAMES, RigConfig
from rig.faults import Refused
from rig.outputs.journal import Journal, JournalError, Record, measured_postures

JOURNAL = "journal.jsonl"
SPARED = (
    "write",
    "stop",
    "comm_restored",
)  # a full disk must not keep a stop from the bus


def new_run_folder(output: pathlib.Path, mode: str) -> pathlib.Path:
    """Make ``output/mode-date-time``, never an existing one."""
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    for number in range(100):
        path = output / (f"{mode}-{stamp}" + (f"-{number}" if number else ""))
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise Refused(f"cannot make {path}: {error.strerror or error}") from None
        return path
    raise Refused(f"cannot make a new run under {output}")


class RunFolder:
    """The events of one run. A record that it holds is never made a second time."""

    def __init__(
        self, config: RigConfig, folder: pathlib.Path, mode: str, start: Record
    ) -> None:
        self.config = config
        self.folder = folder
        self.journal = Journal(folder / JOURNAL)
        self.listeners: list[Callable[[Record], None]] = []
        try:
            self._begin(mode, start)
        except BaseException:
            self.journal.close()
            raise

    def _begin(self, mode: str, start: Record) -> None:
        import jaxcal

        now = datetime.datetime.now(datetime.UTC)
        provenance = {
            "jaxcal": jaxcal.__version__,
            "python": platform.python_version(),
            "host": platform.node(),
            "pid": os.getpid(),
            "arguments": sys.argv[1:],
            "started": now.isoformat(timespec="seconds"),
        }
        if known := self.journal.events("start"):
            if changed := self.config.changed_since(known[0]["config"]):
                raise Refused(
                    f"{self.folder}: the configuration changed since this run began: "
                    f"{'; '.join(changed)}. Addresses and limits may change, nothing "
                    "else. Start a new run"
                )
            if known[0]["mode"] != mode:
                raise Refused(f"{self.folder} is a {known[0]['mode']} run")
            self.emit("resume", sync=True, **provenance)
            return
        config, fingerprint = self.config.described(), self.config.fingerprint()
        device = self.config.device_fingerprint()
        start = {"config": config, "device": device, **provenance, **start}
        self.emit(
            "start", sync=True, schema=1, mode=mode, fingerprint=fingerprint, **start
        )

    def emit(self, event: str, *, sync: bool = False, **fields: Any) -> Record:
        """Journal an event, then tell the listeners: the one stream of a run.

        With ``sync`` it is on the disk before anything follows. Where the disk is full
        JournalError is raised, but not for a stop and its frames.
        """
        record: Record = {"event": event, **fields}
        try:
            record = self.journal.write(event, sync=sync, **fields)
        except JournalError:
            if event not in SPARED:
                raise
        for listener in self.listeners:
            listener(record)
        return record

    def remember(self, event: str, make: Callable[[], Record]) -> Record:
        """The record of an event, made and journalled on first use only."""
        known = self.journal.events(event)
        return known[0] if known else self.emit(event, sync=True, **make())

    def postures(self) -> dict[str, Record]:
        """Every posture measured and not withdrawn since, by name, in order."""
        return measured_postures(self.journal.records)

    def save_pairs(self) -> None:
        """Write pairs.csv: role, commands, measurements, scatter of every posture."""
        of_axes = ("pulses", "u_deg", "y_deg", "std_deg")
        columns = [f"{what}_{axis}" for what in of_axes for axis in AXIS_NAMES]
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        table.writerow(["name", "role", *columns, "samples"])
        for r in self.postures().values():
            values = r["pulses"] + r["commanded_deg"] + r["measured_deg"] + r["std_deg"]
            table.writerow([r["name"], r.get("role", ""), *values, r["samples"]])
        write_text(self.folder / "pairs.csv", text.getvalue())

    def save_summary(self, summary: dict[str, Any]) -> None:
        """Write summary.json."""
        write_text(self.folder / "summary.json", json.dumps(summary, indent=1))
