"""Events of a run and results of a calibration in words, for console, page, report."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxcal.extras import MissingExtraError
from rig.config import AXIS_NAMES
from rig.core.stop import UnitStop
from rig.faults import EXIT_OK, EXIT_RECALIBRATE
from rig.journal.run_folder import Record, RunFolder
from rig.pages import REPORT, write_report

NUMBERS = {2: "two", 4: "four", 6: "six", 12: "twelve"}
UNITS = {"deg": "degrees", "mm": "millimetres"}
ENDS = ("end", "fault", "stopped", "paused", "refused")
REPLIES = {
    "obeyed": "the drive obeys",
    "not taken": "the drive did not accept it; it is sent again",
    "unknown": "it is unknown whether the drive accepted it; all drives stop",
}


def _reference(record: Record) -> str:
    worst = max(map(abs, record["angles"]))
    unit = record.get("unit", "deg")
    good = f"reference posture is {worst:.3f} {unit} from zero; continuing"
    return good if worst <= record["limit"] else ""


def _comm_restored(record: Record) -> str:
    return record["error"] and (
        f"{record['axis']}: its communication timeout was not restored to "
        f"{record['counts']} ({record['error']}); `jaxcal-rig resume` does it"
    )


def _stayed(record: Record) -> str:
    lines = [f"WARNING: {text}, and was stopped again" for text in record["went_on"]]
    units = [f"  {UnitStop(**unit)}" for unit in record["units"]]
    return "\n".join([*lines, *units])


def _last_move(record: Record) -> str:
    """What moved last, from where to where, and what drives and phone say now."""
    ways = []
    # Written before axes had names of their own: those of the first device.
    names = record.get("axes", AXIS_NAMES)
    units = record.get("units", ["deg"] * len(names))
    outputs, values = record.get("outputs") or names, record["phone_deg"] or ()
    measured = dict(zip(outputs, values, strict=False))
    for i, name in enumerate(names):
        begin, end = record["from_deg"][i], record["to_deg"][i]
        if begin != end:
            drive = record["drives_deg"][i]
            place = "its drive does not answer" if drive is None else f"now {drive:.2f}"
            place += f", measured {measured[name]:.2f}" if name in measured else ""
            ways.append(f"{name} from {begin:.2f} to {end:.2f} {units[i]} ({place})")
    others = [f"{name} {at:.3g}" for name, at in measured.items() if name not in names]
    told = f"; measured {', '.join(others)}" if others else ""
    return f"last moved to {record['label']}: {'; '.join(ways) or 'no axis'}{told}"


def _stop(record: Record) -> str:
    """Unit by unit where something is to be said of one; `stayed` does it later."""
    units = [UnitStop(**unit) for unit in record["units"]]
    told = "".join(f"\n  {unit}" for unit in units)
    if all(u.acknowledged and u.standing and not u.detail for u in units):
        told = f"\n  {', '.join(unit.axis for unit in units)}: acknowledged, at rest"
    return f"stop: {record['reason'] or 'end of run'}{told}"


# An event of the run in words, for console, page and report: its fields are put in.
SENTENCES: dict[str, str | Callable[[Record], str]] = {
    "start": "{mode} begun",
    "resume": "resumed after an interruption",
    "listening": lambda r: (
        "waiting for the sensor"
        if r["format"] == "numbers"
        else "IMU: waiting for the phone on port {port} ({format})".format_map(r)
    ),
    "armed": "armed: {drives} drives on {where}",
    "note": "{text}",
    "reference": _reference,
    "reoriented": "the phone is connected again, its heading changed by "
    "{turned_deg:.3f} deg: {told}",
    "zero": "zero measured at pulses {pulses}",
    "void": lambda r: f"  discarded, to be measured again: {', '.join(r['names'])}",
    "replan": lambda r: (
        f"  the remaining postures were selected again: {choice_text(r['choice'])}; "
        f"visits of candidates {', '.join(map(str, r['choice']['indices']))}"
    ),
    "pausing": "pausing after this posture; press Ctrl-C again to stop at once",
    "lost_reply": lambda r: (
        f"  the reply to a move of {r['axis']} was lost: {REPLIES[r['outcome']]}"
    ),
    "sender_refused": "WARNING: {reason}",
    "unreachable": "  {name} is out of reach: {reason}",
    "comm_restored": _comm_restored,
    "stop": _stop,
    "stayed": _stayed,
    "last_move": _last_move,
    "shown": "  {axis}: measured/commanded {ratio:.3f}, at `axes` {before:.3f}",
}


def event_lines(record: Record) -> list[str]:
    """What an event of the run comes to; most are silent."""
    sentence = SENTENCES.get(record["event"], "")
    if isinstance(sentence, str):
        return sentence.format_map(record).splitlines()
    return sentence(record).splitlines()


def numbers(values: Any, width: int = 9, digits: int = 4) -> str:
    """Numbers side by side; what rounds to zero has no sign."""
    rounded = (round(float(value), digits) + 0.0 for value in values)
    return " ".join(f"{value:{width}.{digits}f}" for value in rounded)


def summary_lines(summary: dict[str, Any], limit_deg: float) -> list[str]:
    """The parameters with their intervals, the errors, any warning and the verdict."""
    outputs, drift = summary.get("outputs") or summary["axes"], summary.get("drift")
    if "parameters" in summary:
        lines, use = _model_lines(summary)
    else:
        lines, use = _affine_lines(summary, outputs), "`jaxcal-rig export` writes it"
    if drift:
        lines.append(f"drift: {drift_text(drift, outputs, summary['unit'])}")
    if reasons := recalibrate(summary, limit_deg):
        verdict = (
            f"RECALIBRATE: {' and '.join(reasons)}. Do not use this calibration; next: "
            "find the cause (report.html shows each posture), then `jaxcal-rig "
            "calibrate`"
        )
    else:
        verdict = f"good; next: {use} for a controller; `jaxcal-rig verify` checks it "
        verdict += "later"
    return [*lines, verdict]


def _affine_lines(summary: dict[str, Any], outputs: Sequence[str]) -> list[str]:
    count, unit = np.size(summary["ci95"]), summary["unit"]
    number = NUMBERS.get(count, count)
    lines = [
        f"y = A u + b in {UNITS.get(unit, unit)}, +- 95 % confidence for all {number} "
        "together:"
    ]
    for row, name in enumerate(outputs):
        a, b, wide = summary["A"][row], summary["b"][row], summary["ci95"][row]
        values = "  ".join(f"{a[i]:8.5f} +- {wide[i]:.5f}" for i in range(len(a)))
        lines.append(f"  {name:<5} [{values}]   {b:8.4f} +- {wide[-1]:.4f}")
    std = zip(outputs, summary["noise_std_deg"], strict=True)
    lines.append(
        f"  noise of one posture {', '.join((f'{n} {v:.4f}' for n, v in std))} "
        f"{unit}, from {summary['basis']} ({summary['dof']} degrees of freedom each)"
    )
    if "prediction" in summary:
        lines.append(f"held-out {error_text(summary, unit)}")
    return lines


def _model_lines(summary: dict[str, Any]) -> tuple[list[str], str]:
    unit, count = summary["unit"], len(summary["postures"])
    lines = [f"model {summary['model']}, fitted to {count} postures, +- 95 % each:"]
    for name, parameter in summary["parameters"].items():
        wide = parameter["half_width"]
        sure = "" if wide is None else f" +- {wide:.4g}"
        lines.append(
            f"  {name:<14} {parameter['value']:11.5g}{sure}  (designed "
            f"{parameter['designed']:.5g})"
        )
    if "prediction" in summary:
        lines.append(f"held-out {error_text(summary, unit)}")
    lines += [f"  note: {reason}" for reason in summary["fit"]["reasons"]]
    if summary.get("urdf"):
        return lines, f"{summary['urdf']} in the run's folder"
    return lines, "calibration.json (jaxcal command, jaxcal predict)"


def error_text(errors: dict[str, Any], unit: str = "deg") -> str:
    """Errors at held-out targets, raw and compensated; else of the predictions."""
    text, after = "prediction error before calibration {}, after {}", "prediction"
    if "after" in errors:
        text, after = "error before {}, after compensation {}", "after"
    first, second = (
        f"{errors[name]['rms']:.4f}{of} (max {errors[name]['max']:.4f})"
        for name, of in (("before", f" {unit} rms"), (after, ""))
    )
    return text.format(first, second)


def held_out(summary: dict[str, Any]) -> tuple[str, float]:
    """Which error at held-out targets a calibration is judged by, and the largest."""
    if "after" in summary:
        return "after compensation", summary["after"]["max"]
    return "of the prediction", summary.get("prediction", {}).get("max", math.nan)


def recalibrate(summary: dict[str, Any], limit_deg: float) -> list[str]:
    """Why a calibration is not to be used; nothing where all is well."""
    reasons, unit = [], summary.get("unit", "deg")
    what, worst = held_out(summary)
    if worst > limit_deg:
        limit = f"session.verify_limit_deg ({limit_deg:g} {unit})"
        reasons.append(f"the error {what}, {worst:.3g} {unit}, exceeds {limit}")
    if summary.get("drift") and summary["drift"]["over"]:
        most = summary["drift"]["limit_deg"]
        limit = f"session.drift_limit_deg ({most:g} {unit})"
        reasons.append(f"the nonlinear drift of the zero exceeds {limit}")
    if "prediction" not in summary and not summary.get("fit", {}).get("good", True):
        reasons += summary["fit"]["reasons"]  # of a model, by its readings alone
    if (mispairing := summary.get("mispairing")) and mispairing not in reasons:
        reasons.insert(0, mispairing)
    return reasons


def drift_text(drift: dict[str, Any], outputs: Sequence[str], unit: str = "deg") -> str:
    """How far the zero drifted, and what was done about it."""
    worst = int(np.argmax(np.abs(drift["angles_deg"]).max(axis=0)))
    text = (
        f"the zero posture was up to {drift['size_deg']:.4f} {unit} from zero "
        f"({outputs[worst]}) on later visits (limit {drift['limit_deg']:g})"
    )
    if drift["corrected"]:
        rate = drift["angles_deg"][-1][worst] / drift["minutes"][-1]
        text += f"; linear, {rate:+.4f} {unit}/min, and removed: "
        text += f"{drift['left_deg']:.4f} {unit} remain"
    if drift["over"]:
        kind = "It is not linear. " if len(drift["minutes"]) == 3 else ""
        text += (
            f". {kind}Check for a loose phone, backlash, or a magnetic heading near "
        )
        text += "the motors"
    return text


def choice_text(choice: dict[str, Any]) -> str:
    """How the postures were chosen, and how good they are."""
    if choice.get("criterion", "D") != "D":
        return (
            f"{choice['method']}: {choice['criterion']}-efficiency at least "
            f"{choice['efficiency']:.4f}"
        )
    rank = "proven optimum" if choice["proven"] else "best known"
    gap = choice["best_log_det"] - choice["log_det"]
    return (
        f"{choice['method']}: log det {choice['log_det']:.4f} (commands in degrees), "
        f"{rank} {choice['best_log_det']:.4f}, gap {gap:.4f}, D-efficiency "
        f"{choice['efficiency']:.4f}"
    )


def save_result(
    run: RunFolder, calibration: Any, summary: Record, say: Callable[[str], object]
) -> int:
    """Write what a calibration comes to, say what it holds; returns the exit code."""
    calibration.save(run.folder / "calibration.json")
    saved = ["calibration.json", "pairs.csv", "summary.json"]
    if run.config.is_arm:
        summary["urdf"] = "calibrated.urdf"
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            calibration.to_urdf(run.folder / summary["urdf"], force=True)
        for warning in caught:
            say(f"  note: {warning.message}")
        saved.insert(1, summary["urdf"])
    run.save_pairs()
    run.save_summary(summary)
    limit = run.config.session.verify_limit_deg
    for line in summary_lines(summary, limit):
        say(line)
    try:
        write_report(run.folder)
        saved.append(REPORT)
    except MissingExtraError as lack:
        say(f"  note: no report: {lack}")
    say(f"saved: {run.folder}/{', '.join(saved)}")
    return EXIT_RECALIBRATE if recalibrate(summary, limit) else EXIT_OK
