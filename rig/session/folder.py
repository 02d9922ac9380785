"""What a run remembers: its folder, its journal, and the results written from it."""

from __future__ import annotations

import datetime
import json
import pathlib
import platform
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxcal.files import write_text
from rig.attitude import Array
from rig.config.axis import AXIS_NAMES
from rig.config.config import RigConfig
from rig.guard.faults import Refused
from rig.outputs.journal import Journal
from rig.session.measuring import Measurement

JOURNAL = "journal.jsonl"
Record = dict[str, Any]  # of the journal


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
    """The journal of one run. A record that it holds is never made a second time."""

    def __init__(
        self, config: RigConfig, folder: pathlib.Path, mode: str, start: Record
    ) -> None:
        self.config = config
        self.folder = folder
        self.mode = mode
        self.journal = Journal(folder / JOURNAL)
        try:
            self._begin(start)
        except BaseException:
            self.journal.close()
            raise

    def _begin(self, start: Record) -> None:
        fingerprint = self.config.fingerprint()
        starts = self.journal.events("start")
        if starts:
            if starts[0]["fingerprint"] != fingerprint:
                raise Refused(
                    f"{self.folder}: the configuration changed since this run began "
                    "(only the addresses of bus and phone may). Start a new run"
                )
            if starts[0]["mode"] != self.mode:
                raise Refused(f"{self.folder} is a {starts[0]['mode']} run")
            self.journal.write("resume", sync=True, **_provenance())
            return
        self.journal.write(
            "start",
            sync=True,
            schema=1,
            mode=self.mode,
            fingerprint=fingerprint,
            config=self.config.described(),
            **_provenance(),
            **start,
        )

    def remember(self, event: str, make: Callable[[], Record]) -> Record:
        """The record of an event, made and journalled on first use only."""
        known = self.journal.events(event)
        return known[0] if known else self.journal.write(event, sync=True, **make())

    def postures(self) -> dict[str, Record]:
        """Every posture measured and not withdrawn since, by name, in order."""
        found: dict[str, Record] = {}
        for record in self.journal.records:
            if record["event"] == "posture":
                found[record["name"]] = record
            elif record["event"] == "void":
                for name in record["names"]:
                    found.pop(name, None)
        return found

    def unreachable(self, name: str) -> bool:
        """Whether a posture was found out of reach."""
        return any(r["name"] == name for r in self.journal.events("unreachable"))

    def record_posture(
        self, name: str, measured: Measurement, fields: Record
    ) -> Record:
        """Write a posture to the disk."""
        return self.journal.write(
            "posture",
            sync=True,
            name=name,
            pulses=list(measured.pulses),
            feedback=list(measured.feedback),
            commanded_deg=rounded(self.config.to_deg(measured.pulses), 9),
            measured_deg=rounded(measured.angles, 9),
            std_deg=rounded(measured.std, 6),
            samples=measured.samples,
            attitude=rounded(measured.attitude, 12),
            raw_deg=rounded(measured.raw, 5),
            **fields,
        )

    def save_pairs(self) -> None:
        """Write pairs.csv: role, commands, measurements, scatter of every posture."""
        columns = ["name", "role"]
        for what in ("pulses", "u_deg", "y_deg", "std_deg"):
            columns += [f"{what}_{axis}" for axis in AXIS_NAMES]
        lines = [",".join([*columns, "samples"])]
        for r in self.postures().values():
            values = r["pulses"] + r["commanded_deg"] + r["measured_deg"] + r["std_deg"]
            fields = [r["name"], r.get("role", ""), *(repr(v) for v in values)]
            lines.append(",".join([*fields, str(r["samples"])]))
        write_text(self.folder / "pairs.csv", "\n".join(lines) + "\n")

    def save_summary(self, summary: dict[str, Any]) -> None:
        """Write summary.json."""
        write_text(self.folder / "summary.json", json.dumps(summary, indent=1))


def _provenance() -> dict[str, Any]:
    import jaxcal

    return {
        "jaxcal": jaxcal.__version__,
        "python": platform.python_version(),
        "host": platform.node(),
        "arguments": sys.argv[1:],
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def rounded(values: Array, digits: int) -> Any:
    """Nested lists for the journal."""
    return np.round(np.asarray(values, dtype=np.float64), digits).tolist()
