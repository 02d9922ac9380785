"""Whether it is the device of the record, and stands where it stood.

Before it is armed by its drives and their counts; then by the attitude of its zero
posture: by its tilt, and with ``imu.heading = "absolute"`` by its heading.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rig.config import RigConfig
from rig.config.axis import Pulses
from rig.config.config import differences
from rig.drives import Drive
from rig.drives.line import BusError
from rig.faults import MotionFault, Refused
from rig.journal.device import HOMED, IDENTIFIED, DeviceRecord
from rig.readings.geometry import Array, geometry_of

TOLD_SHARE = 0.2  # of the largest: an axis that moved less is left out of the words


def check_drives(
    config: RigConfig,
    drives: Sequence[Drive],
    record: DeviceRecord,
    geared: bool = True,
) -> None:
    """The drives are those of the record, where they were, and geared as configured;
    Refused where not, and what no longer holds of the record is voided."""
    for drive in drives if geared else ():
        axis, told = drive.axis, drive.pulses_per_rev()
        if told is not None and told != axis.pulses_per_rev:
            raise Refused(
                f"the drive of {axis.name} (unit {axis.unit}) is set to {told} pulses "
                f"per turn, but axes.{axis.name}.pulses_per_rev is "
                f"{axis.pulses_per_rev}. Correct the wrong one; nothing was moved"
            )
    for state, fault in ((IDENTIFIED, _exchanged), (HOMED, _displaced)):
        axes: dict[str, list[str]] = {}  # by what is wrong with them
        for drive in drives:
            axes.setdefault(fault(config, drive, record), []).append(drive.axis.name)
        axes.pop("", None)
        if axes:
            reasons = [f"{', '.join(names)}: {why}" for why, names in axes.items()]
            record.void(state, "; ".join(reasons))
        if lack := record.missing(config, state):
            raise Refused(lack)


def _exchanged(config: RigConfig, drive: Drive, record: DeviceRecord) -> str:
    evidence = record.state(IDENTIFIED) or {}
    known = evidence.get("identity", {}).get(drive.axis.name, {})
    found = drive.ids() if known else {}
    changed = differences(known, {key: found.get(key) for key in known})
    return f"another drive ({'; '.join(changed)})" if changed else ""


def _displaced(config: RigConfig, drive: Drive, record: DeviceRecord) -> str:
    """Why the drive's pulses may no longer mean the place that they meant."""
    axis, status = drive.axis, drive.steady()
    pulses, homed = record.left()
    left_at = pulses.get(axis.name, status.position)
    if axis.map.absolute_encoder:
        return ""
    if status.fault:
        return f"in alarm: {drive.alarm() or 'no code given'}"
    if axis.name in homed:
        if not drive.says_homed:
            return "the homed bit is cleared, so the drive was without power"
    elif left_at is None:
        return (
            "the last session ended without reading its position, and the drive does "
            "not report that it kept its power"
        )
    origins = (record.state(HOMED) or {}).get("origins", {})
    if drive.origin != origins.get(axis.name, drive.origin):
        return (
            f"its origin is {drive.origin}, but was {origins[axis.name]} when it was "
            "homed, so the drive was without power"
        )
    tolerance = axis.pulses_within(config.motion.position_tolerance_deg)
    if left_at is None or abs(status.position - left_at) <= tolerance:
        return ""
    return (
        f"it is at {status.position} pulses, "
        f"{abs(axis.to_deg(status.position - left_at)):.2f} deg from {left_at}, where "
        "it was left: the drive was without power, or another controller moved it"
    )


def leave(drives: Sequence[Drive], record: DeviceRecord) -> None:
    """Keep where the drives stand, as far as they say; an alarm takes their place.
    OSError: the record cannot be written."""
    positions: dict[str, int | None] = {}
    homed: list[str] = []
    for drive in drives:
        try:
            with drive.line.urgent():  # also after a stop, when nothing else is sent
                status = drive.steady(retries=0)
                alarm = drive.alarm() or "no code given" if status.fault else ""
        except BusError:
            positions[drive.axis.name] = None
            continue
        if alarm and not drive.axis.map.absolute_encoder:
            record.void(HOMED, f"{drive.axis.name} went into alarm: {alarm}")
        positions[drive.axis.name] = None if status.moving else status.position
        if drive.says_homed:
            homed.append(drive.axis.name)
    record.left_at(positions, homed)


# The zero posture


class ZeroRecord(NamedTuple):
    """The zero posture as a calibration keeps it."""

    whose: str  # of messages
    pulses: Pulses
    attitude: Array  # (3, 3) phone to its world

    def check(self, config: RigConfig, pulses: Pulses, attitude: Array) -> str:
        """The zero posture taken now is this one: what was compared, in words.
        MotionFault: it is not, by more than ``session.reference_tolerance_deg``."""
        off = config.to_deg(np.subtract(pulses, self.pulses))
        if np.abs(off).max() > config.session.reference_tolerance_deg:
            told = axes_text(config.axis_names, config.axis_unit, off)
            raise MotionFault(
                f"in its zero posture the device counts other pulses than {self.whose} "
                f"recorded: {told}. Either this is not the zero posture, or the drives "
                "have lost their origin: home them"
            )
        return check_zero(config, self.attitude, attitude, self.whose)


def moved(config: RigConfig, then: Array, now: Array) -> tuple[float, Array]:
    """How far two readings of the zero posture are apart, and (m,) of that; without a
    turn about the vertical, unless the heading is absolute."""
    geometry = geometry_of(config)
    now = geometry.aligned(then, now)
    return geometry.apart(then, now), geometry.frame(then).angles(now)


def check_zero(config: RigConfig, then: Array, now: Array, whose: str) -> str:
    """The zero posture stands as it stood: what was compared, in words. MotionFault:
    (3, 3) attitudes differ by more than ``session.reference_tolerance_deg``."""
    limit = config.session.reference_tolerance_deg
    angle, joints = moved(config, then, now)
    blind, unit = geometry_of(config).unseen(then), config.output_unit
    but = f"; not measurable: {', '.join(blind)}, about the vertical" * bool(blind)
    if angle <= limit:
        return f"zero posture is {angle:.3f} {unit} from that of {whose}{but}"
    told = axes_text(config.output_names, unit, joints)
    raise MotionFault(
        f"the zero posture is not that of {whose}: {told} (limit "
        f"session.reference_tolerance_deg = {limit:g}){but}. If drives were without "
        "power, they have lost their origin: home them. If the phone, sensor or base "
        "was moved, calibrate again"
    )


def axes_text(names: Sequence[str], unit: str, values: Sequence[float] | Array) -> str:
    """What moved most, in words, of values by their names."""
    least = TOLD_SHARE * np.abs(values).max()
    pairs = zip(names, values, strict=True)
    told = [f"{name} {value:+.2f}" for name, value in pairs if abs(value) >= least]
    return f"{', '.join(told)} {unit} from its place before"
