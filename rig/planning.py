"""What to visit and in which order. Runs before arming; nothing here moves anything."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from jaxcal.selection.fastest import fastest_tour
from rig.attitude import Array
from rig.settings import RigConfig

__all__ = ["Choice", "choose", "draw_candidates", "draw_held_out", "travel_order"]


EXACT_LIMIT_S = 20.0  # for the proof that the choice is (or is not) the optimum
REPLAN_LIMIT_S = 5.0  # the same while the drives stand armed


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


def draw_candidates(config: RigConfig) -> Array:
    """(M, 3) int pulses, uniform in the ranges; whole pulses are what can be sent."""
    session = config.session
    rng = np.random.default_rng(session.seed)
    low, high = np.array(session.ranges).T
    angles = rng.uniform(low, high, size=(session.candidates, 3))
    return np.array([config.to_pulses(angle) for angle in angles])


def choose(
    config: RigConfig,
    candidates_deg: Array,
    available: Array | None = None,
    required: tuple[int, ...] = (),
    policy: bool = True,
) -> Choice:
    """The K postures to measure.

    Args:
        config: names K, the method and the efficiency under which exact replaces it.
        candidates_deg: (M, 3).
        available: (M,) False where a posture cannot be reached.
        required: indices measured already, which stay in the choice.
        policy: False keeps to the exact solver, which needs no JAX (used when postures
            are chosen anew while the drives are armed).

    Raises:
        ValueError: no K postures are left, or they lie in one plane.
    """
    import jaxcal

    session = config.session
    extra: dict[str, Any] = {"seed": session.seed}
    limit = EXACT_LIMIT_S if policy else REPLAN_LIMIT_S
    if available is not None:
        extra["available"] = available
    if required:
        extra["required"] = list(required)
    exact = jaxcal.select(
        candidates_deg, session.k, method="exact", time_limit=limit, **extra
    )
    best = float(exact.log_det)
    if session.method == "exact" or not policy:
        return _choice(exact, best, bool(exact.proven), "")
    if session.method == "greedy":
        extra.pop("seed")  # greedy draws nothing
    if session.method == "auto":
        extra |= {"least_efficiency": session.min_efficiency, "time_limit": limit}
    try:
        chosen = jaxcal.select(
            candidates_deg, session.k, method=session.method, **extra
        )
    except Exception as error:
        if session.method not in ("policy", "auto"):
            raise
        # A missing or foreign checkpoint must not keep a rig from being calibrated.
        reason = " ".join(str(error).split())
        note = f"no policy could be used ({reason[:200]}); exact takes its place"
        return _choice(exact, best, bool(exact.proven), note)
    reason = getattr(chosen, "reason", "")  # auto says why its answer is whose it is
    result = _choice(chosen, best, bool(exact.proven), reason)
    if result.efficiency < session.min_efficiency:
        note = (
            f"{session.method} reached a D-efficiency of {result.efficiency:.3f}, "
            f"under {session.min_efficiency:g}; exact takes its place"
        )
        return _choice(exact, best, bool(exact.proven), note)
    return result


def _choice(selection: Any, best: float, proven: bool, note: str) -> Choice:
    return Choice(
        indices=tuple(int(i) for i in selection.indices),
        log_det=float(selection.log_det),
        best_log_det=max(best, float(selection.log_det)),
        proven=proven,
        method=str(selection.method),
        note=note,
    )


def travel_order(points_deg: Array, start_deg: Array, speeds: Array) -> list[int]:
    """Order of least travel time on an open path.

    The axes move at the same time, so the time between two postures is that of the
    slowest axis. Optimal up to 12 postures; beyond, nearest neighbour and 2-opt.

    Args:
        points_deg: (N, 3).
        start_deg: (3,) where the device stands.
        speeds: (3,) degrees a second.

    Returns:
        Indices of ``points_deg`` in the order of their visit.
    """
    count = len(points_deg)
    if count == 0:
        return []
    points = np.vstack([start_deg, points_deg])
    times = (np.abs(points[:, None] - points[None, :]) / speeds).max(axis=-1)
    if count <= 12:
        order, _ = fastest_tour(times[1:, 1:], times[0, 1:])
        return [int(i) for i in order]
    path, left = [0], set(range(1, count + 1))
    while left:
        here = path[-1]
        nearest = min(left, key=lambda i: (times[here, i], i))
        path.append(nearest)
        left.remove(nearest)
    for _ in range(20 if count <= 200 else 0):
        improved = False
        for i in range(1, count):
            for j in range(i + 1, count + 1):
                before = times[path[i - 1], path[i]]
                after = times[path[i - 1], path[j]]
                if j < count:
                    before += times[path[j], path[j + 1]]
                    after += times[path[i], path[j + 1]]
                if after < before - 1e-12:
                    path[i : j + 1] = path[i : j + 1][::-1]
                    improved = True
        if not improved:
            break
    return [i - 1 for i in path[1:]]


def draw_held_out(
    config: RigConfig, calibration: Any, count: int
) -> list[tuple[tuple[int, int, int], tuple[int, int, int]]]:
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
    low, high = np.array(config.session.ranges).T
    pairs: list[tuple[tuple[int, int, int], tuple[int, int, int]]] = []
    for _ in range(200 * count):
        if len(pairs) == count:
            break
        raw = config.to_pulses(rng.uniform(low, high))
        desired = config.to_deg(raw)
        command = calibration.command_for(desired)
        if (command >= low).all() and (command <= high).all():
            pairs.append((raw, config.to_pulses(command)))
    return pairs
