"""What the rig keeps on disk: its runs, its device, and who moves it.

Names load on first use: `stop` needs the lock alone.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rig.faults import JournalError, Refused
    from rig.journal.device import (
        HOMED,
        IDENTIFIED,
        SIGN_CHECKED,
        STATES,
        STOP_PROVED,
        ZEROED,
        DeviceRecord,
    )
    from rig.journal.lock import BusLock
    from rig.journal.run_folder import (
        JOURNAL,
        Journal,
        Record,
        RunFolder,
        is_written,
        measured_postures,
        new_run_folder,
        read_journal,
    )

__all__ = [
    "HOMED", "IDENTIFIED", "JOURNAL", "SIGN_CHECKED", "STATES", "STOP_PROVED",
    "ZEROED", "BusLock", "DeviceRecord", "Journal", "JournalError", "Record", "Refused",
    "RunFolder", "is_written", "measured_postures", "new_run_folder", "read_journal",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    for part in ("lock", "device", "run_folder") if name in __all__ else ():
        module = importlib.import_module(f"rig.journal.{part}")
        if hasattr(module, name):
            return getattr(module, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
