"""The page of a calibration's report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.calibration.fit import Fit
from jaxcal.checks import Array
from jaxcal.extras import needs
from jaxcal.models.model import Quantity
from jaxcal.models.verdict import left_out
from jaxcal.reports import page as pages
from jaxcal.reports.budget import Budget
from jaxcal.tables import COMMANDS, MEASURED

if TYPE_CHECKING:
    from jaxcal.calibration import Calibration


_NAMED = 8  # columns beyond which no name is written


def page_of(
    calibration: Calibration,
    document: Mapping[str, Any],
    budgets: Sequence[Budget],
    readings: tuple[ArrayLike, ArrayLike] | None,
    at: ArrayLike | None,
) -> pages.Page:
    sections = [_verdict_section(calibration, document)]
    if readings is not None:
        sections.append(_new_section(calibration, *readings))
    if "moved" in document:
        sections.append(_moved_section(calibration, document["moved"]))
    sections.append(_parameter_section(calibration, budgets))
    if budgets:
        sections.append(_prediction_section(calibration, budgets[1], at))
    sections += _residual_sections(calibration)
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
    word = "good" if good else "not good"
    if document["of"] == "check":
        word = str(numbers["check_says"])
    units = {
        name: "" if quantity.unit == "length" else quantity.unit
        for of_errors in (
            "residual_rms",
            "held_out_mean",
            "nominal_mean",
            "check_tolerance",
        )
        for name, quantity in named(calibration, of_errors)
    }
    rows = [
        [name.replace("_", " "), f"{_text(value)} {units.get(name, '')}".strip()]
        for name, value in numbers.items()
        if value is not None
    ]
    blocks: list[pages.Block] = [pages.Text(line) for line in document["reasons"]]
    blocks.append(pages.Text(f"Next: {document['next_step']}."))
    blocks.append(pages.Table(("", "value"), rows))
    badge = pages.Badge(word, "good" if good else "bad")
    return pages.Section("Verdict", blocks, "verdict", badge)


def _parameter_section(calibration: Fit, budgets: Sequence[Budget]) -> pages.Section:
    """The parameters with their budget, or without one where no noise is known."""
    blocks: list[pages.Block]
    if budgets:
        rows = budgets[0].rows()
        if units := _units(calibration):
            pairs = zip(rows, ("unit", *units), strict=True)
            rows = [[*row, unit] for row, unit in pairs]
        note = (
            "Standard uncertainties by source (GUM), effective degrees of freedom by "
            "Welch and Satterthwaite, coverage factor k, expanded uncertainty U."
        )
        blocks = [pages.Table(rows[0], rows[1:]), note]
    else:
        cells = zip(calibration.names, calibration.parameters, strict=True)
        blocks = [
            pages.Table(("", "value"), [[name, f"{x:.6g}"] for name, x in cells]),
            pages.Text(calibration.no_noise("intervals"), "warning"),
        ]
    return pages.Section("Parameters", blocks, "parameters")


def _prediction_section(
    calibration: Fit, budget: Budget, at: ArrayLike | None
) -> pages.Section:
    unit = f", {calibration.measured_unit}" if calibration.measured_unit else ""
    text = (
        f"Uncertainty of the true outputs{unit}, without a reading's noise; rows "
        "are counted from 0."
    )
    if at is None:
        text += (
            " The first row is nearest to the middle of the measured ones, the second "
            "is the least certain."
        )
    rows = budget.rows()
    table = pages.Table(rows[0], rows[1:])
    return pages.Section("Predictions", [text, table], "predictions")


def _text(value: Any) -> str:
    return value if isinstance(value, str) else f"{value:.6g}"


def _new_section(
    calibration: Fit, commands: ArrayLike, measured: ArrayLike
) -> pages.Section:
    off = np.asarray(measured, float) - calibration.predict(commands)
    off = calibration.model.wrapped(off, np.asarray(commands, float))
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
    units = calibration.model.units_for(
        calibration.command_unit, calibration.measured_unit
    )
    return units if any(units) else ()


def _moved_section(
    calibration: Fit, rows: Sequence[Mapping[str, Any]]
) -> pages.Section:
    units = dict(zip(calibration.names, _units(calibration), strict=False))
    ordered = sorted(rows, key=lambda row: -abs(row["deviations"] or 0.0))
    cells: list[list[pages.Content]] = []
    for row in ordered:
        times = row["deviations"]
        shown: pages.Content = "-" if times is None else f"{times:+.2f}"
        if times is not None and abs(times) > 3.0:
            shown = pages.Strong(f"{times:+.2f}")
        values = (f"{row[key]:.6g}" for key in ("before", "after", "difference"))
        unit = [units[row["name"]]] if units else []
        cells.append([row["name"], *values, shown, *unit])
    head = ["", "before", "after", "difference", "standard deviations"]
    head += ["unit"] if units else []
    note = "The difference divided by its standard deviation; values beyond 3 in bold."
    return pages.Section("What moved", [pages.Table(head, cells), note], "moved")


def _residual_sections(calibration: Fit) -> list[pages.Section]:
    names, residuals = calibration.output_names, calibration.residuals
    unit = f" ({calibration.measured_unit})" if calibration.measured_unit else ""
    rows = np.arange(len(residuals), dtype=float)
    across = {"row": rows} | dict(
        zip(calibration.input_names, calibration.commands.T, strict=True)
    )
    picture = _scatter(across, residuals, names, f"residual{unit}")
    words = ", ".join(across)
    table = _residual_table(calibration)
    figure = pages.Figure(picture, f"residuals against {words}")
    sections = [pages.Section("Residuals", [figure, table], "residuals")]
    nominal = nominal_errors(calibration)
    if nominal is not None:
        sections.append(_before_and_after(calibration, nominal, unit))
    return sections


def _residual_table(calibration: Fit) -> pages.Table:
    """A row for each measurement: residuals, weight and, if it has one, leverage."""
    names = calibration.output_names
    head = [*(f"residual {name}" for name in names), "weight"]
    columns = [*calibration.residuals.T, calibration.loss_weights]
    if calibration.noise_std is not None:
        head += [
            f"{what} {name}" for what in ("leverage", "held-out") for name in names
        ]
        columns += [*leverage(calibration).T, *left_out(calibration).T]
    return _by_row(head, columns)


def _before_and_after(calibration: Fit, nominal: Array, unit: str) -> pages.Section:
    """The length of each error (N, m), nominal and as fitted, held out if possible."""
    noise_known = calibration.noise_std is not None
    after = left_out(calibration) if noise_known else calibration.residuals
    lengths = np.column_stack(
        [np.linalg.norm(errors, axis=1) for errors in (nominal, after)]
    )
    labels = ("before", "after, held out" if noise_known else "after")
    rows = np.arange(len(lengths), dtype=float)
    picture = _scatter({"row": rows}, lengths, labels, f"error{unit}")
    means = lengths.mean(axis=0)
    text = f"Mean error {means[0]:.3g} before, {means[1]:.3g} {labels[1]}."
    figure = pages.Figure(picture, "errors before and after")
    return pages.Section("Before and after", [figure, text], "before")


def _files_section(calibration: Fit, files: Mapping[str, str]) -> pages.Section:
    rows: list[list[pages.Content]] = [
        [pages.Code(name), pages.Code(digest)] for name, digest in files.items()
    ]
    if data := calibration.provenance.get("data_sha256"):
        rows.append(["the readings, as arrays", pages.Code(str(data))])
    kind = type(calibration.model).__name__
    packages = calibration.provenance.get("packages", {})
    made = ", ".join(f"{name} {version}" for name, version in packages.items())
    return pages.Section(
        "Model and files",
        [
            f"Model {kind}, {calibration.loss} loss. {made}",
            pages.Table(("file", "SHA-256"), rows, numeric=False),
        ],
        "files",
    )


def _scatter(
    across: dict[str, Array], columns: Array, names: Sequence[str], up: str
) -> bytes:
    """An SVG file: the columns (N, s) as dots, a panel for each of ``across`` (N,)."""
    with needs("plots", "a report"):
        from jaxcal.reports.plots.style import BLACK, as_bytes, panels, points
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
    noise = calibration.require_noise("leverage")
    slopes, covariance = calibration.linear(calibration.commands, misfit=False)
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
        return model.wrapped(measured - model.predict(commands), commands)
    inputs = [name.removeprefix(COMMANDS) for name in calibration.input_names]
    outputs = [name.removeprefix(MEASURED) for name in calibration.output_names]
    if {*inputs} != {*outputs} or len(inputs) != len(outputs):
        return None
    return np.asarray(measured - calibration.commands[:, [*map(inputs.index, outputs)]])
