"""The calibration session: choose, visit, identify, verify, save."""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np

from jaxcal.files import write_text
from rig.attitude import Array
from rig.exits import EXIT_OK, EXIT_RECALIBRATE
from rig.faults import MotionFault
from rig.identification import (
    errors,
    fit,
    order_residuals,
    uncertainty,
    zero_variance,
)
from rig.limits import check_plan
from rig.planning import Choice, choose, draw_candidates, draw_held_out, travel_order
from rig.session import Run
from rig.settings import AXIS_NAMES
from rig.words import degrees_of, describe_plan, pairs_csv, say_summary, speeds

__all__ = ["calibrate"]


def _plan(run: Run) -> tuple[Array, Choice]:
    """(M, 3) candidate pulses and the first choice; made once, then remembered."""
    config = run.config

    def make() -> dict[str, Any]:
        candidates = draw_candidates(config)
        begun = time.perf_counter()
        choice = choose(config, degrees_of(config, candidates))
        return {
            "candidates": candidates.tolist(),
            "choice": choice.described(),
            "seconds": round(time.perf_counter() - begun, 4),
        }

    record = run.remember("plan", make)
    return np.array(record["candidates"]), _choice_of(record["choice"])


def _choice_of(data: dict[str, Any]) -> Choice:
    return Choice(**{**data, "indices": tuple(data["indices"])})


def calibrate(run: Run, dry_run: bool = False) -> int:
    """Run the whole session; returns the exit code."""
    config, session = run.config, run.config.session
    candidates, choice = _plan(run)
    describe_plan(run, candidates, choice)
    a, b, c = candidates[list(choice.indices)].T.tolist()
    check_plan(config, zip(a, b, c, strict=True))
    if dry_run:
        run.say("dry run: nothing was sent to the bus")
        return EXIT_OK
    run.planned = session.k + 2 * session.verify_postures + 1
    if run.zero_pulses is None:
        run.ready()
    chosen = _visit_chosen(run, candidates, choice)
    run.phase("saving")
    first = fit(chosen, _reading_noise(chosen))
    first.save(run.folder / "calibration.partial.json")
    held = _held_out(run, first)
    run.planned = session.k + 2 * len(held) + 1
    before, after, desired = _verify(run, held)
    end = run.visit("reference:end", run.zero_pulses, role="reference")
    run.say("drives at rest; identifying")
    drift = None if end is None else float(np.abs(end["measured_deg"]).max())
    return _finish(run, chosen, before, after, desired, choice, drift)


def _visit_chosen(run: Run, candidates: Array, choice: Choice) -> list[dict[str, Any]]:
    """Measure K postures; one out of reach is masked and the rest chosen anew."""
    config = run.config
    degrees = degrees_of(config, candidates)
    available = np.ones(len(candidates), dtype=bool)
    records: dict[int, dict[str, Any]] = {}
    assert run.zero_pulses is not None
    start = config.to_deg(run.zero_pulses)
    plans = run.journal.events("replan")
    while True:
        left = np.array([i for i in choice.indices if i not in records], dtype=int)
        here = start if not records else degrees[list(records)[-1]]
        failed = None
        for index in left[travel_order(degrees[left], here, speeds(config))]:
            record = run.visit(
                f"select:{index}", candidates[index], role="select", index=int(index)
            )
            if record is None:
                failed = int(index)
                break
            records[int(index)] = record
        if failed is None:
            return list(records.values())
        available[failed] = False
        lost = int((~available).sum())
        if lost > config.session.max_unreachable:
            raise MotionFault(
                f"{lost} postures are out of reach, more than session.max_unreachable "
                f"({config.session.max_unreachable}): check the ranges"
            )
        if len(plans) >= lost:
            choice = _choice_of(plans[lost - 1]["choice"])
        else:
            choice = choose(config, degrees, available, tuple(records), policy=False)
            run.journal.write("replan", sync=True, choice=choice.described())
        run.say(
            f"  chosen anew without {failed}: log det {choice.log_det:.4f}, "
            f"{len(records)} measured postures kept"
        )


def _reading_noise(records: list[dict[str, Any]]) -> float:
    std = np.array([r["std_deg"] for r in records])
    counts = np.array([[r["samples"]] for r in records])
    return float(max(1e-9, np.sqrt((std**2 / counts).mean())))


