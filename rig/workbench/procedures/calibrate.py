"""The calibration session: choose, visit, identify, verify, save."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rig.core.attitude import Array
from rig.core.device import check_plan
from rig.core.faults import EXIT_OK, EXIT_RECALIBRATE, MotionFault
from rig.core.plan import (
    Choice,
    choose,
    draw_candidates,
    draw_held_out,
    travel_order,
)
from rig.core.record import SIGN_CHECKED, check_matrix
from rig.core.session import Run
from rig.journal import Record
from rig.workbench.identification.conclusion import Evidence, conclude
from rig.workbench.identification.fit import fit, held_out_errors
from rig.workbench.outputs.console import plan_lines, recalibrate, summary_lines

MIDDLE, END = "reference:middle", "reference:end"  # visits of the zero posture


def calibrate(run: Run) -> int:
    """Run the whole session; returns the exit code."""
    config, session = run.config, run.config.session
    candidates, choice = _plan(run)
    check_plan(config, [tuple(candidates[i].tolist()) for i in choice.indices])
    run.planned = session.k + 2 * session.verify_postures + 2
    if run.zero_pulses is None:
        run.ready()
    chosen = _visit_chosen(run, candidates, choice)
    run.emit("phase", phase="saving")
    first = fit(chosen)
    _check_gains(run, first.matrix)
    first.save(run.folder / "calibration.partial.json")
    held = _held_out(run, first)
    run.planned = session.k + 2 * len(held) + 2
    if held:
        run.visit(MIDDLE, run.zero_pulses, role="reference")
    held_out, _ = visit_pairs(run, held)
    run.visit(END, run.zero_pulses, role="reference")
    run.say("drives at rest; identifying")
    run.emit("phase", phase="finishing")
    run.stop("", latch=False)
    run.disarm()
    run.signals.check_stop()
    summary = _identify(run, chosen, held, held_out)
    summary["choice"] = dataclasses.asdict(choice)
    return _save(run, summary)


def _plan(run: Run) -> tuple[Array, Choice]:
    """(M, 3) candidate pulses and the first choice; made once, then remembered."""
    config = run.config

    def make() -> dict[str, Any]:
        session = config.session
        run.say(
            f"planning: {session.k} of {session.candidates} candidates by "
            f"{session.method}, and the proven optimum; nothing moves yet"
        )
        candidates = draw_candidates(config)
        choice = choose(config, config.to_deg(candidates))
        return {
            "candidates": candidates.tolist(),
            "choice": dataclasses.asdict(choice),
        }

    record = run.remember("plan", make)
    candidates, choice = np.array(record["candidates"]), Choice(**record["choice"])
    start = config.to_deg(run.zero_pulses or (0, 0, 0))
    chosen = np.array(choice.indices)
    order = chosen[travel_order(config, config.to_deg(candidates[chosen]), start)]
    shown = dataclasses.replace(choice, indices=tuple(order.tolist()))
    run.say(*plan_lines(config, shown, candidates, start))
    return candidates, choice


def _visit_chosen(run: Run, candidates: Array, choice: Choice) -> list[Record]:
    """Measure K postures; without one out of reach the rest are selected again."""
    config, degrees = run.config, run.config.to_deg(candidates)
    available = np.ones(len(candidates), dtype=bool)
    records: dict[int, Record] = {}
    here = config.to_deg(run.zero_pulses)
    plans = iter(run.journal.events("replan"))
    while True:
        left = np.array([i for i in choice.indices if i not in records], dtype=int)
        queue = left[travel_order(config, degrees[left], here)].tolist()
        run.emit("queue", names=[f"select:{index}" for index in queue])
        for index in queue:
            record = run.visit(
                f"select:{index}", candidates[index], role="select", index=index
            )
            if record is None:
                break
            records[index], here = record, degrees[index]
        else:
            return list(records.values())
        available[index] = False
        lost = int((~available).sum())
        if lost > config.session.max_unreachable:
            raise MotionFault(
                f"{lost} postures are out of reach, more than session.max_unreachable "
                f"({config.session.max_unreachable}). Check the ranges"
            )
        plan = next(plans, None)
        if plan is None:
            choice = choose(config, degrees, available, tuple(records), replanning=True)
            plan = run.emit("replan", sync=True, choice=dataclasses.asdict(choice))
        choice = Choice(**plan["choice"])
        run.say(
            f"  selected again without {index}: log det {choice.log_det:.4f}, "
            f"{len(records)} measured postures kept"
        )


def _check_gains(run: Run, matrix: Any) -> None:
    """Refuse a fit whose axes are reversed or exchanged: the sign check is void."""
    try:
        run.say(*(f"WARNING: {text}" for text in check_matrix(matrix)))
    except MotionFault as fault:
        run.record.void(SIGN_CHECKED, str(fault))
        raise


def _held_out(run: Run, calibration: Any) -> list[Any]:
    """Pairs of pulses, raw and compensated; drawn once for one set of chosen postures.

    Where a chosen posture was withdrawn since, the compensated commands came from a
    wrong calibration: they are drawn again, and what was measured there is withdrawn.
    """
    known = run.journal.events("held_out")
    voids = [
        record["seq"]
        for record in run.journal.events("void")
        if any(name.startswith("select:") for name in record["names"])
    ]
    if known and not (voids and voids[-1] > known[-1]["seq"]):
        return known[-1]["pairs"]
    stale = [n for n in run.postures() if n.startswith(("before:", "after:"))]
    if stale:
        run.emit("void", sync=True, names=stale)
    wanted = run.config.session.verify_postures
    found = draw_held_out(run.config, calibration, wanted)
    if len(found) < wanted:
        run.say(
            f"  note: only {len(found)} of {wanted} held-out targets can be reached "
            "compensated within the ranges"
        )
    return run.emit("held_out", sync=True, pairs=found)["pairs"]


def visit_pairs(run: Run, held: list[Any]) -> tuple[list[Record], dict[str, Any]]:
    """Visit held-out targets raw and compensated, in the order of least travel.

    Returns:
        The records, and the errors ``before`` and ``after`` compensation, of the
        targets of which both could be reached; no errors where there are none.
    """
    config, roles = run.config, ("before", "after")
    visits = [
        (f"{role}:{i}", role, pair[number])
        for number, role in enumerate(roles)
        for i, pair in enumerate(held)
    ]
    points = config.to_deg([pulses for *_, pulses in visits] or np.empty((0, 3)))
    start = config.to_deg(run.zero_pulses or (0, 0, 0))
    found: dict[str, Record] = {}
    queue = travel_order(config, points, start)
    run.emit("queue", names=[visits[number][0] for number in queue])
    for number in queue:
        name, role, pulses = visits[number]
        if record := run.visit(name, pulses, role=role):
            found[name] = record
    return held_out_errors(config, held, found)


def _identify(
    run: Run, chosen: list[Record], held: list[Any], held_out: list[Record]
) -> dict[str, Any]:
    """Identify A and b, save calibration.json; what the summary says of them."""
    postures = run.postures()
    references = [postures[name] for name in (MIDDLE, END) if name in postures]
    zero = run.journal.events("zero")[-1]
    evidence = Evidence(zero, chosen, held, held_out, references)
    simulated = run.journal.records[0].get("simulated")
    notes = {"run": run.folder.name, "simulated": simulated is not None}
    calibration, summary = conclude(run.config, evidence, notes)
    calibration.save(run.folder / "calibration.json")
    (run.folder / "calibration.partial.json").unlink(missing_ok=True)
    return {"mode": "calibrate", **summary, "simulated": simulated}


def _save(run: Run, summary: dict[str, Any]) -> int:
    """Write pairs, summary and report, say what they hold; returns the exit code."""
    from rig.workbench.outputs.report import write_report

    run.save_pairs()
    run.save_summary(summary)
    write_report(run.folder, run.journal.records)
    limit = run.config.session.verify_limit_deg
    run.say(
        *summary_lines(summary, limit),
        f"saved: {run.folder}/calibration.json, pairs.csv, summary.json, report.html",
    )
    return EXIT_RECALIBRATE if recalibrate(summary, limit) else EXIT_OK
