"""The command ``stop``: ask who moves the device, end them, stop every drive itself.

A holder of the bus that has not told its drives to stop ASK_S after it was asked is
killed. Then each drive is stopped and looked at, by what a session left beside the lock
and what ``stop_config`` can read of the file; each makes up for what the other lacks.
No signal ends this before, and only the standard library and pyserial are loaded.
"""

from __future__ import annotations

import contextlib
import os
import pathlib
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import TYPE_CHECKING, Any

from rig.drives import make_drives
from rig.drives.line import BusError
from rig.faults import EXIT_FAULT, EXIT_OK, Fault, Refused, Signals, told
from rig.journal.lock import BusLock, armed_files, held_by, read_armed
from rig.stop_config import FILE, StopConfig, found, read_file
from rig.stop_config import read_armed as config_of

if TYPE_CHECKING:
    from rig.core.stop import UnitStop

ASK_S = 0.5  # for the holder to have told its drives
END_S = 2.0  # more for one that has, to write its last lines and end
KILLED_S = 0.5  # for the kernel to end a process that was killed
REOPEN_S = 12.0  # until a gateway of one connection gives the next
AGAIN_S = 0.5  # between two tries of that
NOTHING = "NOTHING WAS STOPPED BY THIS COMMAND"
LAST_RESORT = "Use the emergency stop"


def main(words: Sequence[str]) -> int:
    """The command as it is typed: the first of its words that is a file or a folder is
    the configuration; words that it does not know do not keep it."""
    paths = []
    for word in words:
        if word[:1] == "-":
            option, _, word = word.partition("=")
            if not "config".startswith(option.lstrip("-").lower() or "?"):
                _say(f"{option}: not an option of stop, ignored")
        paths += [pathlib.Path(word)] * bool(word)
    existing = [path for path in paths if os.path.exists(found(path))]
    path = (existing or paths or [FILE])[0]
    for other in {*paths} - {path}:
        _say(f"{other}: ignored, the configuration is {path}")
    try:
        return stop_device(path, bool(paths))
    except Exception as error:  # whatever it is, the exit code says that drives move
        with contextlib.suppress(OSError, UnicodeError):
            print(f"jaxcal-rig: {told(error)}", file=sys.stderr)
        return EXIT_FAULT


class ArmedBus:
    """One bus: its lock, and what of it was armed last."""

    def __init__(self, bus: Any, file: StopConfig | None = None) -> None:
        self.bus, self.file = bus, file
        self.lock = BusLock(bus)
        self.armed = read_armed(self.lock.armed_path)
        self.since = time.monotonic()
        self.holder: dict[str, Any] | None = None

    @property
    def moves(self) -> bool:
        """A session armed it, and has not said that all stands."""
        return self.armed is not None and not self.armed["standing"]

    @property
    def folder(self) -> pathlib.Path:
        """The folder of the device's record, which is that of its rig.toml."""
        return pathlib.Path(str((self.armed or {}).get("device"))).parent

    def ask(self) -> None:
        with _helping(f"cannot find out who uses {self.lock.where}"):
            self.holder = self.lock.signal_holder(signal.SIGTERM)
            if self.holder is not None:
                _say(f"{self.lock.where} is {held_by(self.holder)}; asking it to stop")

    def end(self) -> None:
        """Wait for the holder; kill one that has not stopped its drives in time."""
        freed = self.lock.freed(ASK_S - (time.monotonic() - self.since))
        if not freed and self._stand:
            freed = self._stayed()
        if not freed:
            _say("it has not stopped its drives in time; killing it")
            with contextlib.suppress(OSError, Refused):
                self.lock.signal_holder(signal.SIGKILL)
            if not self.lock.freed(KILLED_S) and not (self._stand and self._stayed()):
                _say("it still uses the bus")
        reported = "reported that all" if self._stand else "did not report that"
        if read_armed(self.lock.armed_path):
            _say(f"it {reported} its drives are at rest")
        else:
            _say("it left no word of drives that it armed")

    def _stayed(self) -> bool:
        """Wait while it looks whether its drives stay; whether it let go."""
        stand_s = (read_armed(self.lock.armed_path) or {}).get("stand_s", 0.0)
        return self.lock.freed(END_S + stand_s)

    @property
    def _stand(self) -> bool:
        """Whatever the holder armed, it has seen standing since."""
        armed = read_armed(self.lock.armed_path)
        return armed is None or armed["standing"]


