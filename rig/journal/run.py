"""An append-only journal of JSON lines that survives the death of its writer.

One record a line, numbered. A posture is on the disk (fsync) before the next begins. A
torn last line, as SIGKILL or a full disk leave it, is dropped by the reader and cut off
by the next writer; any other damage is an error, never a guess.
"""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import json
import os
import pathlib
import sys
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from jaxcal.files import write_text
from rig.journal.errors import JournalError
from rig.journal.lock import PATIENCE_S, flock, until

if TYPE_CHECKING:
    from rig.config import RigConfig

Record = dict[str, Any]


def _parse(data: bytes, path: pathlib.Path) -> tuple[list[Record], int]:
    """Records and the length in bytes of the undamaged part."""
    records: list[Record] = []
    good = 0
    *lines, tail = data.split(b"\n")
    for number, line in enumerate(lines):
        try:
            record = json.loads(line)
            whole = record["seq"] == number
        except (ValueError, KeyError, TypeError):
            whole = False
        if not whole:
            if number == len(lines) - 1 and not tail:
                break  # the last line, whole but mangled: also torn
            raise JournalError(f"{path}: line {number + 1} is damaged; begin a new run")
        records.append(record)
        good += len(line) + 1
    return records, good


def read_journal(path: pathlib.Path) -> list[Record]:
    """All whole records; JournalError where one before the last is damaged."""
    try:
        return _parse(path.read_bytes(), path)[0]
    except OSError as error:
        raise JournalError(f"{path}: {error.strerror or error}") from None


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


class Journal:
    """The one writer of a journal; a second one on the same run is refused."""

    def __init__(self, path: pathlib.Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        try:
            self._fd = os.open(path, flags, 0o644)
        except OSError as error:
            raise JournalError(f"{path}: {error.strerror or error}") from None
        try:
            # A live page that asks `is_written` holds it for an instant.
            if not until(PATIENCE_S, lambda: flock(self._fd, fcntl.LOCK_EX)):
                raise JournalError(f"{path}: a running session is writing it")
            self.records, self._size = _parse(path.read_bytes(), path)
            os.ftruncate(self._fd, self._size)
            last = self.records[-1]["time"] if self.records else 0.0
            self._clock = max(time.time(), last) - time.monotonic()
        except BaseException:
            self.close()
            raise

    def write(self, event: str, *, sync: bool = False, **fields: Any) -> Record:
        """Append one record; with ``sync`` it is on the disk when this returns.

        Raises:
            JournalError: the disk is full or gone; the journal keeps its whole lines.
        """
        with self._lock:
            # A wall clock that is set meanwhile must not exchange two visits.
            now = round(self._clock + time.monotonic(), 4)
            record = {"seq": len(self.records), "time": now, "event": event, **fields}
            line = json.dumps(record, allow_nan=False, separators=(",", ":")) + "\n"
            data = line.encode()
            try:
                written = 0
                while written < len(data):
                    written += os.write(self._fd, data[written:])
                if sync:
                    os.fsync(self._fd)
            except BaseException as error:  # a signal's too, while nothing is armed
                with contextlib.suppress(OSError):  # or the next writer cuts it off
                    os.ftruncate(self._fd, self._size)
                if not isinstance(error, OSError):
                    raise
                raise JournalError(
                    f"cannot write {self.path}: {error.strerror or error}"
                ) from None
            self._size += len(data)
            self.records.append(record)
            return record

    def events(self, event: str) -> list[Record]:
        return [record for record in self.records if record["event"] == event]

    def close(self) -> None:
        os.close(self._fd)


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
        try:
            self._begin(mode, start)
        except BaseException:
            self.journal.close()
            raise

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
        if known := self.journal.events("start"):
            if changed := self.config.changed_since(known[0]["config"]):
                raise ValueError(
                    f"{self.folder}: rig.toml differs from when this run began: "
                    f"{'; '.join(changed)}. What is measured now would not be "
                    "comparable. Set these keys back, or start a new run"
                )
            self.emit("resume", sync=True, **provenance)
            return
        config, device = self.config.described(), self.config.device_fingerprint()
        start = {"config": config, "device": device, **provenance, **start}
        self.emit("start", sync=True, schema=SCHEMA, mode=mode, **start)

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
        inputs, outputs = self.config.axis_names, self.config.output_names
        columns = [f"{what}_{name}" for what in ("pulses", "u_deg") for name in inputs]
        columns += [
            f"{what}_{name}" for what in ("y_deg", "std_deg") for name in outputs
        ]
        rows: list[list[Any]] = [["name", "role", *columns, "samples"]]
        for r in self.postures().values():
            values = r["pulses"] + r["commanded_deg"] + r["measured_deg"] + r["std_deg"]
            rows.append([r["name"], r.get("role", ""), *values, r["samples"]])
        text = "".join(",".join(map(str, row)) + "\n" for row in rows)
        write_text(self.folder / "pairs.csv", text)

    def save_summary(self, summary: dict[str, Any]) -> None:
        write_text(self.folder / "summary.json", json.dumps(summary, indent=1))
