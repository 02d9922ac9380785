"""The report of a calibration: one page, the files it is of, and ``verdict.json``.

The page is HTML that needs no other file and no network; ``verdict.json`` is what a
pipeline reads.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.calibration.check import Check
from jaxcal.calibration.fit import (
    Fit,
    as_points,
    linearised,
    no_noise,
    noise_of,
    outputs_at,
)
from jaxcal.calibration.verdict import left_out
from jaxcal.checks import Array
from jaxcal.extras import needs
from jaxcal.files import AnyPath, write_text
from jaxcal.models.model import Quantity
from jaxcal.reports import page as pages
from jaxcal.reports.budget import Budget, Source, budget, by_row, or_none
from jaxcal.tables import COMMANDS, MEASURED

if TYPE_CHECKING:
    from jaxcal.calibration import Calibration


_NAMED = 8  # columns beyond which no name is written
SCHEMA: dict[str, Any] = json.loads(
    pathlib.Path(__file__).with_name("verdict.schema.json").read_text(encoding="utf-8")
)
"""JSON Schema of ``verdict.json``."""


def moved(calibration: Fit, before: Fit) -> list[dict[str, Any]]:
    """What moved since another calibration of the same parameters: of each its name,
    both values, the difference, and that in standard deviations of the difference, None
    where neither has one."""
    if calibration.names != before.names:
        raise ValueError(
            "before must be a calibration of the same parameters, got "
            f"{len(before.names)} ({', '.join(before.names[:4])}, ...) for "
            f"{len(calibration.names)} ({', '.join(calibration.names[:4])}, ...)"
        )
    errors = [calibration.standard_errors, before.standard_errors]
    variance = sum(np.inf if error is None else error**2 for error in errors)
    difference = calibration.parameters - before.parameters
    with np.errstate(divide="ignore", invalid="ignore"):
        times = difference / np.sqrt(variance)
    return by_row(
        name=calibration.names,
        before=before.parameters.tolist(),
        after=calibration.parameters.tolist(),
        difference=difference.tolist(),
        deviations=or_none(np.where(np.isinf(variance), np.nan, times)),
    )


def report(
    calibration: Calibration,
    folder: AnyPath,
    *,
    check: Check | None = None,
    readings: tuple[ArrayLike, ArrayLike] | None = None,
    before: Fit | None = None,
    sources: Sequence[Source] = (),
    files: Sequence[AnyPath] = (),
) -> bool:
    """Write ``index.html``, ``calibration.json`` and ``verdict.json`` into a folder.

    Args:
        folder: made where missing.
        check: of new readings, from ``calibration.check``; then the verdict is its.
        readings: of the check, (N, n) commands and (N, m) readings, shown in a table.
        before: an earlier calibration of the same parameters, to compare with.
        sources: of uncertainty, as in ``budget``.
        files: that the calibration was made of, listed with their hashes.

    Returns:
        Whether it is good: may be used, or of a check, that it holds.
    """
    content = json.dumps(calibration.to_dict(), indent=1, allow_nan=False) + "\n"
    data = {os.fspath(path): pathlib.Path(path).read_bytes() for path in files}
    data["calibration.json"] = content.encode()
    hashes = {name: hashlib.sha256(of).hexdigest() for name, of in data.items()}
    document = _document(calibration, check) | {"files": hashes}
    budgets: dict[str, Budget] = {}
    if calibration.noise_std is not None:
        budgets["budget"] = budget(calibration, sources=sources)
        budgets["budget_of_predictions"] = _of_predictions(calibration, sources)
        document |= {key: table.to_dict() for key, table in budgets.items()}
    if before is not None:
        document["moved"] = moved(calibration, before)
    page = _page_of(calibration, document, [*budgets.values()], readings)
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
    verdict = check or calibration.verdict
    lines = check.reasons if check else calibration.verdict.lines()
    return {
        "format": "jaxcal-verdict",
        "version": 1,
        "of": "check" if check else "identify",
        "good": verdict.good,
        "exit_code": 0 if verdict.good else 1,
        "reasons": list(lines),
        "next_step": verdict.next_step,
        "unit": calibration.measured_unit,
        "numbers": _numbers(calibration, check),
    }


def _of_predictions(calibration: Fit, sources: Sequence[Source]) -> Budget:
    """The budget at two measured commands, which are named by their rows: the one
    nearest to the mean, and the least certain one."""
    commands = calibration.commands
    spread = commands.std(axis=0)
    off = (commands - commands.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0)
    std = calibration.predict_std(commands) / noise_of(calibration, "budget")
    rows = [int((off**2).sum(axis=1).argmin()), int((std**2).sum(axis=1).argmax())]
    outputs = calibration.output_names
    names = tuple(f"{output} at {row}" for row in rows for output in outputs)
    of_rows = budget(calibration, commands[rows], sources=sources)
    return dataclasses.replace(of_rows, names=names)


def _numbers(calibration: Calibration, check: Check | None) -> dict[str, Any]:
    numbers: dict[str, Any] = {
        "measurements": calibration.num_measurements,
        "parameters": len(calibration.names),
        "degrees_of_freedom": float(calibration.dof),
        "lack_of_fit_p": calibration.lack_of_fit(),
    }
    held_out = None if calibration.noise_std is None else left_out(calibration)
    off = calibration.residuals
    for name, quantity in named(calibration, "residual_rms"):
        numbers[name] = float(np.sqrt(np.mean(off[:, quantity.columns] ** 2)))
    errors = {"held_out_mean": held_out, "nominal_mean": nominal_errors(calibration)}
    for kind, of_rows in errors.items():
        for name, quantity in named(calibration, kind):
            if of_rows is not None:
                numbers[name] = float(quantity.size(of_rows).mean())
    if check is not None:
        numbers["check_says"] = check.says
        numbers |= {"check_p": check.p_value, "check_power": check.power}
        names = (name for name, _ in named(calibration, "check_tolerance"))
        numbers |= zip(names, check.tolerances.values(), strict=False)
    return numbers


# -- the page --------------------------------------------------------------------------


def _page_of(
    calibration: Calibration,
    document: Mapping[str, Any],
    budgets: Sequence[Budget],
    readings: tuple[ArrayLike, ArrayLike] | None,
) -> pages.Page:
    sections = [_verdict_section(calibration, document)]
    if readings is not None:
        sections.append(_new_section(calibration, *readings))
    if "moved" in document:
        sections.append(_moved_section(calibration, document["moved"]))
    sections.append(_parameter_section(calibration, budgets))
    if budgets:
        sections.append(_prediction_section(calibration, budgets[1]))
    sections.append(_residual_section(calibration))
    sections.append(_files_section(calibration, document["files"]))
    made = calibration.provenance.get("created", "")
    return pages.Page(
        "Check of a calibration" if document["of"] == "check" else "Calibration",
        sections,
        intro=[calibration.summary().splitlines()[0], pages.Text(str(made), "note")],
        contents=True,
        footer=[pages.Text("verdict.json has the same numbers", "note")],
    )


def _verdict_section(calibration: Fit, document: Mapping[str, Any]) -> pages.Section:
    good, numbers = document["good"], document["numbers"]
    word = numbers.get("check_says", "good" if good else "not good")
    sizes = "residual_rms", "held_out_mean", "nominal_mean", "check_tolerance"
    all_named = itertools.chain.from_iterable(named(calibration, n) for n in sizes)
    units = {name: q.unit for name, q in all_named if q.unit != "length"}
    rows = [
        [name.replace("_", " "), f"{_text(value)} {units.get(name, '')}".strip()]
        for name, value in numbers.items()
        if value is not None
    ]
    lines = [*document["reasons"], f"Next: {document['next_step']}."]
    badge = pages.Badge(word, "good" if good else "bad")
    table = pages.Table(("", "value"), rows)
    return pages.Section("Verdict", [*lines, table], "verdict", badge)


def _parameter_section(calibration: Fit, budgets: Sequence[Budget]) -> pages.Section:
    """The parameters with their budget, or without one where no noise is known."""
    note: pages.Block
    if budgets:
        rows = budgets[0].rows()
        if units := _units(calibration):
            pairs = zip(rows, ("unit", *units), strict=True)
            rows = [[*row, unit] for row, unit in pairs]
        note = (
            "Standard uncertainties by source (GUM), effective degrees of freedom by "
            "Welch and Satterthwaite, coverage factor k, expanded uncertainty U."
        )
    else:
        cells = zip(calibration.names, calibration.parameters, strict=True)
        rows = [["", "value"], *([name, f"{x:.6g}"] for name, x in cells)]
        note = pages.Text(no_noise(calibration, "intervals"), "warning")
    table = pages.Table(rows[0], rows[1:])
    return pages.Section("Parameters", [table, note], "parameters")


def _prediction_section(calibration: Fit, budget: Budget) -> pages.Section:
    unit = f", {calibration.measured_unit}" if calibration.measured_unit else ""
    text = (
        f"Uncertainty of the true outputs{unit}, without a reading's noise; rows are "
        "counted from 0. The first row is nearest to the middle of the measured ones, "
        "the second is the least certain."
    )
    head, *rows = budget.rows()
    return pages.Section("Predictions", [text, pages.Table(head, rows)], "predictions")


def _text(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:.6g}"


def _new_section(
    calibration: Fit, commands: ArrayLike, measured: ArrayLike
) -> pages.Section:
    commands = as_points(calibration, "commands", commands, calibration.num_inputs)
    off = as_points(calibration, "measured", measured, calibration.num_outputs)
    off = off - outputs_at(calibration, commands)
    off = calibration.model.fitting.wrapped(off, commands)
    std = calibration.predict_std(commands, new_measurement=True)
    kinds = ("off", "off in standard deviations")
    head = [f"{name} {kind}" for kind in kinds for name in calibration.output_names]
    table = _by_row(head, [*off.T, *(off / std).T])
    text = "Measured minus predicted, and in what noise and calibration explain."
    return pages.Section("New readings", [text, table], "new")


def _by_row(head: Sequence[str], columns: Sequence[Array]) -> pages.Table:
    """A row for each measurement, of columns (N,)."""
    rows = enumerate(zip(*columns, strict=True))
    cells = [[str(i), *(f"{value:.3g}" for value in row)] for i, row in rows]
    return pages.Table(["row", *head], cells)


def _units(calibration: Fit) -> tuple[str, ...]:
    """(p,) of the parameters; empty where none is known."""
    units = calibration.model.fitting.units_for(
        calibration.command_unit, calibration.measured_unit
    )
    return units if any(units) else ()


def _moved_section(
    calibration: Fit, rows: Sequence[Mapping[str, Any]]
) -> pages.Section:
    units = dict(zip(calibration.names, _units(calibration), strict=False))
    cells = []
    for row in sorted(rows, key=lambda row: -abs(row["deviations"] or 0.0)):
        times = row["deviations"]
        shown = "-" if times is None else f"{times:+.2f}"
        values = (f"{row[key]:.6g}" for key in ("before", "after", "difference"))
        unit = [units[row["name"]]] if units else []
        cells.append([row["name"], *values, shown, *unit])
    head = ["", "before", "after", "difference", "standard deviations"]
    head += ["unit"] if units else []
    note = "The difference divided by its standard deviation, the largest first."
    return pages.Section("What moved", [pages.Table(head, cells), note], "moved")


def _residual_section(calibration: Calibration) -> pages.Section:
    """A picture, and a row for each measurement: residuals, weight and, if the noise is
    known, leverage and error held out."""
    names, residuals = calibration.output_names, calibration.residuals
    unit = f" ({calibration.measured_unit})" if calibration.measured_unit else ""
    inputs = zip(calibration.input_names, calibration.commands.T, strict=True)
    across = {"row": np.arange(len(residuals), dtype=float)} | dict(inputs)
    picture = _scatter(across, residuals, names, f"residual{unit}")
    figure = pages.Figure(picture, f"residuals against {', '.join(across)}")
    head = [*(f"residual {name}" for name in names), "weight"]
    columns = [*residuals.T, calibration.loss_weights]
    if calibration.noise_std is not None:
        kinds = {"leverage": leverage(calibration), "held-out": left_out(calibration)}
        head += [f"{kind} {name}" for kind in kinds for name in names]
        columns += [*np.hstack([*kinds.values()]).T]
    return pages.Section("Residuals", [figure, _by_row(head, columns)], "residuals")


def _files_section(calibration: Fit, files: Mapping[str, str]) -> pages.Section:
    rows: list[list[pages.Content]] = [
        [pages.Code(name), pages.Code(digest)] for name, digest in files.items()
    ]
    if data := calibration.provenance.get("data_sha256"):
        rows.append(["the readings, as arrays", pages.Code(str(data))])
    kind = type(calibration.model).__name__
    packages = calibration.provenance.get("packages", {})
    made = ", ".join(f"{name} {version}" for name, version in packages.items())
    text = f"Model {kind}, {calibration.loss} loss. {made}"
    table = pages.Table(("file", "SHA-256"), rows, numeric=False)
    return pages.Section("Model and files", [text, table], "files")


def _scatter(
    across: dict[str, Array], columns: Array, names: Sequence[str], up: str
) -> bytes:
    """An SVG file: the columns (N, s) as dots, a panel for each of ``across`` (N,)."""
    with needs("plots", "a report"):
        from jaxcal.reports.plots import BLACK, as_bytes, panels, points
    shape = (-(-len(across) // 2), min(len(across), 2))
    figure, axes = panels((8.0, 2.6 * shape[0]), "", shape, sharey=True, squeeze=False)
    for panel, (name, x) in zip(axes.flat, across.items(), strict=False):
        panel.axhline(0.0, color=BLACK, linewidth=0.8)
        for i, column in enumerate(columns.T):
            panel.plot(x, column, label=names[i], **points(i))
        panel.set_xlabel(name)
    for panel in axes.flat[len(across) :]:
        panel.set_visible(False)
    figure.supylabel(up)
    if len(names) <= _NAMED:
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper left", ncols=4, frameon=False)
    return as_bytes(figure, "svg")


def leverage(calibration: Fit) -> Array:
    """(N, m) in [0, 1], how far each reading determines its own prediction."""
    noise = noise_of(calibration, "leverage")
    slopes, covariance = linearised(calibration, calibration.commands, misfit=False)
    spread = ((slopes @ covariance) * slopes).sum(axis=-1)
    return np.asarray(spread / np.where(noise > 0.0, noise, np.inf) ** 2)


def named(calibration: Fit, name: str) -> list[tuple[str, Quantity]]:
    """Names of a number in each unit of the readings, the first without one."""
    quantities = calibration.model.quantities(calibration.measured_unit)
    return [(f"{name}_{q.unit}" if i else name, q) for i, q in enumerate(quantities)]


def nominal_errors(calibration: Fit) -> Array | None:
    """(N, m) errors before calibration: of the nominal machine, or of the commands.

    None of an affine machine whose outputs are not named as its inputs.
    """
    measured = calibration.measured
    if calibration.affine is None:
        model, commands = calibration.model, calibration.commands
        return model.fitting.wrapped(measured - model.predict(commands), commands)
    inputs = [name.removeprefix(COMMANDS) for name in calibration.input_names]
    outputs = [name.removeprefix(MEASURED) for name in calibration.output_names]
    if {*inputs} != {*outputs} or len(inputs) != len(outputs):
        return None
    return np.asarray(measured - calibration.commands[:, [*map(inputs.index, outputs)]])
