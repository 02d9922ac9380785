"""How far the phone's zero drifted during a session, and measurements without it.

The zero posture is visited first, in the middle and last. A heading that drifts turns
the phone's world, so a linear drift is taken out of the attitudes, never of angles:
``R' = exp(-w t) R`` with w (3,) in that world. Three visits tell a linear drift from
any other; what no line explains cannot be taken out and is judged against the limit.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from rig.core.attitude import Array, Frame
from rig.journal import Record
from rig.workbench.identification.noise import mean_variance

SIGNIFICANT = 3.0  # standard deviations
LEAST = 0.1  # of the limit: less is left alone
STRAIGHT = 0.25  # of the drift: a deviation from the line up to this is still linear


@dataclasses.dataclass(frozen=True)
class Drift:
    """What the visits of the zero posture say."""

    minutes: list[float]  # (V,) of the visits, from the first on
    angles_deg: list[list[float]]  # (V, 3) read there; the first is zero by definition
    size_deg: float  # largest of them
    bend_deg: float | None  # largest deviation of the middle from a line; of three
    rate_deg_per_min: list[float]  # (3,)
    turn_deg_per_min: list[float]  # (3,) rotation vector in the phone's world
    corrected: bool  # linear, and taken out of the measurements
    left_deg: float  # what is in the measurements still
    limit_deg: float  # session.drift_limit_deg
    over: bool  # what is left is over the limit


def estimate_drift(visits: list[Record], phi: Array, limit_deg: float) -> Drift | None:
    """From the zero record and later visits of the zero posture, None without any.

    Args:
        visits: the zero, then postures measured there, in order of time.
        phi: (3,) correlation of readings, for the noise of a visit.
        limit_deg: ``session.drift_limit_deg``.
    """
    if len(visits) < 2:
        return None
    time = np.array([visit["time"] for visit in visits]) / 60.0
    time -= time[0]
    angles = np.array([np.zeros(3), *(v["measured_deg"] for v in visits[1:])])
    variance = np.array([mean_variance(visit, phi) for visit in visits])
    base = np.array(visits[0]["attitude"]).T
    turns = Rotation.from_matrix([np.array(v["attitude"]) @ base for v in visits])
    size, bend, corrected = float(np.abs(angles).max()), None, False
    if len(visits) == 3 and 0.0 < time[1] < time[2]:
        part = time[1] / time[2]
        weights = np.array([1.0 - part, -1.0, part])  # of a line they give 0
        off, end = np.abs(weights @ angles), np.abs(angles[2])
        bend = float(off.max())
        least = LEAST * limit_deg
        there = end > np.maximum(SIGNIFICANT * np.sqrt(variance[[0, 2]].sum(0)), least)
        noise = SIGNIFICANT * np.sqrt(weights**2 @ variance)
        straight = off <= np.maximum(np.maximum(noise, STRAIGHT * end.max()), least)
        corrected = bool(there.any() and straight.all())
    left = bend if corrected and bend is not None else size
    return Drift(
        minutes=time.round(4).tolist(),
        angles_deg=angles.tolist(),
        size_deg=size,
        bend_deg=bend,
        rate_deg_per_min=_slope(time, angles),
        turn_deg_per_min=_slope(time, turns.as_rotvec(degrees=True)),
        corrected=corrected,
        left_deg=left,
        limit_deg=limit_deg,
        over=left > limit_deg,
    )


def _slope(time: Array, values: Array) -> list[float]:
    away = time - time.mean()
    return (away @ values / max(away @ away, 1e-12)).tolist()


def without_drift(
    records: list[Record], drift: Drift | None, zero: Record, frame: Frame
) -> list[Record]:
    """The records as they would be without a drift that is linear; the same where
    it is not."""
    if drift is None or not drift.corrected:
        return records
    found = []
    for record in records:
        minutes = (record["time"] - zero["time"]) / 60.0
        back = -minutes * np.array(drift.turn_deg_per_min)
        turn = Rotation.from_rotvec(back, degrees=True).as_matrix()
        attitude = turn @ np.array(record["attitude"])
        measured = frame.angles(attitude)
        found.append(
            {**record, "attitude": attitude.tolist(), "measured_deg": measured.tolist()}
        )
    return found
