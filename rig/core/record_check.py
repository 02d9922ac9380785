"""Whether it is the device of the record, and stands where it stood.

Before it is armed: its drives, and their counts. Once it is measured: the attitude of
its zero posture against gravity, then and now. The phone's world stands upright (its Z
axis is the vertical), so a change of tilt is seen whatever the phone calls north. Where
it has a heading to be trusted (``imu.heading = "absolute"``) turns about the vertical
are seen too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rig.config import RigConfig
from rig.config.axis import Pulses
from rig.config.config import differences
from rig.core.attitude import Array, angle_between_deg, frame_at
from rig.core.bus import BusError
from rig.core.drive import Drive
from rig.core.faults import MotionFault, Refused
from rig.journal import HOMED, IDENTIFIED, DeviceRecord

UNSEEN_DEG = 15.0  # an axis this near to the vertical hardly changes the tilt
TOLD_SHARE = 0.2  # of the largest: an axis that moved less is left out of the words


def check_drives(
    config: RigConfig,
    drives: Sequence[Drive],
    record: DeviceRecord,
    geared: bool = True,
) -> None:
    """The drives are those of the record, where they were, and geared as configured.

    Raises:
        Refused: they are not. What no longer holds of the record is voided.
        BusError: a drive does not answer.
    """
    for drive in drives if geared else ():
        axis, told = drive.axis, drive.pulses_per_rev()
        if told is not None and told != axis.pulses_per_rev:
            raise Refused(
                f"the drive of {axis.name} (unit {axis.unit}) is set to {told} pulses "
                f"per turn, axes.{axis.name}.pulses_per_rev says {axis.pulses_per_rev}."
                " Correct the one that is wrong; nothing was moved"
            )
    for state, fault in ((IDENTIFIED, _exchanged), (HOMED, _displaced)):
        axes: dict[str, list[str]] = {}  # by what is wrong with them
        for drive in drives:
            axes.setdefault(fault(config, drive, record), []).append(drive.axis.name)
        axes.pop("", None)
        if axes:
            reasons = (
                f"{', '.join(names)}: {reason}" for reason, names in axes.items()
            )
            record.void(state, "; ".join(reasons))
        if lack := record.missing(config, state):
            raise Refused(lack)


def _exchanged(config: RigConfig, drive: Drive, record: DeviceRecord) -> str:
    """What of a drive's identity differs from the record's."""
    evidence = record.state(IDENTIFIED) or {}
    known = evidence.get("identity", {}).get(drive.axis.name, {})
    found = drive.identity() if known else {}
    changed = differences(known, {key: found.get(key) for key in known})
    return f"another drive ({'; '.join(changed)})" if changed else ""


def _displaced(config: RigConfig, drive: Drive, record: DeviceRecord) -> str:
    """Why the drive's pulses may no longer mean the place that they meant."""
    axis, status = drive.axis, drive.standing()
    pulses, homed = record.left()
    left = pulses.get(axis.name, status.position)
    if axis.map.absolute_encoder:
        return ""
    if status.fault:
        return f"in alarm: {drive.alarm() or 'no code given'}"
    if axis.name in homed:
        if not drive.says_homed:
            return "the homed bit is gone, so the drive was without power"
    elif left is None:
        return (
            "the last session ended without reading where it stands, and the drive "
            "does not say that it kept its power"
        )
    origins = (record.state(HOMED) or {}).get("origins", {})
    if drive.origin != origins.get(axis.name, drive.origin):
        return (
            f"its origin is {drive.origin} and was {origins[axis.name]} when it was "
            "homed, so the drive was without power"
        )
    tolerance = axis.pulses_within(config.motion.position_tolerance_deg)
    if left is None or abs(status.position - left) <= tolerance:
        return ""
    return (
        f"it stands at {status.position} pulses, "
        f"{abs(axis.to_deg(status.position - left)):.2f} deg from {left}, where it was "
        "left: the drive was without power, or another controller moved it"
    )


