"""A file of JSON records, one a line, that survives the death of its writer.

One process writes it at a time. A torn last line, as SIGKILL or a full disk leave it,
is dropped by the reader and cut off by the next writer; any other damage is an error,
never a guess. The journals of closed loops and of the rig are such files.
"""

from __future__ import annotations

import contextlib
import json
import os
import pathlib
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl


Record = dict[str, Any]
LOOK_S = 0.02  # between two tries
EXCLUSIVE = 2  # flock's LOCK_EX


class DamagedError(ValueError):
    """A record before the last is not one."""


class JsonLines:
    """The one writer of a file of records.

    Args:
        path: made where missing, in an existing folder.
        whole: number of a record and the record -> whether it is one.
        check: told of the records that the file holds; what it raises leaves the file
            as it is.
        patience_s: how long to wait for another process that holds the file.

    Raises:
        ValueError: another process is writing it, or it is damaged.
        OSError: it cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        whole: Callable[[int, Record], bool],
        check: Callable[[list[Record]], None] = lambda records: None,
        patience_s: float = 0.0,
    ) -> None:
        self.path = pathlib.Path(path)
        self._lock = threading.Lock()
        flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0)
        self._fd = os.open(self.path, flags, 0o644)
        try:
            if not until(patience_s, lambda: flock(self._fd)):
                raise ValueError(f"{path}: another session is writing this file")
            self.records, self._size = read_records(self.path, whole)
            check(self.records)
            os.ftruncate(self._fd, self._size)
        except BaseException:
            self.close()
            raise

    def append(self, make: Callable[[], Record], *, sync: bool) -> Record:
        """Write the record that ``make`` returns, in the order of the calls.

        With ``sync`` it is on the disk (fsync) when this returns.

        Raises:
            ValueError: it holds a number that is not finite.
            OSError: the disk is full or gone; the file keeps its whole lines.
        """
        with self._lock:
            record = make()
            line = json.dumps(record, allow_nan=False, separators=(",", ":")) + "\n"
            data = line.encode()
            try:
                written = 0
                while written < len(data):
                    written += os.write(self._fd, data[written:])
                if sync:
                    os.fsync(self._fd)
            except BaseException:  # of a signal too
                with contextlib.suppress(OSError):  # or the next writer cuts it off
                    os.ftruncate(self._fd, self._size)
                raise
            self._size += len(data)
            self.records.append(record)
            return record

    def close(self) -> None:
        """Let another process write the file."""
        os.close(self._fd)


def read_records(
    path: pathlib.Path, whole: Callable[[int, Record], bool]
) -> tuple[list[Record], int]:
    """Records, and the bytes that their lines take; a DamagedError where one before the
    last is not whole."""
    records: list[Record] = []
    size = 0
    *lines, tail = path.read_bytes().split(b"\n")
    for number, line in enumerate(lines):
        try:
            record = json.loads(line)
            fine = isinstance(record, dict) and whole(number, record)
        except (ValueError, KeyError, TypeError):
            fine = False
        if not fine:
            if number == len(lines) - 1 and not tail:
                break  # the last line, whole but mangled: also torn
            raise DamagedError(f"{path}: line {number + 1} is damaged")
        records.append(record)
        size += len(line) + 1
    return records, size


def until(seconds: float, holds: Callable[[], bool]) -> bool:
    """Wait at most so long for something to hold; whether it does."""
    end = time.monotonic() + seconds
    while not (held := holds()) and time.monotonic() < end:
        time.sleep(LOOK_S)
    return held


def flock(fd: int, kind: int = EXCLUSIVE) -> bool:
    """Take the lock of an open file, unless another holds it; whether it was taken.

    On Windows, where a lock keeps others from reading, it is that of a byte far behind
    the file's end, and always exclusive.
    """
    try:
        if sys.platform == "win32":
            os.lseek(fd, 1 << 30, os.SEEK_SET)  # what is written goes to the end
            msvcrt.locking(fd, msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(fd, kind | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True
