"""The steps of commissioning, each a run or reads alone, and who is asked."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import functools
import os
import pathlib
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from jaxcal.files import write_text
from rig.command_run import Run, listen, run_safely
from rig.config import ConfigError, RigConfig, parse_config
from rig.config.schema import read_text
from rig.core import session
from rig.core.device import Check, Device, Posture, Reached
from rig.core.motion import move
from rig.core.proof import ALLOWED_DEG, slowed
from rig.core.record_check import check_drives
from rig.drives import Drive, make_drives
from rig.faults import EXIT_OK, EXIT_RECALIBRATE, Refused
from rig.journal.device import HOMED, IDENTIFIED, STATES, DeviceRecord
from rig.journal.lock import BusLock
from rig.journal.run_folder import Record, new_run_folder
from rig.parts import PLACES
from rig.prove.axis_check import Change
from rig.prove.axis_moves import check_axes
from rig.prove.home import can_home, home, identity, unlimited

MOST_JOG_DEG = 10.0  # in one step


class Operator:
    """Questions with a default; ``yes`` takes every default and confirms everything."""

    def __init__(
        self,
        yes: bool = False,
        say: Callable[[str], None] = print,
        read: Callable[[str], str] = input,
        option: str = "--yes",  # that confirms
    ) -> None:
        self.yes = yes
        self.say = say
        self._read = read
        self._option = option

    def ask(self, question: str, default: str = "") -> str:
        """An answer, or the default; Refused: no terminal and no --yes, or none."""
        if self.yes and not default:
            raise Refused(f"{question}: no default; pass it as an option")
        if self.yes:
            self.say(f"{question} [{default}]")
            return default
        return self._answer(f"{question} [{default}]: ") or default

    def _answer(self, prompt: str) -> str:
        if self._read is input and not sys.stdin.isatty():
            raise Refused(f"{prompt}no terminal: pass {self._option} to confirm")
        try:
            return self._read(prompt).strip()
        except EOFError:
            raise Refused(f"{prompt}no answer") from None

    def number(self, question: str, default: float, most: float = 1e9) -> float:
        """A number; asked again where the answer is none, or larger either way."""
        while True:
            answer = self.ask(question, f"{default:g}")
            with contextlib.suppress(ValueError):
                if abs(number := float(answer)) <= most:
                    return number
            self.say(f"  must be a number in [{-most:g}, {most:g}], got {answer!r}")

    def choose(self, question: str, known: list[str], default: str) -> str:
        """One of ``known``; asked again where the answer is none of them."""
        while (answer := self.ask(question, default)) not in known:
            self.say(f"  must be one of {', '.join(known)}, got {answer!r}")
        return answer

    def confirm(self, what: str, word: str) -> None:
        """Refused where the operator does not type the word: Enter moves nothing."""
        self.say(what)
        if self.yes:
            self.say(f"confirmed by --yes: {word}")
        elif self._answer(f"Type {word} to continue: ") != word:
            raise Refused(f"not confirmed ({word!r} was not typed); nothing was done")


@dataclasses.dataclass
class Site:
    """A device, its files, and who stands at it."""

    config: RigConfig  # with the addresses that are really used
    record: DeviceRecord
    operator: Operator
    path: pathlib.Path | None = None  # rig.toml, where there is one to correct
    full_speed: bool = False  # of a simulated device
    reset_alarms: bool = False
    listeners: tuple[Callable[[Record], None], ...] = ()

    def say(self, text: str) -> None:
        self.operator.say(text)

    def take(self, written: RigConfig) -> None:
        """A configuration that was edited, reached as the one before."""
        where = {name: getattr(self.config.source, name) for name in ("host", "port")}
        source = written.source.model_copy(update=where)
        which = "imu" if written.imu else "readings"
        update = {"bus": self.config.bus, which: source}
        self.config = written.model_copy(update=update)

    def command(self, words: str) -> str:
        """A command about this device, to be typed."""
        where = "" if self.path is None else f" --config {os.path.relpath(self.path)}"
        # A simulated device is gone with its command; another is made as rig.toml says.
        place = PLACES.get(words.split()[0])
        words = f"{place} {words}" if place else words
        return f"jaxcal-rig {words}{' --simulate' * self.full_speed}{where}"

    @contextlib.contextmanager
    def bus(self, what: str) -> Iterator[list[Drive]]:
        """The drives, to be read, under the lock of the bus."""
        config = self.config
        line, drives = make_drives(config.bus, config.axes, config.silence_s)
        with BusLock(config.bus).acquire(what), line:
            yield drives

    def run(
        self,
        name: str,
        procedure: Callable[[Run, Device], object],
        limits: bool = True,
        again: str = "",
    ) -> int:
        """Run a step that moves or writes; returns the exit code."""
        config, real = self.config, not self.full_speed
        axes = tuple(slowed(axis) if real else axis for axis in config.axes)
        # Every way to a place is straight, so that play is seen and not made a bias.
        motion = config.motion.model_copy(update={"approach_overshoot_deg": 0.0})
        config = config.model_copy(update={"axes": axes, "motion": motion})
        # Homed drives are where they were left; the gearing is still to be checked.
        check: Check = functools.partial(check_drives, geared=False)
        with BusLock(config.bus).acquire(name) as lock:
            run = Run(
                config if limits else unlimited(config),
                new_run_folder(pathlib.Path(config.output), name),
                name, self.say, record=self.record, reset_alarms=self.reset_alarms,
                start={"simulated": None, "inputs": {}, "maps_from": ""},
            )  # fmt: skip
            run.check = check if limits else lambda *_: None
            run.again, run.simulated = self.command(again or name), self.full_speed
            listen(run)
            run.listeners += self.listeners
            lock.tell(run=str(run.folder.resolve()))

            def whole(run: Run) -> int:
                with run.armed() as device:
                    procedure(run, device)
                return EXIT_OK

            return run_safely(run, whole)


def show_identity(site: Site) -> None:
    """The configured units answer as the configured families: IDENTIFIED."""
    with site.bus("scan") as drives:
        found = identity(drives)
    site.record.reach(IDENTIFIED, site.config, identity=found)
    each = [f"{axis.name} is unit {axis.unit}" for axis in site.config.axes]
    site.say(f"IDENTIFIED: {', '.join(each)}")


def go_home(site: Site, here: bool) -> int:
    """Make the counts mean a place: HOMED."""
    names = [axis.name for axis in site.config.axes]
    if not here and not can_home(site.config):
        without = {a.map.name for a in site.config.axes if not a.map.has("home")}
        raise Refused(
            f"the map {', '.join(sorted(without))} has no homing. Move the device into "
            "its home posture, then run `jaxcal-rig setup home --here`"
        )
    what = "nothing moves; the present position becomes the origin of the counts"
    if not here:
        what = f"the drives run their own homing one after another, {', '.join(names)},"
        what += " as far and as fast as they are set"
    what = f"keep out of the device's reach, hand on the emergency stop; {what}"
    site.operator.confirm(f"home: the drives are armed; {what}", "home")
    return site.run(
        "home", lambda run, dev: home(run, dev, site.config, here), limits=False,
        again="home" + " --here" * here,
    )  # fmt: skip


def number_of(config: RigConfig, name: str) -> int:
    """Number of an axis by its name; Refused where there is none."""
    if name not in config.axis_names:
        raise Refused(f"no axis {name!r}; there are {', '.join(config.axis_names)}")
    return config.axis_names.index(name)


def jog(site: Site, name: str, way_deg: float) -> int:
    """Move one axis by so many degrees, cut at its limits. Where its gearing is not
    proved it stops once the phone has turned so far."""
    axis = number_of(site.config, name)
    unit = site.config.axes[axis].unit_name
    homed = site.record.missing(site.config, HOMED) is None
    if not homed:
        site.say("the device is not HOMED: the soft limits are off")
    site.operator.confirm(f"jog: {name} will move by {way_deg:g} {unit}, slowly", "jog")

    def procedure(run: Run, device: Device) -> None:
        moved, here = run.config.axes[axis], list(device.positions())
        start, checked = here[axis], device.proof.reaches[axis].checked
        goal = min(max(moved.to_deg(start) + way_deg, moved.min_deg), moved.max_deg)
        here[axis] = moved.to_pulses(goal)
        base = device.attitude()
        device.proof.stay_near(base, max(ALLOWED_DEG, 2.0 * abs(way_deg)))

        def look() -> None:
            turned = device.geometry.apart(base, device.imu.latest().value)
            if turned > device.geometry.scale * abs(way_deg) and not checked:
                raise Reached(f"{turned:.1f}")

        device.meanwhile = look
        try:
            move(device, Posture("jog", tuple(here)))
        except Reached as turned:
            device.stopper.stop("moved far enough, as measured", latch=False)
            gone = abs(moved.to_deg(device.positions()[axis] - start))
            run.say(
                f"  stopped: {device.geometry.told} {turned} {device.geometry.unit} "
                f"after {gone:.2g} {unit} commanded. Check the reduction of {name}"
            )
        stands = moved.to_deg(device.positions()[axis])
        run.say(f"  {name} stands at {stands:.3f} {unit}")

    return site.run("jog", procedure, limits=homed, again=f"jog {name} {way_deg:g}")


def axes(site: Site) -> int:
    """Check each axis, correct rig.toml after a yes, and check again: SIGN_CHECKED."""
    site.operator.confirm(
        "axes: the device must be in its zero posture. Each axis in turn moves a "
        "little, then up to 3 deg either way; then all move by turns, up to 6 deg. See "
        "that the joint that moves is the one named; keep out of the device's reach",
        "axes",
    )
    return _check_axes(site)


def _check_axes(site: Site, again: bool = False) -> int:
    changes: list[Change] = []
    code = site.run("axes", lambda run, dev: changes.extend(check_axes(run, dev)))
    if code or not changes:
        return code
    site.say("rig.toml does not agree with the device:")
    for change in changes:
        site.say(f"  {change}")
    if again or site.path is None:
        advice = "correct rig.toml, then run `jaxcal-rig setup axes` again"
        site.say(f"the device is NOT SIGN_CHECKED: {advice}")
        return EXIT_RECALIBRATE
    what = f"write these values to {site.path}, then move the axes again"
    site.operator.confirm(f"axes: {what}", "correct")
    # What was proved of the drives goes with their cables.
    site.take(edit(site.path, {change.key: change.new for change in changes}))
    site.say(f"  written; the old file is next to {site.path}")
    homed = site.record.state(HOMED) or {}
    show_identity(site)
    # Which also forgets where each named axis was left: it is not what it was.
    site.record.reach(HOMED, site.config, **homed)
    return _check_axes(site, again=True)


def take_zero(site: Site) -> int:
    """Measure the zero posture: ZEROED."""
    what = "the device must be in its zero posture (jig, level), or moves to pulse 0 "
    what += 'with session.zero = "drive"; this posture is measured as zero'
    site.operator.confirm(f"zero: {what}", "zero")
    return site.run("zero", lambda run, device: session.take_zero(device))


def commissioned(path: pathlib.Path, config: RigConfig, through: str) -> DeviceRecord:
    """A new record of a simulated device, up to a state: nothing of it was moved."""
    record = DeviceRecord(path)
    for state in STATES[: STATES.index(through) + 1] if through else ():
        record.reach(state, config)
    return record


def edit(path: pathlib.Path, values: Mapping[str, Any]) -> RigConfig:
    """Set keys of a configuration such as ``axes.roll.unit``; None takes one out.
    Comments and layout stay, the old file lies beside it, the new one appears whole.
    ConfigError: it would not be valid, and the file is as it was."""
    text = read_text(path)
    edited = set_values(text, values)
    config = parse_config(edited, path.parent, str(path))
    if edited != text:
        stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S-%f")
        shutil.copy2(path, path.with_name(f"{path.name}.{stamp}.bak"))
        write_text(path, edited)
    return config


def set_values(text: str, values: Mapping[str, Any]) -> str:
    """A TOML text with other values; ``axes.NAME.KEY`` is the axis of that name."""
    import tomlkit

    document: Any = tomlkit.parse(text)
    for where, value in values.items():
        *path, key = where.split(".")
        table = document
        if path and path[0] == "axes":
            named = [axis for axis in document.get("axes", []) if axis["name"] in path]
            if not named:
                raise ConfigError("rig.toml", [f"{where}: no such axis"])
            table, path = named[0], []
        for part in path:
            table = table.setdefault(part, tomlkit.table())
        if value is None:
            table.pop(key, None)
        else:
            table[key] = value
    return tomlkit.dumps(document)
