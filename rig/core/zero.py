"""Whether the zero posture is where it was: its attitude against gravity, then and now.

The phone's world stands upright (its Z axis is the vertical), so a change of tilt is
seen whatever the phone calls north. Where it has a heading to be trusted
(``imu.heading = "absolute"``) turns about the vertical are seen too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rig.config import AXIS_NAMES, RigConfig
from rig.config.axis import Pulses
from rig.core.attitude import Array, angle_between_deg, frame_at
from rig.core.faults import MotionFault

UNSEEN_DEG = 15.0  # an axis this near to the vertical hardly changes the tilt
TOLD_SHARE = 0.2  # of the largest: an axis that moved less is left out of the words


class KeptZero(NamedTuple):
    """The zero posture as a calibration keeps it; None where it does not."""

    whose: str  # of messages
    pulses: Pulses | None = None
    attitude: Array | None = None  # (3, 3) phone to its world

    def check(self, config: RigConfig, pulses: Pulses, attitude: Array) -> str:
        """The zero posture taken now is this one; returns what was compared, in words.

        Raises:
            MotionFault: it is not, by more than ``session.reference_tolerance_deg``.
        """
        if self.pulses is not None:
            off = config.to_deg(np.subtract(pulses, self.pulses))
            if np.abs(off).max() > config.session.reference_tolerance_deg:
                raise MotionFault(
                    f"in its zero posture the device counts other pulses than for "
                    f"{self.whose}: {axes_text(off)}. The drives have lost their "
                    "origin, or this is not the zero posture"
                )
        if self.attitude is None:
            return f"{self.whose} keeps no attitude of its zero posture: not compared"
        return check_zero(config, self.attitude, attitude, self.whose)


def moved(config: RigConfig, then: Array, now: Array) -> tuple[float, Array]:
    """How far one attitude of the zero posture stands from another, (3, 3) each.

    Returns:
        The angle in degrees, and as (3,) joint angles. Without an absolute heading the
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
    base = zero @ frame_at(config, zero).mounting.T
    upright = np.abs(base[2, ["XYZ".index(letter) for letter in config.letters]])
    nearest = np.cos(np.radians(UNSEEN_DEG))
    pairs = zip(AXIS_NAMES, upright, strict=True)
    return [name for name, cosine in pairs if cosine > nearest]


def check_zero(config: RigConfig, then: Array, now: Array, whose: str) -> str:
    """The zero posture stands as it stood; returns what was compared, in words.

    Args:
        config: names tolerance, mounting and axes.
        then: (3, 3) attitude of the phone, as kept.
        now: (3, 3) the same posture, measured.
        whose: for the words.

    Raises:
        MotionFault: they differ by more than ``session.reference_tolerance_deg``.
    """
    limit = config.session.reference_tolerance_deg
    angle, joints = moved(config, then, now)
    blind = unseen(config, then)
    but = f"; {', '.join(blind)} turns about the vertical and is not seen" * bool(blind)
    if angle <= limit:
        return f"zero posture stands {angle:.3f} deg from that of {whose}{but}"
    raise MotionFault(
        f"the zero posture is not that of {whose}: {axes_text(joints)} (limit "
        f"session.reference_tolerance_deg = {limit:g}){but}. Drives that were without "
        "power have lost their origin: home them. Where the phone or the base was "
        "moved, calibrate again"
    )


def axes_text(joints: Array) -> str:
    """(3,) degrees in words, of the axes that moved most."""
    size = np.abs(joints)
    order = [i for i in np.argsort(-size) if size[i] >= TOLD_SHARE * size.max()]
    return ", ".join(
        f"{AXIS_NAMES[i]} stands {joints[i]:+.2f} deg away from where it stood"
        for i in order
    )
