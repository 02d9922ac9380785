"""The calibration session: choose, visit, identify, verify, save."""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np

from rig.attitude import Array
from rig.identification import errors, fit, order_residuals, uncertainty
from rig.journal import write_atomically
from rig.limits import check_plan
from rig.motion import MotionFault
from rig.planning import Choice, choose, draw_candidates, draw_held_out, travel_order
from rig.session import EXIT_OK, EXIT_RECALIBRATE, Run
from rig.settings import AXIS_NAMES, RigConfig

__all__ = ["calibrate", "describe_plan", "pairs_csv", "speeds"]


def speeds(config: RigConfig) -> Array:
    """(3,) degrees a second."""
    return np.array([axis.speed_deg_s for axis in config.axes])


def _plan(run: Run) -> tuple[Array, Choice]:
    """(M, 3) candidate pulses and the first choice; made once, then remembered."""
    config = run.config

    def make() -> dict[str, Any]:
        candidates = draw_candidates(config)
        begun = time.perf_counter()
        choice = choose(config, _degrees(config, candidates))
        return {
            "candidates": candidates.tolist(),
            "choice": choice.described(),
            "seconds": round(time.perf_counter() - begun, 4),
        }

    record = run.remember("plan", make)
    return np.array(record["candidates"]), _choice_of(record["choice"])


def _choice_of(data: dict[str, Any]) -> Choice:
    return Choice(**{**data, "indices": tuple(data["indices"])})


def _degrees(config: RigConfig, pulses: Array) -> Array:
    return np.array([config.to_deg(row) for row in pulses])


def describe_plan(run: Run, candidates: Array, choice: Choice) -> float:
    """Say what will be done; returns an estimate of its seconds."""
    config, say = run.config, run.say
    session, settle = config.session, config.settle
    degrees = _degrees(config, candidates)
    rank = "proven optimum" if choice.proven else "best known"
    say(
        f"{session.k} of {session.candidates} candidates by {choice.method}: log det "
        f"{choice.log_det:.4f} (commands in degrees), {rank} "
        f"{choice.best_log_det:.4f}, D-efficiency {choice.efficiency:.4f}"
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
    held = run.remember("held_out", lambda: _held_out(run, first))["pairs"]
    run.planned = session.k + 2 * len(held) + 1
    before, after, desired = _verify(run, held)
    end = run.visit("reference:end", run.zero_pulses, role="reference")
    run.say("drives at rest; identifying")
    drift = None if end is None else float(np.abs(end["measured_deg"]).max())
    return _finish(run, chosen, before, after, desired, choice, drift)


def _visit_chosen(run: Run, candidates: Array, choice: Choice) -> list[dict[str, Any]]:
    """Measure K postures; one out of reach is masked and the rest chosen anew."""
    config = run.config
    degrees = _degrees(config, candidates)
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


def _held_out(run: Run, calibration: Any) -> dict[str, Any]:
    found = draw_held_out(run.config, calibration, run.config.session.verify_postures)
    if len(found) < run.config.session.verify_postures:
        run.say(
            f"  note: only {len(found)} held-out targets can be reached compensated "
            "within the ranges"
        )
    return {"pairs": [[list(raw), list(command)] for raw, command in found]}


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
    calibration = fit(chosen, noise, notes)
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
    write_atomically(run.folder / "pairs.csv", pairs_csv(run))
    write_atomically(run.folder / "summary.json", json.dumps(summary, indent=1))
    from rig.report import write_report

    write_report(run.folder, summary, run.journal.records[0], run.postures())
    _say_summary(run, summary, code)
    return code


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


def _say_summary(run: Run, summary: dict[str, Any], code: int) -> None:
    say = run.say
    say("y = A u + b in degrees, +- 95 % confidence:")
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
