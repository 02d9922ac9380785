"""``Calibration``: a fit with its inverse, checks, summary and file."""

from __future__ import annotations

import dataclasses
import functools
import os
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from jaxcal.calibration import file
from jaxcal.calibration.file import save, to_dict
from jaxcal.calibration.fit import Fit
from jaxcal.calibration.fit_model import fit_model
from jaxcal.calibration.inverse import command_for, no_inverse
from jaxcal.calibration.verdict import Verdict, verdict
from jaxcal.checks import Array, aligned, in_words
from jaxcal.late import late
from jaxcal.models.model import Model
from jaxcal.models.uncertainty import Noise, Prior

if TYPE_CHECKING:
    from jaxcal.calibration.pairing import Mispairing

Path = str | os.PathLike[str]


class Calibration(Fit):
    """The identified map from commands u (n inputs) to outputs y (m of them).

    ``y = f(u; theta)`` with the most probable p parameters; ``print`` shows them with
    their intervals. ``identify`` returns it; see ``Fit`` for its fields.
    """

    def __repr__(self) -> str:
        return self.summary()

    command_for = command_for
    inverse = late("jaxcal.calibration.of_readings:inverse")
    no_inverse = no_inverse
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
        lines += str(self.verdict).splitlines()
        return "\n".join(lines)

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
        units = self.model.units_for(self.command_unit, self.measured_unit)
        if any(units):
            cells["unit"] = list(units)
        table = [[name, *column] for name, column in cells.items()]
        return [*zip(*table, strict=True)]

    # -- can it be trusted -------------------------------------------------------------

    @functools.cached_property
    def verdict(self) -> Verdict:
        """Whether the calibration may be used, why not, and what to do next; of an arm
        with cross-validated errors. The summary, ``report``, exit codes and the warning
        of ``identify`` use it."""
        from jaxcal.calibration.pairing import against

        own = self.model.verdict(self) or verdict(self)
        return against(own, self, self.mispairing)

    @functools.cached_property
    def mispairing(self) -> Mispairing | None:
        """How readings and commands were mispaired; None: not, or it cannot be decided.

        ``repaired(commands, measured)`` of it returns the rows that belong together.
        """
        from jaxcal.calibration.pairing import mispairing

        return mispairing(self)

    def of(self, tip: str) -> Calibration:
        """The calibration of one of several chains (``jaxcal.models.Chains``), as of an
        arm of its own, its readings in its own unit."""
        return dataclasses.replace(self, **self.model.of_chain(self, tip))

    # -- an arm, written back ----------------------------------------------------------

    @property
    def arm(self) -> Any:
        """The arm as calibrated, its parameters nominal, with Position()."""
        return self.whole.calibrated(self.estimate)

    def to_urdf(self, path: Path, *, force: bool = False) -> str:
        """Write the arm's own file, corrected; returns the tip link.

        Files cannot hold compliance and gear harmonics. Without compliance the arm is
        moved as a whole so that its tip agrees best with the calibration's over its
        range; without harmonics only, the rest is fitted again. A warning says by how
        much they differ.
        """
        return self.model.write("urdf", path, self._for_file(), force=force)

    static_transform = late("jaxcal.arms.transforms:static_transform")
    to_transform = late("jaxcal.arms.transforms:to_transform")

    def to_dh(self, path: Path, *, force: bool = False) -> None:
        """Write the DH table as CSV, corrected as ``to_urdf`` says."""
        self.model.write("dh", path, self._for_file(), force=force)

    def to_ur_kinematics(self, path: Path, *, force: bool = False) -> None:
        """Write Universal Robots' kinematics file, corrected as ``to_urdf`` says."""
        self.model.write("ur", path, self._for_file(), force=force)

    def to_lerobot(
        self,
        path: Path,
        servos: Path,
        *,
        names: Mapping[str, str] | None = None,
        force: bool = False,
    ) -> dict[str, int]:
        """Write LeRobot's calibration file of a servo arm with corrected zeros.

        The readings are fitted again by zeros of the joints only, as in such a file; a
        warning gives the error. See ``jaxcal.models.Servos``. Do not also use a
        corrected URDF file: it would apply the zeros twice.

        Args:
            path: the file to write.
            servos: the file that the postures were read with.
            names: motors not named as the joints: {"Rotation": "shoulder_pan"}.
            force: overwrite an existing file.

        Returns:
            Steps by which the middle of each motor's range moved.
        """
        plain: Any = self.model.writable()
        zeros = [name for name in plain.names if name.startswith("theta")]
        tool = [name for name in plain.names if "tool" in name]
        fitted = (*zeros, *plain.sensor.names, *tool)
        prior = plain.default_prior()
        held = tuple(name for name in plain.names if name not in fitted)
        fixed = tuple(dict.fromkeys((*prior.fixed, *held)))
        again = self.again(plain, dataclasses.replace(prior, fixed=fixed))
        steps: dict[str, int] = plain.write_servos(
            path, again.parameters, servos, names or {}, force=force
        )
        if again.noise_std is not None:
            verdict: Any = again.verdict
            warnings.warn(
                "the file corrects the zeros of the joints only: cross-validated error "
                f"{verdict.held_out:.3g}, before calibration {verdict.nominal:.3g}",
                stacklevel=2,
            )
        return steps

    def again(
        self, model: Any, prior: Prior | None, rows: NDArray[np.bool_] | None = None
    ) -> Self:
        """The calibration by another model of the machine and a prior, None: as of
        ``identify``; of the same readings, or of some ``rows`` (N,) of them."""
        used = self.loss_weights > 0.0
        fields = fit_model(
            self.commands,
            self.measured,
            (used if rows is None else used & rows).astype(np.float64),
            model=model,
            prior=prior,
            noise=Noise(std=self.noise_std if self.noise_known else None),
            loss=self.loss,
            common_noise=None,
        )
        ours = ("prior", "noise_levels")
        origin = {k: v for k, v in self.provenance.items() if k not in ours}
        fields["provenance"] = origin | fields["provenance"]
        return dataclasses.replace(self, **fields)

    def _for_file(self) -> Array:
        """(p,) for a file: without what no file holds; a warning gives the effect."""
        plain, parameters = self.model.writable(), np.array(self.parameters)
        held = np.isin(self.names, plain.names)
        if held.all() and not self.estimate[len(self.names) :].any():
            return parameters
        unit = f" {self.measured_unit}" if self.measured_unit else ""
        errors = ""
        if held.all():
            change = "it was fitted without harmonics"
            again = self.again(plain, plain.default_prior())
            parameters = again.parameters
            off = again.outputs_at(self.commands) - self.outputs_at(self.commands)
            if again.noise_std is not None and self.noise_std is not None:
                verdicts: tuple[Any, Any] = again.verdict, self.verdict
                errors = (
                    f"; cross-validated error {verdicts[0].held_out:.3g}{unit}, of the "
                    f"calibration {verdicts[1].held_out:.3g}"
                )
        else:
            change = "the arm in it was moved as a whole"
            parameters = np.where(held, parameters, 0.0)
            parameters = self.model.standing_as(self.arm, parameters, self.commands)
            file = self.model.calibrated(parameters)
            joints = self.commands[:, : file.num_inputs]
            off = file.predict(joints) - self.arm.predict(joints)
        warnings.warn(
            f"the file cannot hold compliance and gear harmonics; {change}: at the "
            "measured postures its predictions differ from the calibration's by "
            f"{np.linalg.norm(off, axis=1).mean():.3g}{unit} on average{errors}",
            stacklevel=3,
        )
        return parameters

    # -- from a file -------------------------------------------------------------------

    @classmethod
    def load(cls, path: Path, *, model: Model | None = None) -> Calibration:
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
        return cls(**file.fields(content, model))
