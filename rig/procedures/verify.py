"""verify: does a saved calibration still hold? Also reading it, for ``goto`` too."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

from rig.command_run import Run
from rig.config import RigConfig
from rig.config.axis import Pulses
from rig.config.config import differences
from rig.core.record_check import ZeroRecord
from rig.faults import EXIT_OK, EXIT_RECALIBRATE, Refused
from rig.identification.fit_affine import held_out_errors, pairs
from rig.outputs.messages import error_text, numbers, prediction_text
from rig.parts import model_of
from rig.procedures.calibrate import pair_names, visit_pairs
from rig.procedures.plan import draw_held_out

_OFFERED = 10  # targets to choose each posture of a check from


def load_calibration(
    path: pathlib.Path, config: RigConfig, simulated: bool = False
) -> tuple[Any, ZeroRecord]:
    """A calibration made with a device configured as this one, and its zero posture.

    Args:
        path: of the file, or of its run's folder.
        config: of the device.
        simulated: so is the device that is to be moved.

    Raises:
        Refused: not a calibration, or of another device (names the keys), or made with
            a simulated one, and that to be moved is real.
    """
    import jaxcal

    path = path / "calibration.json" if path.is_dir() else path
    try:
        made = None if config.is_arm else model_of(config)  # a file holds an arm
        model = None if made is None else made.model
        calibration = jaxcal.Calibration.load(path, model=model)
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise Refused(f"{path}: not a calibration: {reason}") from None
    notes = calibration.provenance.get("notes", {})
    if notes.get("simulated") and not simulated:
        raise Refused(
            f"{path}: made with a simulated device, so it is not valid for the real "
            "one. Calibrate the device, or use it with --simulate"
        )
    if lack := {"device", "zero_pulses", "zero_attitude"} - notes.keys():
        raise Refused(
            f"{path}: the device and zero posture are not recorded (no "
            f"{', '.join(sorted(lack))}). Calibrate the device: jaxcal-rig calibrate"
        )
    if changed := differences(notes["device"], config.device_fingerprint()):
        raise Refused(
            f"{path}: made with another device: {'; '.join(changed)}. Correct "
            "rig.toml, or calibrate this device"
        )
    kept = ZeroRecord(
        f"calibration {notes.get('run', path)}",
        tuple(map(int, notes["zero_pulses"])),
        np.array(notes["zero_attitude"], dtype=np.float64),
    )
    return calibration, kept


def doubts(calibration: Any) -> list[str]:
    """Why its session said not to use a calibration; one made before 0.3 says none."""
    verdict = calibration.provenance.get("notes", {}).get("verdict", {})
    return list(verdict.get("reasons", ()))


def verify(run: Run, calibration: Any, count: int) -> int:
    """Fresh held-out postures against a saved calibration: is it still true?"""
    config = run.config
    held = run.remember(
        "held_out", lambda: {"pairs": telling(config, calibration, count)}
    )["pairs"]
    if not held:
        raise Refused(
            "no target in session.*_range_deg can be reached with this calibration. "
            "Widen the ranges, or calibrate again"
        )
    if run.dry_run:
        for target in held:
            run.say(
                f"  target {numbers(config.to_deg(target[0]))}  command "
                f"{list(target[-1])}"
            )
    if run.lacks(pair_names(held)):
        with run.device() as device:
            visit_pairs(run, device, held)
            run.emit("phase", phase="saving")
    if run.model is not None:
        records = [r for r in run.postures().values() if r["role"] == "held"]
        errors = run.model.held_out_errors(config, calibration, records)
    else:
        records, errors = held_out_errors(config, held, run.postures(), calibration)
    if not errors:
        raise Refused(
            "no held-out posture could be reached. Narrow session.*_range_deg to what "
            "the device reaches"
        )
    limit = config.session.verify_limit_deg
    worst = "after" if run.model is None else "prediction"
    words = error_text if run.model is None else prediction_text
    again = errors[worst]["max"] > limit
    run.save_pairs()
    run.save_summary({**errors, "limit_deg": limit, "recalibrate": again})
    run.say(f"{words(errors, config.output_unit)}, limit {limit:g}")
    if calibration.noise_std is not None:
        rows = run.model.outputs(config, records) if run.model else pairs(records)
        told = calibration.check(*rows, tolerance=limit)
        run.say(f"the check would detect a drift of {limit:g} (power {told.power:.0%})")
    over = "RECALIBRATE: over session.verify_limit_deg. Run `jaxcal-rig calibrate`"
    run.say(over if again else "the calibration still holds")
    return EXIT_RECALIBRATE if again else EXIT_OK


def telling(
    config: RigConfig, calibration: Any, count: int
) -> list[tuple[Pulses, ...]]:
    """Held-out targets, of many, that show best that the calibration is wrong."""
    offered = draw_held_out(config, calibration, _OFFERED * count)
    if calibration.noise_std is None or len(offered) <= count:
        return offered[:count]
    at = np.array([config.to_deg(target[-1]) for target in offered])
    return [offered[i] for i in calibration.verification(at, count)]
