"""Home and zero: what place the drives' counts and the phone's attitude mean."""

from __future__ import annotations

import time
from collections.abc import Callable

from rig.config import RigConfig
from rig.config.axis import HIGHEST, LOWEST
from rig.core.bus import BusError
from rig.core.drive import HOME, Drive
from rig.core.faults import MotionFault, Refused
from rig.core.record import HOMED, ZEROED
from rig.core.session import ZERO_FACTOR
from rig.workbench.commission.bench import Bench

HOME_S = 120.0  # for one axis on its own way home
SET_S, SET_TRIES = 1.0, 3  # until a drive counts from its new zero
ANSWER_S = 0.5  # until a drive that was sent home moves
POLL_S = 0.05


def unlimited(config: RigConfig) -> RigConfig:
    """The same without soft limits, for drives whose counts mean nothing yet."""
    axes = tuple(
        axis.model_copy(update={"min_pulses": LOWEST, "max_pulses": HIGHEST})
        for axis in config.axes
    )
    motion = config.motion.model_copy(update={"mirror_limits": False})
    return config.model_copy(update={"axes": axes, "motion": motion})


def can_home(config: RigConfig) -> bool:
    """Whether every drive has a homing of its own."""
    return all(axis.map.home is not None for axis in config.axes)


def home(run: Bench, here: bool, confirm: Callable[[str, str], None]) -> None:
    """Make the drives' counts mean a place; the device is HOMED.

    Args:
        run: with ``unlimited`` axes.
        here: where the device stands is home: each drive is told so, and its count is
            noted where it cannot be told. Otherwise each drive homes itself.
        confirm: is told what will happen and the word to type, and raises Refused where
            it must not.
    """
    names = [axis.name for axis in run.config.axes]
    if not here and not can_home(run.config):
        without = {a.map.name for a in run.config.axes if a.map.home is None}
        raise Refused(
            f"the map {', '.join(sorted(without))} knows no homing. Put the device "
            "into its home posture and use --here"
        )
    confirm(
        "home: nothing moves; where the device stands now becomes the origin of its "
        "counts"
        if here
        else "home: the drives run their own homing one after another, "
        f"{', '.join(names)}, as far and as fast as they are set to",
        "home",
    )
    device = run.arm()
    for drive in device.drives:
        if here:
            _set_zero(run, drive)
        else:
            _go_home(run, drive)
    positions = list(device.positions())
    how = "here" if here else "drive"
    run.emit("homed", sync=True, how=how, pulses=positions)
    origins = {drive.axis.name: drive.origin for drive in device.drives}
    run.record.reach(HOMED, run.plain, how=how, pulses=positions, origins=origins)
    run.say(f"home: the drives count {positions} pulses")


def _set_zero(run: Bench, drive: Drive) -> None:
    if drive.axis.map.set_zero is None:
        run.say(
            f"  {drive.axis.name}: the map {drive.axis.map.name} has no register for "
            f"it; home is at its count of {drive.status().position}"
        )
        return
    if drive.axis.map.home_place is not None:
        if _counts_from(run, drive, HOME) is None:
            return
        run.say(
            f"  {drive.axis.name}: the drive does not take the count {HOME}; it is set "
            "to 0, and a loss of power while it stands there is not noticed"
        )
    if (fault := _counts_from(run, drive, 0)) is not None:
        raise MotionFault(f"{fault}. Set it with the maker's tool")


def _counts_from(run: Bench, drive: Drive, origin: int) -> str | None:
    """Make where the drive stands its origin; why it is not, or None."""
    tolerance = drive.axis.pulses_within(run.config.motion.position_tolerance_deg)
    lost = ""
    for _ in range(SET_TRIES):  # the same once more where a frame was lost
        try:
            drive.write(drive.axis.map.set_zero, home=origin)
        except BusError as error:
            lost = f" ({error})"
        end = time.monotonic() + SET_S
        while True:
            drive.forget_origin()
            count = drive.sound().position + drive.origin
            if abs(count - origin) <= tolerance:
                return None
            run.device_guard()
            if time.monotonic() > end:
                break
            time.sleep(POLL_S)
    return (
        f"{drive.axis.name} still counts {count} pulses after its position was set to "
        f"{origin}{lost}"
    )


def _go_home(run: Bench, drive: Drive) -> None:
    axis = drive.axis
    run.say(f"  {axis.name} goes home")
    run.emit("command", label="home", axis=axis.name, pulses=None)
    begun = time.monotonic()
    end = begun + HOME_S
    drive.write(axis.map.home)
    while True:
        run.device_guard(moving=True)
        status = drive.sound()
        waited = time.monotonic() - begun
        done = axis.map.homed is None or drive.homed(status.word)
        if not status.moving and waited > ANSWER_S and done:
            break
        if time.monotonic() > end:
            raise MotionFault(
                f"{axis.name} is not home after {HOME_S:g} s. Check its home switch "
                "and the homing that is set in the drive"
            )
        time.sleep(POLL_S)
    drive.forget_origin()
    run.device_guard()


def zero(run: Bench, confirm: Callable[[str, str], None]) -> None:
    """Measure the attitude of the zero posture, where the device stands: ZEROED."""
    confirm(
        "zero: nothing moves; the device stands in its zero posture (jig, level), and "
        "the phone's attitude there is measured",
        "zero",
    )
    device = run.arm()
    target = device.positions()
    samples = ZERO_FACTOR * run.config.settle.samples
    measured = run.observer.measure(target, "zero", samples)
    run.emit("zero", sync=True, **measured)
    zero = {"pulses": list(target), "attitude": measured["attitude"]}
    run.record.reach(ZEROED, run.plain, **zero)


def identity(drives: list[Drive]) -> dict[str, dict[str, int | str]]:
    """Of each axis the identity registers of its drive that do not change.

    Signed registers are left out: they are measurements, such as a temperature.

    Raises:
        Refused: a unit does not answer as the family that is configured.
    """
    found: dict[str, dict[str, int | str]] = {}
    for drive in drives:
        axis = drive.axis
        try:
            values = drive.identity()
            drive.status()
        except BusError as error:
            raise Refused(
                f"{axis.name} (unit {axis.unit}) does not answer as {axis.map.name} "
                f"does: {error}. Run `jaxcal-rig scan`"
            ) from None
        for name, (low, high) in axis.map.recognise.items():
            value = values[name]
            if isinstance(value, int) and not low <= value <= high:
                raise Refused(
                    f"{axis.name} (unit {axis.unit}) is no {axis.map.name}: {name} is "
                    f"{value}, not in [{low}, {high}]. Run `jaxcal-rig scan`"
                )
        kinds = axis.map.identity
        found[axis.name] = {
            name: value
            for name, value in values.items()
            if kinds[name].type.startswith("u")
        }
    return found
