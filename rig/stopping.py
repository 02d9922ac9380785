"""The command ``stop``: ask who moves the device, end them, stop every drive itself.

The holder of a bus is asked first, before anything heavy is loaded. One that has not
told its drives to stop ASK_S later, because it hangs or is suspended, is killed: the
kernel frees the lock and the port. Then each drive is stopped and looked at from here.
What a session left beside the lock when it armed is enough for that; a configuration
file is read where nothing is armed. No signal ends this before the drives were told.
"""

from __future__ import annotations

import contextlib
import pathlib
import signal
import sys
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor, as_completed
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from rig.faults import EXIT_FAULT, EXIT_OK, Fault, Refused
from rig.journal.lock import BusLock, armed_files, held_by, read_armed

if TYPE_CHECKING:
    from rig.core.stop import UnitStop

ASK_S = 0.5  # for the holder to have told its drives
END_S = 2.0  # more for one that has, to write its last lines and end
KILLED_S = 0.5  # for the kernel to end a process that was killed
NOTHING = "NOTHING WAS STOPPED BY THIS COMMAND"
LAST_RESORT = "Use the emergency stop"


class ArmedBus:
    """One bus: its lock, and what of it was armed last."""

    def __init__(self, bus: dict[str, Any]) -> None:
        fields = {
            "transport": "",
            "host": "",
            "port": 502,
            "device": "",
            "interface": "",
        }
        fields |= bus
        where = fields["device"] or f"{fields['host']}:{fields['port']}"
        settings: Any = SimpleNamespace(**fields, where=where)  # pydantic's are heavy
        self.lock = BusLock(settings)
        self.armed = read_armed(self.lock.armed_path)
        self.since = time.monotonic()
        self.holder: dict[str, Any] | None = None

    def ask(self) -> None:
        """Tell the holder to stop."""
        try:
            self.holder = self.lock.signal_holder(signal.SIGTERM)
        except (OSError, Refused) as error:  # the lock is a help, not a condition
            _say(f"cannot ask who holds {self.lock.where}: {error}")
        if self.holder is not None:
            _say(f"{self.lock.where} is {held_by(self.holder)}: told to stop now")

    def end(self) -> None:
        """Wait for the holder; kill one that has not stopped its drives in time."""
        if self.holder is None:
            return
        freed = self.lock.freed(ASK_S - (time.monotonic() - self.since))
        if not freed and self._stand:  # it looks whether they stay
            stand_s = (read_armed(self.lock.armed_path) or {}).get("stand_s", 0.0)
            freed = self.lock.freed(END_S + stand_s)
        if not freed:
            _say("it has not stopped its drives in time: it is killed now")
            with contextlib.suppress(OSError, Refused):
                self.lock.signal_holder(signal.SIGKILL)
            if not self.lock.freed(KILLED_S):
                _say("it still holds the bus")
        _say(
            "it reported that all its drives stand"
            if self._stand
            else "it did not report that its drives stand"
        )

    @property
    def _stand(self) -> bool:
        """Whatever the holder armed, it has seen standing since."""
        armed = read_armed(self.lock.armed_path)
        return armed is None or armed["standing"]


def stop_device(path: pathlib.Path, given: bool = True) -> int:
    """Stop what is armed on the bus of a configuration file; 0 if all drives stand.

    Without a file of use, everything that sessions of this user have armed.

    Args:
        path: of rig.toml.
        given: an operator named it.

    Raises:
        Fault: no drive was told to stop.
    """
    from rig.signals import Signals

    with Signals() as signals:
        signals.armed = True  # it takes seconds at most: a signal does not cut it short
        targets, lack = _targets(path, given)
        if not targets:
            raise Fault(
                f"{NOTHING}: {lack}, and no session of this user has armed a device. "
                f"{LAST_RESORT}"
            )
        if lack:
            _say(f"{lack}: stopping all that sessions of this user have armed")
        for target in targets:
            target.ask()
        # While those asked have time.
        from rig.core import stop  # noqa: F401
        from rig.drives import modbus  # noqa: F401

        results: list[UnitStop] = []
        faults: list[Fault] = []
        with ThreadPoolExecutor(len(targets)) as pool:
            jobs = [pool.submit(_stop_units, target, path, True) for target in targets]
            for job in as_completed(jobs):
                try:
                    results += job.result()
                    _say("\n".join(map(str, job.result())))
                except Fault as error:
                    faults.append(error)
        _tell_others([target.lock.armed_path for target in targets])
        if len(faults) == len(jobs):
            raise faults[0]
        for fault in faults:
            _say(str(fault))
        good = all(result.acknowledged and result.standing for result in results)
        return EXIT_OK if good and not faults else EXIT_FAULT


