"""A calibration's inverse map in the languages of controllers.

C and Structured Text compute the same: a desired posture to commands in degrees and
pulses; beyond the limits as `command_for(..., clip=True)`, with a status of one bit for
each axis that is held at a limit. An input that is not a finite number sets the status
and nothing else. JSON holds the numbers.
"""

from __future__ import annotations

import hashlib
import json
import pathlib
import re
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxcal.reports.page import template
from rig.config.axis import Scale
from rig.config.config import names_of, units_of
from rig.faults import Refused
from rig.journal.run_folder import Record
from rig.outputs.messages import recalibrate
from rig.readings.geometry import Array

NUMBERS = ("matrix", "offset_deg", "min_deg", "max_deg", "pulses_per_deg", "min_pulses",
           "max_pulses")  # fmt: skip
NAME = re.compile("[a-z][a-z0-9_]{0,39}")


def load_inverse(folder: pathlib.Path, records: list[Record]) -> dict[str, Any]:
    """The inverse map of the calibration in a run's folder, and its journal's records;
    Refused where it holds none, or A does not determine a command.

    matrix (n, m) M, the (pseudo-)inverse of A; offset_deg (n,) c = -M b; soft limits
    (n,) in degrees and pulses; pulses_per_deg (n,) signed; forward (m, n + 1) [A | b]
    and half_widths, 95 % of all at once; follow (2 ** n, n, n); device: fingerprint.
    """
    if model := records[0]["config"].get("model"):
        use = "calibrated.urdf in its folder" if model["urdf"] else "calibration.json"
        raise Refused(
            f"{folder}: the inverse map needs an affine device, this device has a "
            f"[model]. Use {use}"
        )
    calibration, matrix, summary = _calibrated(folder)
    config = records[0]["config"]  # of the run, also where it was refitted
    names, outputs = names_of(config)
    axis_unit, output_unit = units_of(config)
    for name in (*names, *outputs):
        if not NAME.fullmatch(name):  # the folder may come from another person
            raise Refused(f"{folder}: {name!r} is not the name of an axis or a reading")
    of_name = {axis["name"]: axis for axis in config["axes"]}
    axes = [of_name[name] for name in names]
    scales = [Scale.of(axis) for axis in axes]
    limits = [
        sorted(scale.to_pulses(axis[end]) for end in ("min_deg", "max_deg"))
        for scale, axis in zip(scales, axes, strict=True)
    ]
    warnings = recalibrate(summary, config["session"]["verify_limit_deg"])
    if summary.get("simulated"):
        warnings.append("made on a simulated rig")
    inverse = {
        "matrix": matrix.tolist(),
        "offset_deg": (-matrix @ np.asarray(calibration.bias)).tolist(),
        "min_deg": [float(axis["min_deg"]) for axis in axes],
        "max_deg": [float(axis["max_deg"]) for axis in axes],
        "pulses_per_deg": [scale.pulses_per_deg for scale in scales],
        "min_pulses": [low for low, _ in limits],
        "max_pulses": [high for _, high in limits],
        "forward": np.column_stack([calibration.matrix, calibration.bias]).tolist(),
        "half_widths": summary["ci95"],
        "follow": follow(calibration.matrix).tolist(),
        "run": folder.resolve().name,
        "created": str(calibration.provenance.get("created", "")),
        "device": calibration.provenance["notes"]["device"],
        "warnings": warnings,
        "axes": names,
        "outputs": outputs,
        "axis_unit": axis_unit,
        "output_unit": output_unit,
    }
    return inverse | {"checksum": checksum(inverse)}


def _calibrated(folder: pathlib.Path) -> tuple[Any, Array, dict[str, Any]]:
    """The calibration in a run's folder, its inverse matrix and its summary."""
    import jaxcal

    try:
        calibration: Any = jaxcal.Calibration.load(folder / "calibration.json")
        matrix = _inverse(np.asarray(calibration.matrix, dtype=np.float64))
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise Refused(
            f"{folder}: no calibration to export: {error}. Give the run of a finished "
            "`jaxcal-rig calibrate`, or its refit"
        ) from None
    return calibration, matrix, summary


