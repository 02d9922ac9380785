"""How far what is measured drifted in a session, and the records without that."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rig.journal.run_folder import Record
from rig.readings.geometry import Geometry

SIGNIFICANT = 3.0  # standard deviations, of a drift
LEAST = 0.1  # of session.drift_limit_deg: a smaller drift is left alone
STRAIGHT = 0.25  # of a drift: what a line leaves of it, and it is still linear


def estimate_drift(
    visits: list[Record], geometry: Geometry, limit_deg: float
) -> dict[str, Any] | None:
    """How far the phone's zero drifted; None where it was visited once.

    The zero posture is visited first, in the middle and last. A heading that drifts
    turns the phone's world, so a linear drift is taken out of the attitudes, never of
    angles: ``R' = exp(-w t) R`` with w (3,) in that world. Three visits tell a linear
    drift from any other, which cannot be taken out.

    Args:
        visits: the zero, then postures measured there, in order of time.
        geometry: of the readings.
        limit_deg: ``session.drift_limit_deg``.

    Returns:
        minutes (V,) and angles_deg (V, m) of the visits; size_deg, the largest angle;
        turn_deg_per_min (3,), w; corrected: it is linear and to be taken out; left_deg,
        what is in the measurements then; limit_deg, and whether left is over it.
    """
    zero = visits[0]
    if len(visits) < 2:
        return None
    minutes = np.array([visit["time"] - zero["time"] for visit in visits]) / 60.0
    later = [visit["measured_deg"] for visit in visits[1:]]
    angles = np.array([np.zeros(len(later[0])), *later])
    attitudes = np.array([visit["attitude"] for visit in visits])
    turn = geometry.drift(attitudes, minutes)
    rest = [without_drift(visit, turn, zero, geometry) for visit in visits[1:]]
    bend = np.abs([visit["measured_deg"] for visit in rest]).max(axis=0)
    noise = sum(np.square(v["std_deg"]) / v["samples"] for v in (zero, visits[-1]))
    least = np.maximum(SIGNIFICANT * np.sqrt(noise), LEAST * limit_deg)
    size, end = float(np.abs(angles).max()), np.abs(angles[-1])
    straight = bool((bend <= np.maximum(least, STRAIGHT * end.max())).all())
    corrected = len(visits) == 3 and straight and bool((end > least).any())
    remaining = float(bend.max()) if corrected else size
    return {
        "minutes": minutes.round(4).tolist(),
        "angles_deg": angles.tolist(),
        "size_deg": size,
        "turn_deg_per_min": turn.tolist(),
        "corrected": corrected,
        "left_deg": remaining,
        "limit_deg": limit_deg,
        "over": remaining > limit_deg,
    }


def without_drift(
    record: Record, turn: ArrayLike, zero: Record, geometry: Geometry
) -> Record:
    """A record without a drift: (3,) degrees a minute of the phone's world, or (m,)."""
    minutes = (record["time"] - zero["time"]) / 60.0
    attitude = geometry.without(np.array(record["attitude"]), turn, minutes)
    frame = geometry.frame(np.array(zero["attitude"]))
    measured = frame.angles(attitude).tolist()
    return {**record, "attitude": attitude.tolist(), "measured_deg": measured}
