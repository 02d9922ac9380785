"""The report of a calibration: one page, the files it is of, and ``verdict.json``.

The page is HTML that needs no other file and no network; ``verdict.json`` is what a
pipeline reads.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import pathlib
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.calibration.check import Check
from jaxcal.calibration.fit import Fit
from jaxcal.files import write_text
from jaxcal.models.verdict import left_out
from jaxcal.reports import page as pages
from jaxcal.reports.budget import Budget, Source, budget
from jaxcal.reports.calibration_page import named, nominal_errors, page_of

if TYPE_CHECKING:
    from jaxcal.calibration import Calibration


SCHEMA: dict[str, Any] = json.loads(
    pathlib.Path(__file__).with_name("verdict.schema.json").read_text(encoding="utf-8")
)
"""JSON Schema of ``verdict.json``."""


def moved(calibration: Fit, before: Fit) -> list[dict[str, Any]]:
    """What moved since another calibration of the same parameters.

    Returns:
        For each parameter its name, both values, the difference, and that in standard
        deviations of the difference, None where neither has one.

    Raises:
        ValueError: the parameters are not the same.
    """
    if calibration.names != before.names:
        raise ValueError(
            "before must be a calibration of the same parameters, got "
            f"{len(before.names)} ({', '.join(before.names[:4])}, ...) for "
            f"{len(calibration.names)} ({', '.join(calibration.names[:4])}, ...)"
        )
    variance = np.zeros(len(calibration.names))
    for fit in (calibration, before):
        errors = fit.standard_errors
        variance = variance + (np.inf if errors is None else errors**2)
    difference = calibration.parameters - before.parameters
    with np.errstate(divide="ignore", invalid="ignore"):
        times = difference / np.sqrt(variance)
    sure = np.isfinite(variance) & (variance > 0.0)
    return [
        {
            "name": name,
            "before": float(before.parameters[i]),
            "after": float(calibration.parameters[i]),
            "difference": float(difference[i]),
            "deviations": float(times[i]) if sure[i] else None,
        }
        for i, name in enumerate(calibration.names)
    ]


def report(
    calibration: Calibration,
    folder: str | os.PathLike[str],
    *,
    check: Check | None = None,
    readings: tuple[ArrayLike, ArrayLike] | None = None,
    before: Fit | None = None,
    sources: Sequence[Source] = (),
    at: ArrayLike | None = None,
    files: Sequence[str | os.PathLike[str]] = (),
) -> bool:
    """Write ``index.html``, ``calibration.json`` and ``verdict.json`` into a folder.

    The page has the parameters and predictions with their uncertainty budgets,
    residuals by row and by input, leverage, held-out errors, the errors before and
    after, the model, and the files with their SHA-256.

    Args:
        calibration: what is reported.
        folder: made where missing.
        check: of new readings, from ``calibration.check``; then the verdict is its.
        readings: of the check, (N, n) commands and (N, m) readings, shown in a table.
        before: an earlier calibration of the same parameters, to compare with.
        sources: of uncertainty, as in ``budget``.
        at: (P, n) commands whose predictions get a budget; when not given two that
            were measured, the one nearest to the mean and the least certain one.
        files: that the calibration was made of, listed with their hashes.

    Returns:
        Whether it is good: may be used, or of a check, that it holds.

    Raises:
        MissingExtraError: jinja2 is not installed.
        OSError: the folder cannot be written, or a file not be read.
        ValueError: ``before`` has other parameters.
    """
    content = json.dumps(calibration.to_dict(), indent=1, allow_nan=False) + "\n"
    data = {os.fspath(path): pathlib.Path(path).read_bytes() for path in files}
    data["calibration.json"] = content.encode()
    hashes = {name: hashlib.sha256(of).hexdigest() for name, of in data.items()}
    document = _document(calibration, check) | {"files": hashes}
    budgets: list[Budget] = []
    if calibration.noise_std is not None:
        budgets = [
            budget(calibration, sources=sources),
            _of_predictions(calibration, at, sources),
        ]
        document["budget"] = budgets[0].to_dict()
        document["budget_of_predictions"] = budgets[1].to_dict()
    if before is not None:
        document["moved"] = moved(calibration, before)
    page = page_of(calibration, document, budgets, readings, at)
    written = {
        "calibration.json": content,
        "verdict.json": json.dumps(document, indent=1, allow_nan=False) + "\n",
        "index.html": pages.render(page),  # last: where it stands, all do
    }
    place = pathlib.Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    for name, text in written.items():
        write_text(place / name, text)
    return bool(document["good"])


def _document(calibration: Calibration, check: Check | None) -> dict[str, Any]:
    """What ``verdict.json`` says of a calibration, or of its check."""
    verdict = calibration.verdict
    good, reasons, next_step = verdict.good, verdict.lines(), verdict.next_step
    if check is not None:
        good, reasons, next_step = check.good, check.reasons, check.next_step
    return {
        "format": "jaxcal-verdict",
        "version": 1,
        "of": "identify" if check is None else "check",
        "good": good,
        "exit_code": 0 if good else 1,
        "reasons": list(reasons),
        "next_step": next_step,
        "unit": calibration.measured_unit,
        "numbers": _numbers(calibration, check),
    }


def _of_predictions(
    calibration: Fit, at: ArrayLike | None, sources: Sequence[Source]
) -> Budget:
    """The budget at some commands, which are named by their rows."""
    if at is not None:
        return budget(calibration, at, sources=sources)
    commands = calibration.commands
    spread = commands.std(axis=0)
    off = (commands - commands.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0)
    std = calibration.predict_std(commands) / calibration.require_noise("budget")
    rows = [int((off**2).sum(axis=1).argmin()), int((std**2).sum(axis=1).argmax())]
    names = [
        f"{output} at {row}" for row in rows for output in calibration.output_names
    ]
    of_rows = budget(calibration, commands[rows], sources=sources)
    return dataclasses.replace(of_rows, names=tuple(names))


def _numbers(calibration: Fit, check: Check | None) -> dict[str, Any]:
    numbers: dict[str, Any] = {
        "measurements": calibration.num_measurements,
        "parameters": len(calibration.names),
        "degrees_of_freedom": float(calibration.dof),
        "lack_of_fit_p": calibration.lack_of_fit(),
    }
    held_out = None if calibration.noise_std is None else left_out(calibration)
    errors = {
        "residual_rms": calibration.residuals,
        "held_out_mean": held_out,
        "nominal_mean": nominal_errors(calibration),
    }
    for name, off in errors.items():
        for in_unit, quantity in named(calibration, name):
            if off is not None and name == "residual_rms":
                square = np.mean(off[:, quantity.columns] ** 2)
                numbers[in_unit] = float(np.sqrt(square))
            elif off is not None:
                numbers[in_unit] = float(quantity.size(off).mean())
    if check is not None:
        numbers |= {
            "check_says": check.says,
            "check_p": check.p_value,
            "check_power": check.power,
        }
        names = (name for name, _ in named(calibration, "check_tolerance"))
        numbers |= zip(names, check.tolerances.values(), strict=False)
    return numbers
