"""New lines of a file that another process appends to."""

from __future__ import annotations

import json
import os
import pathlib
from typing import Any

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
