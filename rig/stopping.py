"""The command ``stop``: ask who moves the device to stop, then stop every unit itself.

It works with a configuration file that no session accepts, and no signal ends it before
the drives were told.
"""

from __future__ import annotations

import contextlib
import pathlib
import signal
import time
from typing import Any

from rig.config.salvage import Stoppable, read_for_stop
from rig.config.schema import ConfigError
from rig.config.settings import BusSettings
from rig.core.bus import Bus, BusError
from rig.core.drive import Drive
from rig.core.faults import EXIT_FAULT, EXIT_OK, Fault, Refused
from rig.core.lock import BusLock, held_by
from rig.core.stop import UnitStop, stop_all
from rig.signals import Signals

HOLDER_S = 5.0  # for a session to see its drives stand, and to end
HOLDER_WAITS = 6  # and so many times the bus's timeout, for units that do not answer
NOTHING = "NOTHING WAS STOPPED BY THIS COMMAND"
LAST_RESORT = "Use the emergency stop"


def stop_device(path: pathlib.Path) -> int:
    """Stop the drives of a configuration file; the exit code is 0 if all stand.

    Raises:
        Fault: no drive was told to stop.
    """
    with Signals() as signals:
        signals.armed = True  # it takes seconds at most: a signal does not cut it short
        try:
            found = read_for_stop(path)
        except ConfigError as error:
            raise Fault(f"{NOTHING}: {error}. {LAST_RESORT}") from None
        for fault in found.ignored:
            _say(f"ignored in {path}: {fault}")
        if found.bus is None or not found.axes:
            lack = "no bus" if found.bus is None else "no drive"
            lost = "".join(f"\n  NOT STOPPED: {text}" for text in found.lost)
            raise Fault(
                f"{NOTHING}: {path} names {lack} that can be reached. {LAST_RESORT}"
                f"{lost}"
            )
        lock = BusLock(found.bus)
        reported = _ask_holder(lock, found.bus.timeout_s)
        try:
            lock.acquire("stop")
        except (OSError, Refused) as error:  # a stop waits for nobody
            _say(str(error))
        with lock:
            return _stop_units(found, found.bus, reported)


def _say(text: str) -> None:
    """Print; a terminal that is gone does not end a stop."""
    with contextlib.suppress(OSError):
        print(text, flush=True)


def _ask_holder(lock: BusLock, timeout_s: float) -> str:
    """Tell the holder to stop, and wait for it; what it reported."""
    asked = time.time()
    try:
        holder = lock.signal_holder(signal.SIGTERM)
    except (OSError, Refused) as error:  # the lock is a help, not a condition
        _say(f"cannot ask who holds {lock.where}: {error}")
        return ""
    if holder is None:
        return ""
    print(f"{lock.where} is {held_by(holder)}: told to stop now")
    ended = lock.freed(HOLDER_S + HOLDER_WAITS * timeout_s)
    reported = _reported(holder, asked)
    _say(reported or "it has reported no stop")
    if not ended:
        _say("it still holds the bus")
    return reported


def _reported(holder: dict[str, Any], since: float) -> str:
    """The lines of the stop that a session journalled since it was asked."""
    from rig.journal import JournalError, read_journal

    if not holder.get("run"):
        return ""
    try:
        records = read_journal(pathlib.Path(holder["run"]) / "journal.jsonl")
    except JournalError:
        return ""
    stops = [r for r in records if r["event"] == "stop" and r["time"] >= since]
    lines = [f"  {UnitStop(**unit)}" for stop in stops[:1] for unit in stop["units"]]
    return "\n".join(["the session reported:", *lines]) if lines else ""


def _stop_units(found: Stoppable, settings: BusSettings, reported: str) -> int:
    silence = max(axis.map.inter_frame_s for axis in found.axes)
    bus = Bus(settings, silence)
    try:
        bus.open()
    except BusError as error:
        what = f"\n{reported}" if reported else f" {LAST_RESORT}"
        raise BusError(f"{NOTHING}: {error}.{what}") from None
    with bus:
        results = stop_all([Drive(bus, axis) for axis in found.axes])
    for result in results:
        _say(str(result))
    for text in found.lost:
        _say(f"NOT STOPPED: {text}. {LAST_RESORT}")
    stopped = all(r.acknowledged and r.standing for r in results)
    return EXIT_OK if stopped and not found.lost else EXIT_FAULT