def stop_device(path: pathlib.Path, given: bool = True) -> int:
    """Stop what is armed on the bus of rig.toml, else all that sessions of this user
    have armed; 0 if all drives stand. ``given``: an operator named the file. Fault: no
    drive was told to stop."""
    with Signals() as signals:
        signals.armed = True  # it takes seconds at most: a signal does not cut it short
        targets = _targets(path, given)
        for target in targets:
            target.ask()
        results: list[UnitStop] = []
        faults: list[Exception] = []
        with ThreadPoolExecutor(len(targets)) as pool:
            jobs = {pool.submit(stop_units, target, True): target for target in targets}
            reached: list[pathlib.Path] = []
            for job in as_completed(jobs):
                try:
                    results += job.result()
                    reached.append(jobs[job].lock.armed_path)
                    _say("\n".join(map(str, job.result())))
                except Exception as error:  # of one bus: another is stopped
                    faults.append(error)
        with _helping("cannot look at other devices"):
            _tell_others(reached, [target.lock.armed_path for target in targets])
        if len(faults) == len(jobs):
            raise faults[0]
        for fault in faults:
            _say(told(fault))
        good = all(unit.acknowledged and unit.standing for unit in results)
        return EXIT_OK if good and not faults else EXIT_FAULT


def _targets(path: pathlib.Path, given: bool) -> list[ArmedBus]:
    """The buses to stop; what is wrong with the file is said. Fault: there are none."""
    target, lack = _of_file(path)
    if target is None and given and (target := _of_file(FILE)[0]):
        _say(f"{lack}: stopping what {FILE} names")
    targets = [target] if target else []
    every: list[ArmedBus] = []
    with _helping("cannot look at what was armed"):
        every += filter(None, (armed_bus(read_armed(file)) for file in armed_files()))
    paths = [target.lock.path for target in targets]
    more = [bus for bus in every if bus.moves and bus.lock.path not in paths]
    if not lack:  # a session began here, and the file has got another bus since
        more = [bus for bus in more if bus.folder == path.parent.resolve()]
        for bus in more:
            _say(f"{bus.lock.where} was armed from this folder: stopping it as well")
        return targets + more
    if not (targets or more or every):
        raise Fault(
            f"{NOTHING}: {lack}, and no session of this user has armed a device. "
            f"{LAST_RESORT}"
        )
    if not targets or more:
        _say(f"{lack}: stopping everything that sessions of this user have armed")
    return targets + more or every


def _of_file(path: pathlib.Path) -> tuple[ArmedBus | None, str]:
    """The bus of a file, and what it lacks; what else is wrong with it is said."""
    try:
        path = found(path)
        config = read_file(path)
        for fault in config.faults:
            _say(f"{path}: {fault}")
        if config.bus:
            return ArmedBus(config.bus, config), "; ".join(config.bus_faults)
    except Exception as error:  # whatever is wrong, drives are stopped
        reason = getattr(error, "strerror", None) or error
        return None, f"{path} cannot be read: {reason}"
    return None, f"{path} names no bus"


def armed_bus(armed: dict[str, Any] | None) -> ArmedBus | None:
    """The bus of what a session left; None where that says nothing of use."""
    with _helping("what a session armed cannot be used"):
        bus = armed and config_of(armed).bus
        return ArmedBus(bus) if bus else None
    return None


def _tell_others(
    stopped: list[pathlib.Path], tried: Sequence[pathlib.Path] = ()
) -> None:
    """Say which other devices sessions of this user have armed on this computer."""
    for path in armed_files():
        armed = read_armed(path)
        if path in stopped or armed is None or armed["standing"]:
            continue
        if not (target := armed_bus(armed)):
            continue
        holder = target.lock.holder()
        device = f", {armed['device']}" if "device" in armed else ""
        _say(
            f"NOT stopped, another device: {target.lock.where}{device} is armed"
            + (f" and {held_by(holder)}" if holder else ", by a session that ended")
            + ". `jaxcal-rig stop` in its folder stops it" * (path not in tried)
        )


