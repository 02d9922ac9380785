"""What a session prints, as lines of text."""

from __future__ import annotations

from typing import Any

import numpy as np

from rig.attitude import Array
from rig.config import AXIS_NAMES, RigConfig
from rig.guard.stop import UnitStop


def numbers(values: Any, width: int = 9, digits: int = 4) -> str:
    """Numbers side by side."""
    return " ".join(f"{value:{width}.{digits}f}" for value in values)


def event_lines(record: dict[str, Any]) -> list[str]:
    """What an event of the run comes to on the console; most are silent."""
    match record["event"]:
        case "zero":
            return [f"zero taken at pulses {record['pulses']}"]
        case "void":
            return [f"  withdrawn, to be measured again: {', '.join(record['names'])}"]
        case "lost_reply":
            found = {
                "obeyed": "the drive obeys",
                "not taken": "the drive did not take it, so it is sent again",
                "unknown": "whether the drive took it is unknown, so all stop",
            }[record["outcome"]]
            return [f"  the reply to a move of {record['axis']} was lost: {found}"]
        case "unreachable":
            return [f"  {record['name']} is out of reach: {record['reason']}"]
        case "stop":
            units = [f"  {UnitStop(**unit)}" for unit in record["units"]]
            return [f"stop: {record['reason'] or 'end of run'}", *units]
    return []


def plan_lines(
    config: RigConfig, choice: Any, pulses: Array, start_deg: Array
) -> list[str]:
    """What will be done: a choice, in the order of visits, of (M, 3) ``pulses``."""
    session, settle = config.session, config.settle
    text = choice_text(vars(choice))
    lines = [f"{session.k} of {session.candidates} candidates by {text}"]
    if choice.note:
        lines.append(f"  note: {choice.note}")
    lines.append("  order   candidate   degrees (pitch yaw roll)        pulses")
    visited = pulses[list(choice.indices)]
    degrees = config.to_deg(visited)
    for number, index in enumerate(choice.indices):
        angles, sent = numbers(degrees[number]), visited[number].tolist()
        lines.append(f"  {number + 1:>5}   {index:>9}   {angles}   {sent}")
    ways = np.abs(np.diff(np.vstack([start_deg, degrees]), axis=0))
    speeds = np.array([axis.speed_deg_s for axis in config.axes])
    seconds = (ways / speeds).max(axis=1).sum() / session.k
    seconds += settle.window_s + 0.02 * settle.samples + 0.1
    total = seconds * (session.k + 2 * session.verify_postures + 2)
    pitch, yaw, roll = ways.sum(axis=0)
    lines.append(
        f"  travel pitch {pitch:.1f}, yaw {yaw:.1f}, roll {roll:.1f} deg; with "
        f"{session.verify_postures} held-out postures, before and after, about "
        f"{total:.0f} s"
    )
    return lines


def summary_lines(summary: dict[str, Any], limit_deg: float) -> list[str]:
    """A and b with their intervals, the errors and any warning."""
    lines = ["y = A u + b in degrees, +- 95 % confidence for all twelve at once:"]
    for row, name in enumerate(AXIS_NAMES):
        a, b, wide = summary["A"][row], summary["b"][row], summary["ci95"][row]
        values = "  ".join(f"{a[i]:8.5f} +- {wide[i]:.5f}" for i in range(3))
        lines.append(f"  {name:<5} [{values}]   {b:8.4f} +- {wide[3]:.4f}")
    lines.append(f"  {noise_text(summary)}")
    if "before" in summary:
        lines.append(f"held-out {error_text(summary)}")
    if summary["drift_deg"] is not None:
        lines.append(
            f"zero posture at the end: {summary['drift_deg']:.4f} deg from zero"
        )
    if summary["orders"]["warning"]:
        lines.append(f"WARNING: {summary['orders']['warning']}")
    if "after" in summary and summary["after"]["max"] > limit_deg:
        lines.append(
            "RECALIBRATE: the error after compensation exceeds "
            f"session.verify_limit_deg ({limit_deg:g}). Do not use this calibration "
            "before the cause is known"
        )
    return lines


def noise_text(summary: dict[str, Any]) -> str:
    """Where the noise was taken from, and its size."""
    return (
        f"noise of one posture {summary['noise_std_deg'][0]:.4f} deg, from "
        f"{summary['basis']} ({summary['dof']} degrees of freedom)"
    )


def choice_text(choice: dict[str, Any]) -> str:
    """How the postures were chosen, and how good they are."""
    rank = "proven optimum" if choice["proven"] else "best known"
    gap = choice["best_log_det"] - choice["log_det"]
    return (
        f"{choice['method']}: log det {choice['log_det']:.4f} (commands in degrees), "
        f"{rank} {choice['best_log_det']:.4f}, gap {gap:.4f}, D-efficiency "
        f"{np.exp(-gap / 12.0):.4f}"
    )


def error_text(found: dict[str, Any]) -> str:
    """Errors at held-out postures, raw and compensated."""
    before, after = found["before"], found["after"]
    return (
        f"error before {before['rms']:.4f} deg rms (max {before['max']:.4f}), after "
        f"compensation {after['rms']:.4f} (max {after['max']:.4f})"
    )
