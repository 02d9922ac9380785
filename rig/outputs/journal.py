"""An append-only journal of JSON lines that survives the death of its writer.

One record a line, numbered. A posture is on the disk (fsync) before the next begins. A
torn last line, as SIGKILL or a full disk leave it, is dropped by the reader and cut off
by the next writer; any other damage is an error, never a guess.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import pathlib
import threading
import time
from typing import Any

from rig.faults import Fault

Record = dict[str, Any]


class JournalError(Fault):
    """The journal cannot be written, or is damaged."""


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
            raise JournalError(
                f"{path}: line {number + 1} is damaged; the run cannot be resumed"
            )
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
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        pass
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
            self._claim()
            self.records, self._size = _parse(path.read_bytes(), path)
            os.ftruncate(self._fd, self._size)
        except BlockingIOError:
            self.close()
            raise JournalError(f"{path}: a running session is writing it") from None
        except BaseException:
            self.close()
            raise

    def _claim(self) -> None:
        """Lock the file. A live page that asks `is_written` holds it for an instant."""
        for _ in range(20):
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return
            time.sleep(0.01)
        fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def write(self, event: str, *, sync: bool = False, **fields: Any) -> Record:
        """Append one record; with ``sync`` it is on the disk when this returns.

        Raises:
            JournalError: the disk is full or gone; the journal keeps its whole lines.
        """
        with self._lock:
            now = round(time.time(), 4)
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
        """Records of one kind."""
        return [record for record in self.records if record["event"] == event]

    def close(self) -> None:
        os.close(self._fd)
