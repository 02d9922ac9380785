"""An append-only journal of JSON lines that survives the death of its writer.

One record a line, numbered. A posture is on the disk (fsync) before the next begins. A
torn last line, as SIGKILL or a full disk leave it, is dropped by the reader and cut off
by the next writer; any other damage is an error, never a guess.
"""

from __future__ import annotations

import fcntl
import json
import os
import pathlib
import threading
import time
from typing import Any


class JournalError(RuntimeError):
    """The journal cannot be written, or is damaged."""


def _parse(data: bytes, path: pathlib.Path) -> tuple[list[dict[str, Any]], int]:
    """Records and the length in bytes of the undamaged part."""
    records: list[dict[str, Any]] = []
    good = 0
    lines = data.split(b"\n")
    for number, line in enumerate(lines[:-1]):
        try:
            record = json.loads(line)
            if record["seq"] != number:
                raise ValueError
        except (ValueError, KeyError, TypeError):
            if number == len(lines) - 2 and lines[-1] == b"":
                break  # the last line, whole but mangled: also torn
            raise JournalError(
                f"{path}: line {number + 1} is damaged; the run cannot be resumed"
            ) from None
        records.append(record)
        good += len(line) + 1
    return records, good


def read_journal(path: pathlib.Path) -> list[dict[str, Any]]:
    """All whole records.

    Raises:
        JournalError: unreadable, or damaged before its last line.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise JournalError(f"{path}: {error.strerror or error}") from None
    return _parse(data, path)[0]


class Journal:
    """The one writer of a journal; a second one on the same run is refused."""

    def __init__(self, path: pathlib.Path) -> None:
        self.path = path
        self.records: list[dict[str, Any]] = []
        self._lock = threading.Lock()
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
        try:
            self._fd = os.open(path, flags, 0o644)
        except OSError as error:
            raise JournalError(f"{path}: {error.strerror or error}") from None
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(self._fd)
            raise JournalError(f"{path}: a running session is writing it") from None
        data = path.read_bytes()
        try:
            self.records, self._size = _parse(data, path)
        except JournalError:
            os.close(self._fd)
            raise
        if self._size != len(data):
            os.ftruncate(self._fd, self._size)

    def write(self, event: str, *, sync: bool = False, **fields: Any) -> dict[str, Any]:
        """Append one record; with ``sync`` it is on the disk when this returns.

        Raises:
            JournalError: the disk is full or gone; the journal keeps its whole lines.
        """
        with self._lock:
            record = {
                "seq": len(self.records),
                "time": round(time.time(), 4),
                "event": event,
                **fields,
            }
            line = json.dumps(record, allow_nan=False, separators=(",", ":")) + "\n"
            data = line.encode()
            try:
                written = 0
                while written < len(data):
                    written += os.write(self._fd, data[written:])
                if sync:
                    os.fsync(self._fd)
            except OSError as error:
                self._cut()
                raise JournalError(
                    f"cannot write {self.path}: {error.strerror or error}"
                ) from None
            self._size += len(data)
            self.records.append(record)
            return record

    def _cut(self) -> None:
        try:
            os.ftruncate(self._fd, self._size)
        except OSError:
            return  # the torn line is cut off by the next writer

    def events(self, event: str) -> list[dict[str, Any]]:
        """Records of one kind."""
        return [record for record in self.records if record["event"] == event]

    def close(self) -> None:
        """Close the file."""
        os.close(self._fd)