def _held_out(run: Run, calibration: Any) -> list[Any]:
    """Pairs of pulses, raw and compensated; drawn once for one set of chosen postures.

    Where chosen postures were made void since, the compensated commands came from a
    wrong calibration: they are drawn anew, and what was measured there is void too.
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
        run.journal.write("void", sync=True, names=stale)
    found = draw_held_out(run.config, calibration, run.config.session.verify_postures)
    if len(found) < run.config.session.verify_postures:
        run.say(
            f"  note: only {len(found)} held-out targets can be reached compensated "
            "within the ranges"
        )
    drawn = [[list(raw), list(command)] for raw, command in found]
    return run.journal.write("held_out", sync=True, pairs=drawn)["pairs"]


def _verify(
    run: Run, held: list[Any]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]], Array]:
    """Visit every held-out target raw and compensated, in the order of least travel."""
    config = run.config
    assert run.zero_pulses is not None
    visits = [(f"before:{i}", raw) for i, (raw, _) in enumerate(held)]
    visits += [(f"after:{i}", command) for i, (_, command) in enumerate(held)]
    start = config.to_deg(run.zero_pulses)
    points = np.array([config.to_deg(pulses) for _, pulses in visits]).reshape(-1, 3)
    found: dict[str, dict[str, Any] | None] = {}
    for number in travel_order(points, start, speeds(config)):
        name, pulses = visits[number]
        found[name] = run.visit(name, pulses, role=name.partition(":")[0])
    before, after, desired = [], [], []
    for i, (raw, _) in enumerate(held):
        one, two = found[f"before:{i}"], found[f"after:{i}"]
        if one is not None and two is not None:
            before.append(one)
            after.append(two)
            desired.append(config.to_deg(raw))
    return before, after, np.array(desired).reshape(-1, 3)


def _finish(
    run: Run,
    chosen: list[dict[str, Any]],
    before: list[dict[str, Any]],
    after: list[dict[str, Any]],
    desired: Array,
    choice: Choice,
    drift: float | None,
) -> int:
    """Identify, check, save, report. The drives are stopped and let go first."""
    assert run.frame is not None
    run.phase("finishing")
    if run.motion is not None:
        run.stop("", latch=False)
        run.disarm()
    run.signals.check_stop()
    everything = chosen + before + after
    first = fit(chosen, _reading_noise(chosen))
    zero = run.journal.events("zero")[-1]
    limits = uncertainty(first, chosen, before + after, zero)
    notes = {
        "zero_pulses": list(run.zero_pulses or ()),
        "fingerprint": run.config.fingerprint(),
        "mechanism_order": run.config.mechanism_order,
        "postures": [r["name"] for r in chosen],
        "noise_from": limits["basis"],
        "run": run.folder.name,
    }
    noise = max(1e-9, float(np.mean(limits["noise_std_deg"])))
    zero_std = float(np.sqrt(zero_variance(zero).mean()))
    calibration = fit(chosen, noise, notes, zero_std)
    summary: dict[str, Any] = {
        "schema": 1,
        "mode": "calibrate",
        "axes": list(AXIS_NAMES),
        "unit": "deg",
        "A": np.asarray(calibration.matrix).tolist(),
        "b": np.asarray(calibration.bias).tolist(),
        **limits,
        "choice": choice.described(),
        "postures": [r["name"] for r in chosen],
        "zero_pulses": list(run.zero_pulses or ()),
        "drift_deg": drift,
        "orders": order_residuals(run.config, run.frame, everything),
        "simulated": run.journal.records[0].get("simulated"),
        "fingerprint": run.config.fingerprint(),
    }
    code = EXIT_OK
    if before:
        summary["before"] = errors(before, desired)
        summary["after"] = errors(after, desired)
        if summary["after"]["max"] > run.config.session.verify_limit_deg:
            code = EXIT_RECALIBRATE
    calibration.save(run.folder / "calibration.json")
    (run.folder / "calibration.partial.json").unlink(missing_ok=True)
    write_text(run.folder / "pairs.csv", pairs_csv(run))
    write_text(run.folder / "summary.json", json.dumps(summary, indent=1))
    from rig.report import write_report

    write_report(run.folder, summary, run.journal.records[0], run.postures())
    say_summary(run, summary, code)
    return code
