"""``Calibration``: a fit with its inverse, checks, summary and file."""

from __future__ import annotations

import functools
import os
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal.calibration import file
from jaxcal.calibration.file import save, to_dict
from jaxcal.calibration.fit import Fit
from jaxcal.calibration.inverse import command_for
from jaxcal.calibration.verdict import Verdict, verdict
from jaxcal.checks import aligned, in_words
from jaxcal.files import AnyPath
from jaxcal.late import late
from jaxcal.models.model import Model

if TYPE_CHECKING:
    from jaxcal.calibration.pairing import Mispairing


class Calibration(Fit):
    """The map ``y = f(u; theta)`` from n inputs to m outputs that ``identify`` returns;
    ``print`` shows its p parameters with their intervals. See ``Fit`` for its fields.
    """

    def __repr__(self) -> str:
        return self.summary()

    command_for = command_for
    inverse = late("jaxcal.calibration.of_readings:inverse")
    check = late("jaxcal.calibration.check:check")
    budget = late("jaxcal.reports.budget:budget")
    report = late("jaxcal.reports.calibration:report")
    plot = late("jaxcal.reports.shown:plot_calibration")
    _repr_html_ = late("jaxcal.reports.shown:as_html")
    verification = late("jaxcal.calibration.check:verification")
    to_dict = to_dict
    save = save

    def summary(self) -> str:
        """The parameters with their 95 % intervals, the noise and the fit, as text."""
        fixed = int((self.free[: len(self.parameters)] == 0).sum())
        lines = [
            f"Calibration {self.model.title}: "
            f"{self.num_inputs} input{'s' * (self.num_inputs > 1)} "
            f"({', '.join(self.input_names)}), "
            f"{self.num_outputs} output{'s' * (self.num_outputs > 1)} "
            f"({', '.join(self.output_names)}), {self.num_measurements} measurements, "
            f"{len(self.parameters)} parameters"
            + (f" ({fixed} fixed)" if fixed else "")
            + f", {self.loss} loss"
        ]
        lines += [f"  {line}" for line in aligned(self._parameter_rows(), "<")]
        unit = f" {self.measured_unit}".rstrip()
        size = np.sqrt(np.mean(self.residuals**2, axis=0))
        lack = self.lack_of_fit()
        lines.append(
            f"residuals {in_words(size)}{unit} root mean square, {self.dof:.4g} "
            "degrees of freedom"
            + ("" if lack is None else f"; lack-of-fit p = {lack:.3g}")
        )
        if self.noise_std is not None:
            source = "as given" if self.noise_known else "from the residuals"
            if shared := self.provenance.get("noise_levels"):
                source += f": {shared}"
            lines.append(f"noise std {in_words(self.noise_std)}{unit}, {source}")
            if self.dof < 0.5:
                lines.append("noise not checked: no residual degrees of freedom")
        return "\n".join([*lines, str(self.verdict)])

    def _parameter_rows(self) -> list[tuple[str, ...]]:
        """Cells of the summary's table, its head first: a row for each parameter."""
        cells = {"": list(self.names)}
        if means := self.model.meanings(self.input_names, self.output_names):
            cells["meaning"] = means
        cells["value"] = [f"{value: .6g}" for value in self.parameters]
        errors, shares = self.standard_errors, self.from_data
        if errors is not None and shares is not None:
            cells["std error"] = [f"{error:.3g}" for error in errors]
            ends = self.confidence_intervals()
            cells["95 % interval"] = [
                f"[{low: .6g}, {high: .6g}]" for low, high in ends
            ]
            if self.prior_precision.any() or self.unidentified is not None:
                cells["from data"] = [f"{share:.0%}" for share in shares]
        units = self.model.fitting.units_for(self.command_unit, self.measured_unit)
        if any(units):
            cells["unit"] = list(units)
        table = [[name, *column] for name, column in cells.items()]
        return [*zip(*table, strict=True)]

    # -- can it be trusted -------------------------------------------------------------

    @functools.cached_property
    def verdict(self) -> Verdict:
        """Whether the calibration may be used, why not, and what to do next; of an arm
        with cross-validated errors."""
        from jaxcal.calibration.pairing import against

        own = self.model.fitting.verdict(self) or verdict(self)
        return against(own, self, self.mispairing)

    @functools.cached_property
    def mispairing(self) -> Mispairing | None:
        """How readings and commands were mispaired; None: not, or it cannot be decided.

        ``repaired(commands, measured)`` of it returns the rows that belong together.
        """
        from jaxcal.calibration.pairing import mispairing

        return mispairing(self)

    # -- from a file -------------------------------------------------------------------

    @classmethod
    def load(cls, path: AnyPath, *, model: Model | None = None) -> Calibration:
        """Read a file that ``save`` wrote; ``model`` is needed if it contains a
        function, which files cannot hold. A ValueError names file and key."""
        content = file.read(path)
        try:
            return cls.from_dict(content, model=model)
        except ValueError as error:
            raise ValueError(f"{os.fspath(path)}: {error}") from None

    @classmethod
    def from_dict(cls, content: Any, *, model: Model | None = None) -> Calibration:
        """The inverse of ``to_dict``; a ValueError names the key that is wrong."""
        fields = file.fields(content, model)
        kind: Any = fields["model"].fitting.result_type or cls
        return kind(**fields)
