"""What a calibration session says and writes for people: plan, result, pairs."""

from __future__ import annotations

from typing import Any

import numpy as np

from rig.attitude import Array
from rig.exits import EXIT_RECALIBRATE
from rig.planning import Choice, travel_order
from rig.session import Run
from rig.settings import AXIS_NAMES, RigConfig

__all__ = ["degrees_of", "describe_plan", "pairs_csv", "say_summary", "speeds"]


def speeds(config: RigConfig) -> Array:
    """(3,) degrees a second."""
    return np.array([axis.speed_deg_s for axis in config.axes])


def degrees_of(config: RigConfig, pulses: Array) -> Array:
    """(N, 3) degrees of (N, 3) pulses."""
    return np.array([config.to_deg(row) for row in pulses])


def describe_plan(run: Run, candidates: Array, choice: Choice) -> float:
    """Say what will be done; returns an estimate of its seconds."""
    config, say = run.config, run.say
    session, settle = config.session, config.settle
    degrees = degrees_of(config, candidates)
    rank = "proven optimum" if choice.proven else "best known"
    say(
        f"{session.k} of {session.candidates} candidates by {choice.method}: log det "
        f"{choice.log_det:.4f} (commands in degrees), {rank} "
        f"{choice.best_log_det:.4f}, gap {choice.best_log_det - choice.log_det:.4f}, "
        f"D-efficiency {choice.efficiency:.4f}"
    )
    if choice.note:
        say(f"  note: {choice.note}")
    start = config.to_deg(run.zero_pulses or (0, 0, 0))
    chosen = np.array(choice.indices)
    order = chosen[travel_order(degrees[chosen], start, speeds(config))]
    say("  order   candidate   degrees (pitch yaw roll)        pulses")
    here, travel, seconds = start, np.zeros(3), 0.0
    per_posture = settle.window_s + 0.02 * settle.samples + 0.1
    for number, index in enumerate(order, 1):
        angle = " ".join(f"{v:9.4f}" for v in degrees[index])
        say(f"  {number:>5}   {index:>9}   {angle}   {candidates[index].tolist()}")
        travel += np.abs(degrees[index] - here)
        seconds += float((np.abs(degrees[index] - here) / speeds(config)).max())
        seconds += per_posture
        here = degrees[index]
    extra = 2 * session.verify_postures + 2
    total = seconds + extra * (seconds / session.k)
    say(
        f"  travel pitch {travel[0]:.1f}, yaw {travel[1]:.1f}, roll {travel[2]:.1f} "
        f"deg; with {session.verify_postures} held-out postures, before and after, "
        f"about {total:.0f} s"
    )
    return total


def pairs_csv(run: Run) -> str:
    """Every posture measured: role, commands, measurements, scatter."""
    columns = ["name", "role"]
    for what in ("pulses", "u_deg", "y_deg", "std_deg"):
        columns += [f"{what}_{axis}" for axis in AXIS_NAMES]
    lines = [",".join([*columns, "samples"])]
    for r in run.postures().values():
        values = r["pulses"] + r["commanded_deg"] + r["measured_deg"] + r["std_deg"]
        fields = [r["name"], r.get("role", ""), *(repr(v) for v in values)]
        lines.append(",".join([*fields, str(r["samples"])]))
    return "\n".join(lines) + "\n"


def say_summary(run: Run, summary: dict[str, Any], code: int) -> None:
    """Print A and b with their intervals, the errors and any warning."""
    say = run.say
    say("y = A u + b in degrees, +- 95 % confidence for all twelve at once:")
    for row, name in enumerate(AXIS_NAMES):
        values = "  ".join(
            f"{summary['A'][row][column]:8.5f} +- {summary['ci95'][row][column]:.5f}"
            for column in range(3)
        )
        say(
            f"  {name:<5} [{values}]   "
            f"{summary['b'][row]:8.4f} +- {summary['ci95'][row][3]:.4f}"
        )
    say(f"  noise of one posture {summary['noise_std_deg'][0]:.4f} deg, from "
        f"{summary['basis']} ({summary['dof']} degrees of freedom)")  # fmt: skip
    if "before" in summary:
        before, after = summary["before"], summary["after"]
        say(
            f"held-out error before {before['rms']:.4f} deg rms (max "
            f"{before['max']:.4f}), after compensation {after['rms']:.4f} (max "
            f"{after['max']:.4f})"
        )
    if summary["drift_deg"] is not None:
        say(f"zero posture at the end: {summary['drift_deg']:.4f} deg from zero")
    if summary["orders"]["warning"]:
        say(f"WARNING: {summary['orders']['warning']}")
    if code == EXIT_RECALIBRATE:
        say(
            f"the error after compensation exceeds session.verify_limit_deg "
            f"({run.config.session.verify_limit_deg:g}): do not use this calibration "
            "before the cause is known"
        )
    say(f"saved: {run.folder}/calibration.json, pairs.csv, summary.json, report.html")