def leave(drives: Sequence[Drive], record: DeviceRecord) -> None:
    """Keep where the drives stand, as far as they say; an alarm takes their place.

    Raises:
        OSError: the record cannot be written.
    """
    positions: dict[str, int | None] = {}
    homed: list[str] = []
    for drive in drives:
        try:
            with drive.bus.urgent():  # also after a stop, when nothing else is sent
                status = drive.standing(retries=0)
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


class KeptZero(NamedTuple):
    """The zero posture as a calibration keeps it."""

    whose: str  # of messages
    pulses: Pulses
    attitude: Array  # (3, 3) phone to its world

    def check(self, config: RigConfig, pulses: Pulses, attitude: Array) -> str:
        """The zero posture taken now is this one; returns what was compared, in words.

        Raises:
            MotionFault: it is not, by more than ``session.reference_tolerance_deg``.
        """
        off = config.to_deg(np.subtract(pulses, self.pulses))
        if np.abs(off).max() > config.session.reference_tolerance_deg:
            raise MotionFault(
                "in its zero posture the device counts other pulses than for "
                f"{self.whose}: {axes_text(config, off)}. Either this is not the zero "
                "posture, or the drives have lost their origin: home them"
            )
        return check_zero(config, self.attitude, attitude, self.whose)


def moved(config: RigConfig, then: Array, now: Array) -> tuple[float, Array]:
    """How far one attitude of the zero posture stands from another, (3, 3) each.

    Returns:
        The angle in degrees, and as (n,) joint angles. Without an absolute heading the
        turn about the vertical that comes last is taken out of both.
    """
    now = heading_turn(config, then, now) @ now
    return angle_between_deg(then, now), frame_at(config, then).angles(now)


def heading_turn(config: RigConfig, then: Array, now: Array) -> Array:
    """(3, 3) turn about the vertical that takes ``now`` nearest to ``then``, both
    (3, 3); none where the heading can be trusted."""
    if config.imu.heading == "absolute":
        return np.eye(3)
    _, _, z, w = Rotation.from_matrix(now @ then.T).as_quat()
    return Rotation.from_quat([0.0, 0.0, -z, w] if z or w else [0, 0, 0, 1]).as_matrix()


def unseen(config: RigConfig, zero: Array) -> list[str]:
    """Names of the axes of which a turn at the zero posture cannot be seen."""
    if config.imu.heading == "absolute":
        return []
    upright = np.abs((zero @ frame_at(config, zero).mounting.T)[2])
    least = np.cos(np.radians(UNSEEN_DEG))
    pairs = zip(config.axis_names, config.letters, strict=True)
    return [name for name, letter in pairs if upright["XYZ".index(letter)] > least]


def check_zero(config: RigConfig, then: Array, now: Array, whose: str) -> str:
    """The zero posture stands as it stood; returns what was compared, in words.

    Args:
        config: names tolerance, mounting and axes.
        then, now: (3, 3) attitude of the phone, as kept and as measured.
        whose: for the words.

    Raises:
        MotionFault: they differ by more than ``session.reference_tolerance_deg``.
    """
    limit = config.session.reference_tolerance_deg
    angle, joints = moved(config, then, now)
    blind = unseen(config, then)
    but = f"; not seen: {', '.join(blind)}, about the vertical" * bool(blind)
    if angle <= limit:
        return f"zero posture stands {angle:.3f} deg from that of {whose}{but}"
    raise MotionFault(
        f"the zero posture is not that of {whose}: {axes_text(config, joints)} (limit "
        f"session.reference_tolerance_deg = {limit:g}){but}. Drives that were without "
        "power have lost their origin: home them. Where the phone or the base was "
        "moved, calibrate again"
    )


def axes_text(config: RigConfig, joints: Sequence[float] | Array) -> str:
    """(n,) degrees in words, of the axes that moved most."""
    least = TOLD_SHARE * np.abs(joints).max()
    pairs = zip(config.axis_names, joints, strict=True)
    told = [f"{name} {angle:+.2f}" for name, angle in pairs if abs(angle) >= least]
    return f"{', '.join(told)} deg from where it stood"
