"""What to visit and in which order. Runs between moves; nothing here moves anything."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from jaxcal.selection.fastest import Motion, fastest_tour, travel_times
from rig.attitude import Array
from rig.config.axis import Pulses
from rig.config.config import RigConfig

EXACT_LIMIT_S = 20.0  # for the proof that the choice is (or is not) the optimum
REPLAN_LIMIT_S = 5.0  # the same while the drives stand armed
MOST_IMPROVED = 200  # postures whose tour is searched; beyond, nearest neighbours


@dataclasses.dataclass(frozen=True)
class Choice:
    """The postures to measure, and how good they are."""

    indices: tuple[int, ...]
    log_det: float  # of the 12 x 12 information matrix, commands in degrees
    best_log_det: float  # of the best subset known
    proven: bool  # that best is the proven optimum
    method: str
    note: str = ""

    @property
    def efficiency(self) -> float:
        """D-efficiency ``(det S / det S*) ** (1/12)``."""
        return math.exp((self.log_det - self.best_log_det) / 12.0)

    def described(self) -> dict[str, Any]:
        """For the journal."""
        return dataclasses.asdict(self)


def _drawn(config: RigConfig, count: int, *seed: int) -> Array:
    """(count, 3) int pulses, uniform in the ranges; only whole ones can be sent."""
    low, high = np.array(config.ranges).T
    angles = np.random.default_rng(seed).uniform(low, high, size=(count, 3))
    return np.array([config.to_pulses(angle) for angle in angles])


def draw_candidates(config: RigConfig) -> Array:
    """(M, 3) int pulses from which the postures are chosen."""
    return _drawn(config, config.session.candidates, config.session.seed)


def draw_collection(config: RigConfig, count: int) -> Array:
    """(count, 3) int pulses of a recording."""
    return _drawn(config, count, config.session.seed, 2)


def choose(
    config: RigConfig,
    candidates_deg: Array,
    available: Array | None = None,
    required: tuple[int, ...] = (),
    replanning: bool = False,
) -> Choice:
    """The K postures to measure.

    Args:
        config: names K, the method and the efficiency under which exact replaces it.
        candidates_deg: (M, 3).
        available: (M,) False where a posture cannot be reached.
        required: indices measured already, which stay in the choice.
        replanning: the drives stand armed: the exact solver alone, and less time.

    Raises:
        ValueError: no K postures are left, or they lie in one plane.
    """
    import jaxcal

    session = config.session
    given: dict[str, Any] = {"seed": session.seed}
    if available is not None:
        given["available"] = available
    if required:
        given["required"] = list(required)
    limit = REPLAN_LIMIT_S if replanning else EXACT_LIMIT_S
    exact = jaxcal.select(
        candidates_deg, session.k, method="exact", time_limit=limit, **given
    )

    def rated(selection: Any, note: str) -> Choice:
        log_det = float(selection.log_det)
        return Choice(
            indices=tuple(int(i) for i in selection.indices),
            log_det=log_det,
            best_log_det=max(float(exact.log_det), log_det),
            proven=bool(exact.proven),
            method=str(selection.method),
            note=note,
        )

    if session.method == "exact" or replanning:
        return rated(exact, "")
    if session.method == "greedy":
        del given["seed"]  # greedy draws nothing
    if session.method == "auto":
        given |= {"least_efficiency": session.min_efficiency, "time_limit": limit}
    try:
        chosen = jaxcal.select(
            candidates_deg, session.k, method=session.method, **given
        )
    except Exception as error:
        if session.method not in ("policy", "auto"):
            raise
        # A missing or foreign checkpoint must not keep a rig from being calibrated.
        reason = " ".join(str(error).split())[:200]
        return rated(
            exact, f"no policy could be used ({reason}); exact is used instead"
        )
    choice = rated(chosen, getattr(chosen, "reason", ""))
    if choice.efficiency < session.min_efficiency:
        note = (
            f"{session.method} reached a D-efficiency of {choice.efficiency:.3f}, "
            f"under session.min_efficiency = {session.min_efficiency:g}; using exact"
        )
        return rated(exact, note)
    return choice


def travel_order(config: RigConfig, points_deg: Array, start_deg: Array) -> list[int]:
    """Order of visits of least travel time on an open path.

    The axes move at the same time, so the slowest of them sets the time.

    Args:
        config: speeds and accelerations of the axes.
        points_deg: (N, 3).
        start_deg: (3,) where the device stands.

    Returns:
        (N,) indices of ``points_deg``: optimal for N up to 12; above 200 each next one
        is the nearest.
    """
    if not len(points_deg):
        return []
    speed = tuple(axis.speed_deg_s for axis in config.axes)
    motion = Motion(speed, tuple(axis.accel_deg_s2 for axis in config.axes))
    if len(points_deg) <= MOST_IMPROVED:
        start = travel_times([start_deg], points_deg, motion)[0]
        times = travel_times(points_deg, points_deg, motion)
        return [int(i) for i in fastest_tour(times, start)[0]]
    order: list[int] = []
    here, left = start_deg, list(range(len(points_deg)))
    while left:
        times = travel_times([here], points_deg[left], motion)[0]
        order.append(left.pop(int(times.argmin())))
        here = points_deg[order[-1]]
    return order


def draw_held_out(
    config: RigConfig, calibration: Any, count: int
) -> list[tuple[Pulses, Pulses]]:
    """Held-out targets that can be sent both raw and compensated.

    Args:
        config: ranges and limits.
        calibration: gives ``command_for``.
        count: how many.

    Returns:
        Pairs of pulses: the target sent as it is, and the compensated command for it.
        Fewer than ``count`` where little of the range can be reached compensated.
    """
    rng = np.random.default_rng([config.session.seed, 1])
    low, high = np.array(config.ranges).T
    pairs: list[tuple[Pulses, Pulses]] = []
    for _ in range(200 * count):
        if len(pairs) == count:
            break
        raw = config.to_pulses(rng.uniform(low, high))
        command = calibration.command_for(config.to_deg(raw))
        if (command >= low).all() and (command <= high).all():
            pairs.append((raw, config.to_pulses(command)))
    return pairs
