"""An affine calibration as a table."""

from __future__ import annotations

from typing import Any

from jaxcal.calibration.affine import AffineFit
from jaxcal.calibration.table import in_lines
from jaxcal.checks import in_words

__all__ = ["columns", "summary"]


def summary(self: AffineFit) -> str:
    """A and b with their 95 % intervals, the noise and the fit, in a table of text."""
    unit = f" {self.measured_unit}" if self.measured_unit else ""
    n, m = self.num_inputs, self.num_outputs
    lines = [
        f"Calibration y = A u + b: {n} inputs ({', '.join(self.input_names)}), "
        f"{m} outputs ({', '.join(self.output_names)}), "
        f"{self.num_measurements} measurements"
    ]
    table = columns(self)
    cells = {
        "": table["parameter"],
        "meaning": [
            f"{y} per {u}" if u else f"{y} at u = 0"
            for y, u in zip(table["output"], table["input"], strict=True)
        ],
        "value": [f"{value: .6g}" for value in table["value"]],
    }
    if "low" in table:
        cells["95 % interval"] = [
            f"[{low: .6g}, {high: .6g}]"
            for low, high in zip(table["low"], table["high"], strict=True)
        ]
    if any(table["unit"]):
        cells["unit"] = table["unit"]
    lines += in_lines(cells)
    if self.residual_std is not None:
        fit = self.lack_of_fit()
        lines.append(
            f"residual std {in_words(self.residual_std)}{unit}, {self.dof} degrees of "
            "freedom each" + ("" if fit is None else f"; lack-of-fit p = {fit:.3g}")
        )
    if self.noise_std is None:
        lines.append(self._no_noise("intervals"))
    else:
        source = "as given" if self.noise_known else "from the residuals"
        lines.append(f"noise std {in_words(self.noise_std)}{unit}, {source}")
        if self.residual_std is None:
            lines.append("no residual degree of freedom: the noise cannot be checked")
    lines.append(f"condition number {self.condition_number:.4g}")
    return "\n".join(lines)


def columns(fit: AffineFit) -> dict[str, list[Any]]:
    """parameter, output, input ("" for b), value, unit; where known also std_error,
    low and high: m (n + 1) entries each."""
    m, n = fit.num_outputs, fit.num_inputs
    per = f"/{fit.command_unit}" if fit.command_unit else ""
    slope_unit = (fit.measured_unit or "1") + per if per else fit.measured_unit
    columns: dict[str, list[Any]] = {
        "parameter": list(fit.parameter_names),
        "output": [y for y in fit.output_names for _ in range(n)] + [*fit.output_names],
        "input": [*fit.input_names] * m + [""] * m,
        "value": fit.parameters.tolist(),
        "unit": [slope_unit] * (m * n) + [fit.measured_unit] * m,
    }
    if fit.standard_errors is not None:
        columns["std_error"] = fit.standard_errors.tolist()
        columns["low"], columns["high"] = fit.confidence_intervals().T.tolist()
    return columns
