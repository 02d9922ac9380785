"""What the rig keeps on disk: its runs, its device, and who moves it.

``stop`` reads these before anything heavy is loaded, so nothing here loads pydantic.
"""

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
