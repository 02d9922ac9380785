"""Before arming: the drives are those of the record, and stand where they were."""

from __future__ import annotations

from collections.abc import Sequence

from rig.config import RigConfig
from rig.core.bus import BusError
from rig.core.drive import Drive
from rig.core.faults import Refused
from rig.journal import HOMED, IDENTIFIED, DeviceRecord


def check_drives(
    config: RigConfig, drives: Sequence[Drive], record: DeviceRecord
) -> None:
    """The drives are those of the record, geared as configured, and where they were.

    Raises:
        Refused: they are not. What no longer holds of the record is voided.
        BusError: a drive does not answer.
    """
    for drive in drives:
        axis, told = drive.axis, drive.pulses_per_rev()
        if told is not None and told != axis.pulses_per_rev:
            raise Refused(
                f"the drive of {axis.name} (unit {axis.unit}) is set to {told} pulses "
                f"per turn, axes.{axis.name}.pulses_per_rev says {axis.pulses_per_rev}."
                " Correct the one that is wrong; nothing was moved"
            )
    check_record(config, drives, record)


def check_record(
    config: RigConfig, drives: Sequence[Drive], record: DeviceRecord
) -> None:
    """The drives are those of the record, and where they were; else Refused."""
    for state, faults in (
        (IDENTIFIED, [_exchanged(drive, record) for drive in drives]),
        (HOMED, [_displaced(config, drive, record) for drive in drives]),
    ):
        if reason := "; ".join(filter(None, faults)):
            record.void(state, reason)
        if record.missing(config, state):
            raise Refused(record.missing(config))


def _exchanged(drive: Drive, record: DeviceRecord) -> str:
    """What of a drive's identity differs from the record's."""
    name = drive.axis.name
    known = (record.state(IDENTIFIED) or {}).get("identity", {}).get(name, {})
    found = drive.identity() if known else {}
    return "; ".join(
        f"the drive of {name} is another one ({key}: {value} then, {found.get(key)} "
        "now)"
        for key, value in known.items()
        if found.get(key) != value
    )


def _displaced(config: RigConfig, drive: Drive, record: DeviceRecord) -> str:
    """Why the drive's pulses may no longer mean the place that they meant."""
    axis, status = drive.axis, drive.status()
    if axis.map.absolute_encoder:
        return ""
    if status.fault:
        return f"{axis.name} is in alarm: {drive.alarm() or 'no code given'}"
    if axis.name in record.left_homed():
        if not drive.says_homed:
            return f"the homed bit of {axis.name} is gone: the drive was without power"
    elif record.lost_sight(axis.name):
        return (
            f"where {axis.name} was left is not known, as the last session could not "
            "read it any more, and its drive does not say that it kept its power"
        )
    origins = (record.state(HOMED) or {}).get("origins", {})
    if drive.origin != origins.get(axis.name, drive.origin):
        return (
            f"{axis.name} counts from {drive.origin} and no more from "
            f"{origins[axis.name]}, where it was homed: it was without power"
        )
    left = record.left().get(axis.name, status.position)
    tolerance = axis.pulses_within(config.motion.position_tolerance_deg)
    if abs(status.position - left) <= tolerance:
        return ""
    return (
        f"{axis.name} stands at {status.position} pulses, "
        f"{abs(axis.to_deg(status.position - left)):.2f} deg from {left}, where it was "
        "left: it was without power, or another controller moved it"
    )


def leave(drives: Sequence[Drive], record: DeviceRecord) -> None:
    """Keep where the drives stand, as far as they say; an alarm takes their place.

    Raises:
        OSError: the record cannot be written.
    """
    positions: list[int | None] = []
    homed: list[str] = []
    for drive in drives:
        try:
            with drive.bus.urgent():  # also after a stop, when nothing else is sent
                status = drive.status(retries=0)
                alarm = drive.alarm() or "no code given" if status.fault else ""
        except BusError:
            positions.append(None)
            continue
        if alarm and not drive.axis.map.absolute_encoder:
            record.void(HOMED, f"{drive.axis.name} went into alarm: {alarm}")
        positions.append(None if status.moving else status.position)
        if drive.says_homed:
            homed.append(drive.axis.name)
    record.left_at(positions, homed)