@contextlib.contextmanager
def _helping(text: str) -> Iterator[None]:
    """Report a fault of locks or records and go on: no stop depends on them."""
    try:
        yield
    except Exception as error:
        _say(f"{text}: {type(error).__name__}: {error}")


def _say(text: str) -> None:
    """Print; a terminal that is gone, or lacks a letter, does not end a stop."""
    try:
        print(text, flush=True)
    except UnicodeError:
        _say(ascii(text))
    except OSError:
        sys.stdout = None  # nothing is left to be flushed at the end


def stop_units(target: ArmedBus, stay: bool = False) -> list[UnitStop]:
    """Stop the drives that are armed and those of the configuration file, once who was
    asked to has been waited for. ``stay``: look whether they stay, too."""
    from rig.core import stop

    if target.holder is not None:
        with _helping("cannot wait for who uses it"):
            target.end()
    bus, silence_s, axes, lost = _drives(target)
    with contextlib.ExitStack() as stack:
        with _helping("stopping its drives without the lock"):
            stack.enter_context(target.lock.acquire("stop"))
        line, drives = make_drives(bus, axes, silence_s)
        stack.callback(line.close)
        named = ", ".join(f"{axis.name} (unit {axis.unit})" for axis in axes)
        _say(f"stopping {named} on {target.lock.where}")
        again = target.holder is not None or target.moves or bus.host
        end = time.monotonic() + REOPEN_S * bool(again)
        while True:
            try:
                line.open()
                results = stop.stop_all(drives)
                if all(unit.unsent for unit in results):
                    raise BusError(results[0].detail)
                reached = any(unit.acknowledged or unit.standing for unit in results)
                if reached or time.monotonic() > end:
                    break
                _say("\n".join(map(str, results)))
            except BusError as error:
                if time.monotonic() > end:
                    raise BusError(f"{NOTHING}: {error}", LAST_RESORT) from None
                _say(f"{error}. {LAST_RESORT}")
            _say("the connection may not be free yet; trying again")
            time.sleep(AGAIN_S)
        for text in stop.stay(drives, results, stop.stand_s(drives) * stay):
            _say(f"WARNING: {text}, and was stopped again")
        if all(result.standing for result in results) and not lost:
            target.lock.stood()
        return results + lost


def _drives(target: ArmedBus) -> tuple[Any, float, list[Any], list[UnitStop]]:
    """Bus, silence, axes that can be stopped (Fault: none can), and those that cannot:
    of what is armed and of the file, else of the file, which the last record helps."""
    from rig.core.stop import UnitStop

    armed = config_of(target.armed) if target.armed else None
    if armed and armed.faults:
        _say(f"what was armed cannot be read in full: {'; '.join(armed.faults)}")
    order = (armed, target.file) if target.moves else (target.file, armed)
    sources = [source for source in order if source is not None]
    buses = [source.bus for source in sources if source.bus and not source.bus_faults]
    bus: Any = buses[0] if buses else target.bus
    axes: list[Any] = []
    lost: dict[str, UnitStop] = {}
    for source in sources:
        names, units = [axis.name for axis in axes], [axis.unit for axis in axes]
        first = not axes
        axis: Any
        for axis in source.axes:
            if not (first or target.moves or axis.name in lost):
                continue
            lost.pop(axis.name, None)
            try:
                if axis.unit not in units:
                    make_drives(bus, [axis])
                    axes.append(axis)
            except Refused as error:
                lost[axis.name] = UnitStop(axis.name, axis.unit, detail=str(error))
        for name, unit in source.lost if first or target.moves else ():
            if name not in names and unit not in units:
                text = "the way to stop it cannot be read"
                lost[name] = UnitStop(name, unit, detail=text)
    if not axes:
        faults = [fault for source in sources for fault in source.faults]
        reason = "; ".join(faults) or "neither the file nor a session names an axis"
        raise Fault(f"{NOTHING}: {reason}. {LAST_RESORT}")
    silence_s = max(source.silence_s for source in sources)
    return bus, silence_s, axes, [*lost.values()]
