"""The journal of a run: numbered records, a posture on the disk before the next."""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import json
import os
import pathlib
import re
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from jaxcal.files import write_text
from jaxcal.jsonlines import DamagedError, JsonLines, Record, flock, read_records
from rig.faults import JournalError
from rig.journal.lock import PATIENCE_S

if TYPE_CHECKING:
    from rig.config import RigConfig


def _whole(number: int, record: Record) -> bool:
    """Records are numbered."""
    return bool(record["seq"] == number)


@contextlib.contextmanager
def _told(path: pathlib.Path) -> Iterator[None]:
    """JournalError for whatever is wrong with the file."""
    try:
        yield
    except OSError as error:
        raise JournalError(f"{path}: {error.strerror or error}") from None
    except DamagedError as error:
        raise JournalError(f"{error}; start a new run") from None
    except ValueError as error:
        raise JournalError(str(error)) from None


def read_journal(path: pathlib.Path) -> list[Record]:
    """All whole records; JournalError where one before the last is damaged."""
    with _told(path):
        return read_records(path, _whole)[0]


def is_written(path: pathlib.Path) -> bool:
    """A running session holds the journal; the lock ends with its process."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        return not flock(file.fileno(), fcntl.LOCK_SH)
    return False


def measured_postures(records: list[Record]) -> dict[str, Record]:
    """Every posture measured and not withdrawn since, by name, in order."""
    found: dict[str, Record] = {}
    for record in records:
        if record["event"] == "posture":
            found[record["name"]] = record
        elif record["event"] == "void":
            for name in record["names"]:
                found.pop(name, None)
    return found


class Journal(JsonLines):
    """The one writer of a journal; a second one on the same run is refused."""

    def __init__(self, path: pathlib.Path) -> None:
        with _told(path):
            # A live page that asks `is_written` holds it for an instant.
            super().__init__(path, _whole, patience_s=PATIENCE_S)
        last = self.records[-1]["time"] if self.records else 0.0
        self._clock = max(time.time(), last) - time.monotonic()

    def write(self, event: str, *, sync: bool = False, **fields: Any) -> Record:
        """Append one record; with ``sync`` it is on the disk when this returns. Where
        it cannot be, JournalError, and the journal keeps its whole lines."""

        def make() -> Record:
            # A wall clock that is set meanwhile must not exchange two visits.
            now = round(self._clock + time.monotonic(), 4)
            return {"seq": len(self.records), "time": now, "event": event, **fields}

        try:
            return self.append(make, sync=sync)
        except OSError as error:
            text = f"cannot write {self.path}: {error.strerror or error}"
            raise JournalError(text) from None

    def events(self, event: str) -> list[Record]:
        return [record for record in self.records if record["event"] == event]


JOURNAL = "journal.jsonl"
SCHEMA = 2  # of the first record; runs of others are not read
# A full disk must not keep a stop from the bus or the console, nor end the thread
# that hears the phone.
SPARED = ("write", "stop", "comm_restored", "note", "sender_refused")


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
            raise ValueError(f"cannot make {path}: {error.strerror or error}") from None
        return path
    raise ValueError(f"cannot make a new run under {output}")


class RunFolder:
    """The events of one run. A record that it holds is never made a second time."""

    def __init__(
        self, config: RigConfig, folder: pathlib.Path, mode: str, start: Record
    ) -> None:
        self.config = config
        self.folder = folder
        self.journal = Journal(folder / JOURNAL)
        self.listeners: list[Callable[[Record], None]] = []
        with contextlib.ExitStack() as stack:
            stack.callback(self.journal.close)
            self._begin(mode, start)
            stack.pop_all()

    def _begin(self, mode: str, start: Record) -> None:
        import importlib.metadata  # these two are slow to load, and `stop` is not to be
        import platform

        now = datetime.datetime.now(datetime.UTC)
        provenance = {
            "jaxcal": importlib.metadata.version("jaxcal"),
            "python": platform.python_version(),
            "host": platform.node(),
            "pid": os.getpid(),
            "arguments": sys.argv[1:],
            "started": now.isoformat(timespec="seconds"),
        }
        if starts := self.journal.events("start"):
            if changed := self.config.changed_since(starts[0]):
                raise ValueError(
                    f"{self.folder}: rig.toml has changed since this run began: "
                    f"{'; '.join(changed)}. New measurements would not be comparable. "
                    "Restore these keys, or start a new run"
                )
            self.emit("resume", sync=True, **provenance)
            return
        config, device = self.config.described(), self.config.device_fingerprint()
        start = {"config": config, "device": device, **provenance, **start}
        self.emit("start", sync=True, schema=SCHEMA, mode=mode, **start)

    def emit(self, event: str, *, sync: bool = False, **fields: Any) -> Record:
        """Journal an event, on the disk with ``sync``, then tell the listeners;
        JournalError where the disk is full, but not for a stop's records."""
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
        axes, outputs = self.config.axes, self.config.output_names
        unit = re.sub("[^A-Za-z0-9]+", "_", self.config.output_unit)
        columns = [f"pulses_{axis.name}" for axis in axes]
        columns += [f"u_{axis.unit_name}_{axis.name}" for axis in axes]
        columns += [f"{of}_{unit}_{name}" for of in ("y", "std") for name in outputs]
        rows: list[list[Any]] = [["name", "role", *columns, "samples"]]
        for r in self.postures().values():
            values = r["pulses"] + r["commanded_deg"] + r["measured_deg"] + r["std_deg"]
            rows.append([r["name"], r.get("role", ""), *values, r["samples"]])
        text = "".join(",".join(map(str, row)) + "\n" for row in rows)
        write_text(self.folder / "pairs.csv", text)

    def save_summary(self, summary: dict[str, Any]) -> None:
        write_text(self.folder / "summary.json", json.dumps(summary, indent=1))