def stop_run(run: pathlib.Path) -> list[UnitStop]:
    """Stop the device that a session of this computer moves; what the drives say.

    Args:
        run: folder of the session's run.

    Raises:
        Fault: no drive was told to stop.
    """
    for path in armed_files():
        armed = read_armed(path)
        target = armed and ArmedBus(armed["bus"])
        if target:
            holder = target.lock.holder()
            if holder and holder.get("run") == str(run.resolve()):
                target.ask()
                return _stop_units(target, None)
    raise Fault(f"{NOTHING}: no session of this computer moves {run.name}")


def _targets(path: pathlib.Path, given: bool) -> tuple[list[ArmedBus], str]:
    """The buses to stop, and what is wrong with the file."""
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
        return [ArmedBus(data["bus"])], ""
    except (OSError, ValueError, KeyError, TypeError) as error:
        fault = f"{path} names no bus: {' '.join(str(error).split())}"
        if isinstance(error, FileNotFoundError):
            fault = f"there is no {path}" + " here" * (not given)
    every = [armed for file in armed_files() if (armed := read_armed(file))]
    moving = [armed for armed in every if not armed["standing"]]
    return [ArmedBus(armed["bus"]) for armed in moving or every], fault


def _tell_others(stopped: list[pathlib.Path]) -> None:
    """Say which other devices sessions of this user have armed on this computer."""
    for path in armed_files():
        armed = read_armed(path)
        if path in stopped or armed is None or armed["standing"]:
            continue
        target = ArmedBus(armed["bus"])
        holder = target.lock.holder()
        device = f", {armed['device']}" if "device" in armed else ""
        _say(
            f"NOT stopped, another device: {target.lock.where}{device} is armed"
            + (f" and {held_by(holder)}" if holder else ", by a session that is gone")
            + ". `jaxcal-rig stop` in its folder stops it"
        )


def _say(text: str) -> None:
    """Print; a terminal that is gone, or lacks a letter, does not end a stop."""
    try:
        print(text, flush=True)
    except UnicodeError:
        _say(ascii(text))
    except OSError:
        sys.stdout = None  # nothing is left to be flushed at the end


def _stop_units(
    target: ArmedBus, path: pathlib.Path | None, stay: bool = False
) -> list[UnitStop]:
    """Stop the drives that were armed last, else those of the configuration file.

    Who was asked to is waited for first. ``stay``: look whether they stay, too.
    """
    from rig.core import stop
    from rig.drives import make_drives
    from rig.drives.line import BusError

    target.end()
    settings, silence_s, axes = _drives(target.armed, path)
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(target.lock.acquire("stop"))
        except (OSError, Refused):  # stop without the lock
            _say(f"{target.lock.where} is not free: its drives are stopped anyway")
        line, drives = make_drives(settings, axes, silence_s)
        try:
            line.open()
        except BusError as error:
            raise BusError(f"{NOTHING}: {error}", LAST_RESORT) from None
        with line:
            results = stop.stop_all(drives)
            named = ", ".join(f"{axis.name} (unit {axis.unit})" for axis in axes)
            _say(f"stopping {named} on {target.lock.where}")
            for text in stop.stay(drives, results, stop.stand_s(drives) * stay):
                _say(f"WARNING: {text}, and was stopped again")
        if all(result.standing for result in results):
            target.lock.stood()
        return results


def _drives(
    armed: dict[str, Any] | None, path: pathlib.Path | None
) -> tuple[Any, float, list[Any]]:
    """Bus, silence and axes: of what is armed, else of the file, else as armed last.

    Raises:
        Fault: neither can be read.
    """
    faults: list[str] = []
    moving = armed is not None and not armed["standing"]
    for source in (armed, path) if moving else (path, armed):
        if source is None:
            continue
        try:
            drives = _read(source)
        except Exception as error:  # left by another version; edited since
            lost = f"what was armed cannot be read ({type(error).__name__}: {error})"
            faults.append(str(error) if source is path else lost)
            continue
        if faults:
            which = f"of {path}" if source is path else "that were armed last"
            _say(f"{faults[0]}\nstopping the drives {which} instead")
        return drives
    raise Fault(f"{NOTHING}: {'; '.join(faults)}. {LAST_RESORT}")


def _read(source: dict[str, Any] | pathlib.Path) -> tuple[Any, float, list[Any]]:
    """Bus, silence and axes, of what a session left or of a configuration file."""
    from rig.config.axis import Axis
    from rig.config.config import load_config
    from rig.config.maps import parse_map
    from rig.config.settings import BusSettings

    if isinstance(source, pathlib.Path):
        config = load_config(source)
        return config.bus, config.silence_s, [*config.axes]
    axes = [
        Axis.unmoved(
            drive["name"],
            drive["unit"],
            parse_map(drive["map"], "map", pathlib.Path(drive.get("folder", ""))),
        )
        for drive in source["drives"]
    ]
    return BusSettings.model_validate(source["bus"]), source["silence_s"], axes
