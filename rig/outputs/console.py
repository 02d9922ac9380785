"""What a session prints."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from rig.command_run import Run
from rig.config import RigConfig
from rig.journal.run_folder import Record
from rig.outputs.messages import choice_text, event_lines, numbers
from rig.outputs.run_state import RunState
from rig.outputs.telemetry import telemetry
from rig.readings.attitude import Array


def listen(run: Run) -> None:
    """Print what happens in a run, and append what phone and drives say to its files.

    A session neither waits for them nor needs them.
    """
    state = RunState()
    for record in run.journal.records:
        state.apply(record)

    def hear(record: Record) -> None:
        state.apply(record)
        lines = event_lines(record)
        if record["event"] == "posture":
            remaining = f", about {state.left_s():.0f} s left" if state.left_s() else ""
            lines = [
                f"  [{len(state.done):>3}/{state.planned}] {record['name']:<12} "
                f"u [{numbers(record['commanded_deg'], 8, 3)}]  "
                f"y [{numbers(record['measured_deg'], 8, 3)}]{remaining}"
            ]
        if threading.current_thread() is threading.main_thread():
            run.say(*lines)
        elif lines:  # a terminal held by Ctrl-S must not hold the phone's thread too
            threading.Thread(target=run.say, args=lines, daemon=True).start()

    run.listeners.append(hear)
    run.beside.append(telemetry)


def plan_lines(
    config: RigConfig, choice: Any, pulses: Array, start_deg: Array
) -> list[str]:
    """What will be done: a choice, in the order of visits, of (M, n) ``pulses``."""
    session, settle = config.session, config.settle
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
    ways = np.abs(np.diff(np.vstack([start_deg, degrees]), axis=0))
    speeds = np.array([axis.speed_deg_s for axis in config.axes])
    seconds = (ways / speeds).max(axis=1).sum() / config.k
    seconds += settle.window_s + 0.02 * settle.samples + 0.1
    visits, both = (2, ", before and after") if config.model is None else (1, "")
    total = seconds * (config.k + visits * session.verify_postures + 2)
    lines.append(
        f"  with {session.verify_postures} held-out postures{both}, about {total:.0f} s"
    )
    return lines
