"""A calibration as text: values, intervals, noise, what is wrong."""

from __future__ import annotations

import numpy as np

from jaxcal.calibration.fit import Fit
from jaxcal.calibration.verdict import Verdict
from jaxcal.checks import in_words
from jaxcal.models import Affine

__all__ = ["summary"]


def summary(fit: Fit, verdict: Verdict | None) -> str:
    """The parameters with their 95 % intervals, the noise and the fit, as text."""
    affine = isinstance(fit.model, Affine)
    what = "y = A u + b" if affine else f"of {type(fit.model).__name__}"
    fixed = int((fit.free[: len(fit.parameters)] == 0).sum())
    lines = [
        f"Calibration {what}: {fit.num_inputs} inputs "
        f"({', '.join(fit.input_names)}), {fit.num_outputs} outputs "
        f"({', '.join(fit.output_names)}), {fit.num_measurements} measurements, "
        f"{len(fit.parameters)} parameters"
        + (f" ({fixed} fixed)" if fixed else "")
        + f", {fit.loss} loss"
    ]
    cells = {"": list(fit.names)}
    if affine:
        cells["meaning"] = [
            *(f"{y} per {u}" for y in fit.output_names for u in fit.input_names),
            *(f"{y} at u = 0" for y in fit.output_names),
        ]
    cells["value"] = [f"{value: .6g}" for value in fit.parameters]
    errors, shares = fit.standard_errors, fit.from_data
    if errors is not None and shares is not None:
        cells["std error"] = [f"{error:.3g}" for error in errors]
        ends = fit.confidence_intervals()
        cells["95 % interval"] = [f"[{low: .6g}, {high: .6g}]" for low, high in ends]
        if fit.prior_precision.any() or fit.unidentified is not None:
            cells["from data"] = [f"{share:.0%}" for share in shares]
    if any(units := _units(fit)):
        cells["unit"] = units
    lines += _in_lines(cells)
    unit = f" {fit.measured_unit}" if fit.measured_unit else ""
    size = np.sqrt(np.mean(fit.residuals**2, axis=0))
    lack = fit.lack_of_fit()
    lines.append(
        f"residuals {in_words(size)}{unit} root mean square, {fit.dof:.4g} "
        "degrees of freedom" + ("" if lack is None else f"; lack-of-fit p = {lack:.3g}")
    )
    if fit.noise_std is None:
        lines.append(fit.no_noise("intervals"))
    else:
        source = "as given" if fit.noise_known else "from the residuals"
        lines.append(f"noise std {in_words(fit.noise_std)}{unit}, {source}")
        if fit.dof < 0.5:
            lines.append("no residual degree of freedom: the noise is not checked")
    if verdict is not None:
        lines += str(verdict).splitlines()
    if fit.unidentified is not None:
        named = [
            name for name, lost in zip(fit.names, fit.undetermined, strict=True) if lost
        ]
        lines.append(
            f"not determined, held near the prior's mean: {', '.join(named)}; "
            "see identifiability()"
        )
    for row, weight in fit.outliers.items():
        lines.append(
            f"outlier: measurement {row}, {fit.distance[row] ** 0.5:.3g} standard "
            f"deviations from the fit of the others, weight {weight:.2g}"
        )
    return "\n".join(lines)


def _units(fit: Fit) -> list[str]:
    """p units of the parameters, "" where not known."""
    if not isinstance(fit.model, Affine):
        return list(getattr(fit.model, "units", [""] * len(fit.names)))
    per = f"/{fit.command_unit}" if fit.command_unit else ""
    slope = (fit.measured_unit or "1") + per if per else fit.measured_unit
    m = fit.num_outputs
    return [slope] * (m * fit.num_inputs) + [fit.measured_unit] * m


def _in_lines(columns: dict[str, list[str]]) -> list[str]:
    """A header and a line for each row, columns padded to the same width."""
    widths = [max(map(len, [name, *column])) for name, column in columns.items()]
    lines = []
    for row in [list(columns), *zip(*columns.values(), strict=True)]:
        padded = [f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)]
        lines.append(("  " + "  ".join(padded)).rstrip())
    return lines