def _inverse(matrix: Array) -> Array:
    """(n, m) of (m, n) A: what gives the command whose measurement is nearest;
    ValueError where several give the same."""
    if np.linalg.matrix_rank(matrix) < matrix.shape[1]:
        raise ValueError(
            f"{matrix.shape[0]} measurements do not determine {matrix.shape[1]} "
            "commands: A has no inverse"
        )
    return np.linalg.pinv(matrix).astype(np.float64)


def follow(matrix: Array) -> Array:
    """How free axes follow those that are held at a limit, for the nearest posture.

    The nearest posture |A (u - free)| over the free axes F of u, where the others H are
    given, has (u - free)_F = -pinv(A_F) A_H (u - free)_H. Of (m, n) A of rank n
    (2 ** n, n, n): for the set of held axes with bit 1 << j of each, degrees of a free
    axis i for a degree of a held axis j; else zero.
    """
    count = matrix.shape[1]
    by = np.zeros((2**count, count, count))
    for number, moved in enumerate(by):
        held = (number >> np.arange(count)) & 1 == 1
        if held.any() and not held.all():
            solved = np.linalg.lstsq(matrix[:, ~held], matrix[:, held], rcond=None)[0]
            moved[np.ix_(~held, held)] = -solved
    return by


def checksum(inverse: dict[str, Any]) -> str:
    """SHA-256 of the map's numbers in the order of NUMBERS, each as Python's repr of a
    float, one a line."""
    values = np.concatenate([np.ravel(inverse[name]) for name in NUMBERS])
    text = "\n".join(map(repr, values.astype(float).tolist()))
    return hashlib.sha256(text.encode()).hexdigest()


def _origin(inverse: dict[str, Any]) -> list[str]:
    """Where the numbers are from, in lines that are safe in a comment anywhere."""
    lines = [
        f"run {inverse['run']}, calibrated {inverse['created']}",
        f"SHA-256 of the numbers: {inverse['checksum']}",
        "device fingerprint (keys of rig.toml):",
        *(f"  {key} = {json.dumps(value)}" for key, value in inverse["device"].items()),
        *(f"WARNING: {text}" for text in inverse["warnings"]),
    ]
    return [*map(_comment, lines)]


def _comment(text: str) -> str:
    """A text as one line that ends no comment, and begins none, in any language."""
    kept = "".join(c if " " <= c <= "~" else "?" for c in text)
    return kept.replace("*", "#").replace("\\", "/").replace("//", "/ /")


def _code(name: str, inverse: dict[str, Any]) -> str:
    """A program: a template beside this file, with the numbers put in."""
    path = pathlib.Path(__file__).with_name(name)

    def reals(values: Any) -> str:
        return ", ".join(map(_real, np.ravel(values).tolist()))

    program = template(path, c=_c, real=_real, reals=reals)
    bits = ", ".join(str(1 << i) for i in range(len(inverse["axes"])))
    told = {unit: _comment(inverse[unit]) for unit in ("axis_unit", "output_unit")}
    return str(program.render(**inverse | told, bits=bits, origin=_origin(inverse)))


def _c(value: Any) -> str:
    if isinstance(value, list):
        return "{" + ", ".join(map(_c, value)) + "}"
    return "(-2147483647 - 1)" if value == -(2**31) else repr(value)


def _real(value: float) -> str:
    """1e-07 with the point that Structured Text wants: 1.0e-07."""
    mantissa, e, exponent = repr(float(value)).partition("e")
    return mantissa + ".0" * ("." not in mantissa) + e + exponent


LANGUAGES: dict[str, Callable[[dict[str, Any]], str]] = {
    "c": lambda inverse: _code("calibration.h.j2", inverse),  # C99
    "st": lambda inverse: _code("calibration.st.j2", inverse),  # IEC 61131-3
    "json": lambda inverse: (
        json.dumps({"format": "jaxcal-inverse", "schema": 1, **inverse}, indent=1)
        + "\n"
    ),
}
