"""The calibration session: choose, visit, identify, verify, save; and collecting."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxcal.files import atomic_write
from rig.command_run import Run
from rig.core.device import Device, Posture, check_plan
from rig.core.session import visit
from rig.faults import EXIT_OK, EXIT_RECALIBRATE, MotionFault
from rig.identification.conclusion import check_matrix, conclude, identify_affine, pairs
from rig.journal.device import SIGN_CHECKED
from rig.outputs.messages import save_result
from rig.outputs.run_state import roles_of
from rig.procedures.plan import (
    Choice,
    choose,
    draw,
    draw_held_out,
    plan_lines,
    travel_order,
)
from rig.readings.geometry import Array

MIDDLE, END = "reference:middle", "reference:end"  # visits of the zero posture


def calibrate(run: Run) -> int:
    """Run the whole session; returns the exit code."""
    config = run.config
    candidates, choice = _plan(run)
    check_plan(config, [tuple(candidates[i].tolist()) for i in choice.indices])
    if run.lacks([END]):
        with run.device() as device:
            _visit_chosen(run, device, candidates, choice)
            run.emit("phase", phase="saving")
            chosen = [r for r in run.postures().values() if r["role"] == "select"]
            first = None
            if run.model is None:
                first = identify_affine(config, chosen)
                _check_gains(run, first.matrix)
            held = _held_out(run, first)
            if held:
                visit(device, Posture(MIDDLE, run.zero_pulses), role="reference")
            visit_pairs(run, device, held)
            visit(device, Posture(END, run.zero_pulses), role="reference")
        run.say("drives at rest; identifying")
        run.emit("phase", phase="finishing")
        run.signals.check_stop()
    return _identify(run)


def _plan(run: Run) -> tuple[Array, Choice]:
    """(M, n) candidate pulses and the first choice; made once, then remembered."""
    config = run.config

    def make() -> dict[str, Any]:
        session = config.session
        run.say(
            f"planning: {config.k} of {session.candidates} candidates by "
            f"{config.method}, and the proven optimum; nothing moves yet"
        )
        candidates = draw(config, session.candidates)
        choice = choose(config, config.to_deg(candidates))
        choice = _ordered(run, choice, candidates, config.to_deg(run.zero_pulses))
        chosen = dataclasses.asdict(choice)
        return {"candidates": candidates.tolist(), "choice": chosen}

    record = run.remember("plan", make)
    candidates, choice = np.array(record["candidates"]), Choice(**record["choice"])
    run.say(*plan_lines(config, choice, candidates))
    return candidates, choice


def _ordered(
    run: Run, choice: Choice, candidates: Array, here: Array, done: Sequence[int] = ()
) -> Choice:
    """A choice in the order of its visits, from (n,) degrees; done ones first."""
    left = np.array([i for i in choice.indices if i not in done], dtype=int)
    points = run.config.to_deg(candidates[left])
    queue = left[travel_order(run.config, points, here)].tolist()
    return dataclasses.replace(choice, indices=(*done, *queue))


def _visit_chosen(run: Run, device: Device, candidates: Array, choice: Choice) -> None:
    """Measure K postures; without one out of reach the rest are selected again."""
    config, degrees = run.config, run.config.to_deg(candidates)
    available = np.ones(len(candidates), dtype=bool)
    done: list[int] = []
    here = config.to_deg(run.zero_pulses)
    plans = iter(run.journal.events("replan"))
    while True:
        queue = [index for index in choice.indices if index not in done]
        run.emit("queue", names=[f"select:{index}" for index in queue])
        for index in queue:
            posture = Posture(f"select:{index}", tuple(candidates[index].tolist()))
            if visit(device, posture, role="select", index=index) is None:
                break
            here = degrees[index]
            done.append(index)
        else:
            return
        available[index] = False
        plan = next(plans, None)
        if plan is None:
            choice = choose(config, degrees, available, tuple(done))
            choice = _ordered(run, choice, candidates, here, done)
            plan = run.emit("replan", sync=True, choice=dataclasses.asdict(choice))
        choice = Choice(**plan["choice"])


def _check_gains(run: Run, matrix: Any) -> None:
    """Refuse a fit whose axes are reversed or exchanged: the sign check is void."""
    try:
        run.say(*(f"WARNING: {text}" for text in check_matrix(run.config, matrix)))
    except MotionFault as fault:
        run.record.void(SIGN_CHECKED, str(fault))
        raise


def _held_out(run: Run, calibration: Any) -> list[Any]:
    """Pairs of pulses, raw and compensated, drawn once for a set of chosen postures."""
    drawn = run.journal.events("held_out")
    voids = [
        record["seq"]
        for record in run.journal.events("void")
        if any(name.startswith("select:") for name in record["names"])
    ]
    if drawn and not (voids and voids[-1] > drawn[-1]["seq"]):
        return drawn[-1]["pairs"]
    stale = [n for n in run.postures() if n.startswith(("before:", "after:", "held:"))]
    if stale:
        run.emit("void", sync=True, names=stale)
    count = run.config.session.verify_postures
    targets = draw_held_out(run.config, calibration, count)
    if len(targets) < count:
        run.say(
            f"  note: only {len(targets)} of {count} held-out targets are within the "
            "ranges after compensation"
        )
    return run.emit("held_out", sync=True, pairs=targets)["pairs"]


def pair_targets(held: list[Any]) -> dict[str, Any]:
    """Pulses of held-out targets by name, all raw and then all compensated."""
    roles = roles_of(held[0]) if held else ()
    return {
        f"{role}:{i}": pair[number]
        for number, role in enumerate(roles)
        for i, pair in enumerate(held)
    }


def visit_pairs(run: Run, device: Device, held: list[Any]) -> None:
    """Visit held-out targets raw and compensated, in the order of least travel."""
    targets, config = pair_targets(held), run.config
    points = config.to_deg([*targets.values()]) if targets else np.empty((0, 0))
    order = travel_order(config, points, config.to_deg(run.zero_pulses))
    queue = [[*targets][number] for number in order]
    run.emit("queue", names=queue)
    for name in queue:
        role = name.partition(":")[0]
        visit(device, Posture(name, tuple(targets[name])), role=role)


def _identify(run: Run) -> int:
    """Identify A and b, save them and what they come to; returns the exit code."""
    simulated = run.journal.records[0].get("simulated")
    notes = {"run": run.folder.name, "simulated": simulated is not None}
    calibration, summary = conclude(run.config, run.journal.records, notes)
    choice = [*run.journal.events("plan"), *run.journal.events("replan")][-1]["choice"]
    told = {"mode": "calibrate", "simulated": simulated, "choice": choice}
    return save_result(run, calibration, summary | told, run.say)


def collect(run: Run, count: int) -> int:
    """Record ``count`` random postures, the paper's Datasets 4 and 5: pairs.csv, and in
    dataset.npz whole episodes, ``candidates`` and ``measured`` (episodes, M, ...)."""
    config = run.config
    drawn = run.remember(
        "collection", lambda: {"pulses": draw(config, count, 2).tolist()}
    )["pulses"]
    targets = {f"collect:{number}": pulses for number, pulses in enumerate(drawn)}
    if run.lacks([*targets, END]):
        with run.device() as device:
            for name, pulses in targets.items():
                visit(device, Posture(name, tuple(pulses)), role="collect")
            visit(device, Posture(END, run.zero_pulses), role="reference")
            run.emit("phase", phase="saving")
    closing = run.postures().get(END)
    collected = [r for r in run.postures().values() if r["role"] == "collect"]
    commands, measured = pairs(collected)
    size = min(config.session.candidates, len(commands))
    episodes = len(commands) // max(1, size)
    run.save_pairs()
    inputs, outputs = (
        rows[: episodes * size].reshape(episodes, size, -1)
        for rows in (commands, measured)
    )
    with atomic_write(run.folder / "dataset.npz") as file:
        np.savez(file, candidates=inputs, measured=outputs)
    run.say(
        f"saved: {run.folder}/pairs.csv ({len(commands)} postures), dataset.npz "
        f"({episodes} x {size})"
    )
    drift = np.abs(closing["measured_deg"]).max() if closing else 0.0
    limit = config.session.drift_limit_deg
    if drift > limit:
        run.say(
            f"RECALIBRATE: at the end the zero posture reads {drift:.3f} "
            f"{config.output_unit} (limit session.drift_limit_deg = {limit:g}). Fix "
            f"{'the sensor' if config.readings else 'the phone'}, and collect again"
        )
        return EXIT_RECALIBRATE
    return EXIT_OK
