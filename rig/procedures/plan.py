"""What to visit and in which order. Runs between moves; nothing here moves anything."""

from __future__ import annotations

import dataclasses
import math
import warnings
from typing import Any

import numpy as np

from jaxcal.designs.travel import Motion, fastest_tour, travel_times
from jaxcal.models.linear import Affine
from rig.config import RigConfig
from rig.config.axis import Pulses
from rig.outputs.messages import choice_text, numbers
from rig.parts import model_of
from rig.readings.geometry import Array

EXACT_LIMIT_S = 20.0  # for the proof that the choice is (or is not) the optimum
REPLAN_LIMIT_S = 5.0  # the same while the drives stand armed
MOST_IMPROVED = 200  # postures whose tour is searched


@dataclasses.dataclass(frozen=True)
class Choice:
    """The postures to measure, and how good they are."""

    indices: tuple[int, ...]
    log_det: float  # of the information matrix of [A | b], commands in degrees
    best_log_det: float  # of the best subset known
    efficiency: float  # D-efficiency (det S / det S*) ** (1 / parameters)
    proven: bool  # that best is the proven optimum
    method: str
    note: str = ""
    criterion: str = "D"


def draw(config: RigConfig, count: int, *seed: int) -> Array:
    """(count, n) int pulses, uniform in the ranges; only whole ones can be sent."""
    low, high = np.array(config.ranges).T
    rng = np.random.default_rng([config.session.seed, *seed])
    angles = rng.uniform(low, high, size=(count, len(low)))
    return np.array([config.to_pulses(angle) for angle in angles])


def choose(
    config: RigConfig,
    candidates_deg: Array,
    available: Array | None = None,
    required: tuple[int, ...] = (),
) -> Choice:
    """The K postures to measure of (M, n) candidates.

    ``available`` (M,) is False where a posture cannot be reached; the drives stand
    armed then: it is the exact solver alone, and less time. ``required``: indices
    measured already, which stay in the choice.
    """
    n, m, made = len(config.axes), len(config.output_names), model_of(config)
    given: dict[str, Any] = {"available": available, "required": list(required) or None}
    if made is not None:
        given |= {"model": made.model, "prior": made.prior}
    elif m != n:
        given["model"] = Affine(n, m)
    limit_s = EXACT_LIMIT_S if available is None else REPLAN_LIMIT_S

    def select(method: str) -> Any:
        import jaxcal

        options = given | {"method": method}
        if method != "greedy":  # which draws nothing
            options["seed"] = config.session.seed
        if method in ("auto", "exact"):
            options["time_limit"] = limit_s
        if method == "auto":
            options["least_efficiency"] = config.session.min_efficiency
        return jaxcal.select(candidates_deg, config.k, **options)

    if made is not None:  # what predicts best what any candidate measures
        chosen = best = select(config.session.method or "auto")
        efficiency, note = float(chosen.efficiency), str(chosen.reason)
    else:
        chosen = best = select("exact")
        note = ""
        if config.method != "exact" and available is None:
            try:
                chosen = select(config.method)
                note = str(chosen.reason)
            except Exception as error:
                if config.method not in ("policy", "auto"):
                    raise
                # A missing checkpoint must not keep a rig from being calibrated.
                reason = " ".join(str(error).split())[:200]
                note = f"no policy could be used ({reason}); exact is used instead"
        gap, least = best.log_det - chosen.log_det, config.session.min_efficiency
        efficiency = math.exp(-max(0.0, gap) / (m * (n + 1)))
        if efficiency < least:
            note = f"{config.method} reached a D-efficiency of {efficiency:.3f}, below "
            note += f"session.min_efficiency = {least:g}; using exact"
            chosen, efficiency = best, 1.0
    return Choice(
        indices=tuple(int(i) for i in chosen.indices),
        log_det=float(chosen.log_det),
        best_log_det=float(max(best.log_det, chosen.log_det)),
        efficiency=efficiency,
        proven=bool(best.proven),
        method=str(chosen.method),
        note=note,
        criterion=chosen.criterion,
    )


def plan_lines(config: RigConfig, choice: Choice, pulses: Array) -> list[str]:
    """What will be done: a choice, in the order of visits, of (M, n) ``pulses``."""
    session = config.session
    text = choice_text(vars(choice))
    lines = [f"{config.k} of {session.candidates} candidates by {text}"]
    if choice.note:
        lines.append(f"  note: {choice.note}")
    head = f"{config.axis_unit} ({' '.join(config.axis_names)})"
    lines.append(f"  order   candidate   {head:<{10 * len(config.axes)}}  pulses")
    visited = pulses[list(choice.indices)]
    degrees = config.to_deg(visited)
    for number, index in enumerate(choice.indices):
        angles, sent = numbers(degrees[number]), visited[number].tolist()
        lines.append(f"  {number + 1:>5}   {index:>9}   {angles}   {sent}")
    both = ", before and after" if config.model is None else ""
    lines.append(f"  with {session.verify_postures} held-out postures{both}")
    return lines


def travel_order(config: RigConfig, points_deg: Array, start_deg: Array) -> list[int]:
    """Order of visits of (N, n) points of least travel time from (n,), ending anywhere:
    optimal for N up to 12; above MOST_IMPROVED as they are given."""
    if not 0 < len(points_deg) <= MOST_IMPROVED:
        return [*range(len(points_deg))]
    speed = tuple(axis.speed_deg_s for axis in config.axes)
    motion = Motion(speed, tuple(axis.accel_deg_s2 for axis in config.axes))
    here = travel_times([start_deg], points_deg, motion)[0]
    times = travel_times(points_deg, points_deg, motion)
    return [int(i) for i in fastest_tour(times, here)[0]]


def draw_held_out(
    config: RigConfig, calibration: Any, count: int
) -> list[tuple[Pulses, ...]]:
    """Held-out targets in pulses, each as it is and as its compensated command.

    Fewer than ``count`` where little of the range can be reached compensated. By a
    ``[model]`` they are visited once; of other numbers than axes both are the same.
    """
    if config.model is not None:
        return [(tuple(pulses.tolist()),) for pulses in draw(config, count, 1)]
    low, high = np.array(config.ranges).T
    pairs: list[tuple[Pulses, ...]] = []
    for pulses in draw(config, 200 * count, 1):
        if len(pairs) == count:
            break
        command = config.to_deg(pulses)
        if len(config.output_names) == len(config.axes):
            with warnings.catch_warnings():  # what is far off is not visited: see below
                warnings.simplefilter("ignore", UserWarning)
                command = calibration.command_for(command)
        if ((command >= low) & (command <= high)).all():
            pairs.append((tuple(pulses.tolist()), config.to_pulses(command)))
    return pairs
