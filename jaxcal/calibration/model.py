"""The calibration of any model ``y = f(u; theta)``, with a prior and either loss."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.calibration import file, table
from jaxcal.calibration.affine_inverse import limits_of
from jaxcal.calibration.base import Calibration
from jaxcal.calibration.checked import derivative, predict
from jaxcal.calibration.discrepancy import WithDiscrepancy
from jaxcal.calibration.reach import Carry, reach
from jaxcal.checks import in_words
from jaxcal.models import (
    Affine,
    Model,
    Pose,
    Prior,
    SerialChain,
    from_dict,
    identifiability,
)
from jaxcal.models.identifiability import Identifiability

__all__ = ["ModelCalibration"]

Array = NDArray[np.float64]

_SCHEMA = file.Schema(
    version=2,
    shapes={
        "estimate": "P",
        "joint_covariance": "PP",
        "unidentified": "zP",
        "prior_mean": "P",
        "prior_precision": "P",
        "free": "P",
        "commands": "Nn",
        "estimated_commands": "Nn",
        "residuals": "Nm",
        "loss_weights": "N",
        "distance": "N",
        "noise_std": "m",
        "noise_dof": "",
        "dof": "",
        "square": "",
        "frequencies": "nD",
        "phases": "D",
    },
    counts={"num_measurements": 1, "num_readings": 1},
    switches=("noise_known",),
    may_be_null=(
        *("joint_covariance", "unidentified", "estimated_commands", "noise_std"),
        *("frequencies", "phases"),
    ),
    not_negative=(
        *("prior_precision", "free", "loss_weights", "distance", "noise_std"),
        *("noise_dof", "dof", "square"),
    ),
    positive=(),
)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ModelCalibration(Calibration, version=_SCHEMA.version):
    """The most probable parameters; P of them with those of the discrepancy, if any."""

    model: Model
    loss: str  # "student" or "gaussian"
    estimate: Array  # (P,)
    joint_covariance: Array | None  # (P, P); None where the noise is unknown
    unidentified: Array | None  # (z, P) directions that nothing determines
    prior_mean: Array  # (P,)
    prior_precision: Array  # (P,) 0 where nothing was known
    free: Array  # (P,) 0 where held at the prior's mean, else 1
    commands: Array  # (N, n) as given
    estimated_commands: Array | None  # (N, n) where command_std was given
    loss_weights: Array  # (N,) at most 1; small for an outlier, 0 where left out
    distance: Array  # (N,) squared, from the fit without that measurement, in noise
    dof: float  # residual degrees of freedom of all readings, prior counted
    square: float  # sum of the squared residuals in noise
    num_readings: int  # of a measurement, less its unknown commands
    frequencies: Array | None  # (n, D) of the discrepancy
    phases: Array | None  # (D,)

    # -- parameters --------------------------------------------------------------------

    @property
    def parameters(self) -> Array:
        """(p,) of the model."""
        return self.estimate[: len(self.names)]

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """p names."""
        return self.model.names

    @property
    def covariance(self) -> Array | None:
        """(p, p) of ``parameters``, directions that nothing determines held fixed."""
        p = len(self.names)
        return None if self.joint_covariance is None else self.joint_covariance[:p, :p]

    @property
    def standard_errors(self) -> Array | None:
        """(p,); infinite where nothing determines the parameter by itself."""
        errors = super().standard_errors
        if errors is None or self.unidentified is None:
            return errors
        return np.where(self._undetermined, np.inf, errors)

    @property
    def from_data(self) -> Array | None:
        """(p,) share of each parameter's prior variance that the measurements removed.

        0: the value is the prior's; 1: it is the measurements'.
        """
        if self.standard_errors is None:
            return None
        precision = self.prior_precision[: len(self.parameters)]
        errors = np.where(np.isinf(self.standard_errors), 0.0, self.standard_errors)
        share = np.clip(1.0 - errors**2 * precision, 0.0, 1.0)
        return np.where(self._undetermined | (self.free[: len(share)] == 0), 0.0, share)

    def identifiability(self) -> Identifiability:
        """What the measurements alone say of the parameters, at the estimate."""
        here = Prior(np.inf, mean=self.parameters)
        return identifiability(self.model, self.commands, prior=here)

    @property
    def matrix(self) -> Array:
        """(m, n) A of an affine model."""
        if not isinstance(self.model, Affine):
            raise AttributeError("matrix")  # the base class says what it means
        return self.parameters[: -self.num_outputs].reshape(self.num_outputs, -1)

    @property
    def bias(self) -> Array:
        """(m,) b of an affine model."""
        if not isinstance(self.model, Affine):
            raise AttributeError("bias")
        return self.parameters[-self.num_outputs :]

    # -- the fit -----------------------------------------------------------------------

    @property
    def outliers(self) -> dict[int, float]:
        """Rows too far from the fit of the others (1 % in all) and their weights."""
        from scipy import special

        chance = special.chdtrc(self.num_readings, self.distance)
        at = np.flatnonzero(chance < 0.01 / self.num_measurements)
        return {int(i): float(self.loss_weights[i]) for i in at}

    def lack_of_fit(self) -> float | None:
        """p-value of residuals at least this large under the noise that was given.

        Small where the model does not hold, an outlier is among the measurements, or
        the noise stated is too small. None where no noise was given.
        """
        if not self.noise_known or self.dof < 0.5:
            return None
        from scipy import special

        return float(special.chdtrc(self.dof, self.square))

    # -- prediction --------------------------------------------------------------------

    def predict(self, commands: ArrayLike) -> Array:
        """Outputs (..., m) at commands (..., n)."""
        points = self._points("commands", commands, self.num_inputs)
        found = predict(self._whole, self._rows(points), self.estimate)
        return found.reshape(*points.shape[:-1], self.num_outputs)

    def predict_std(
        self, commands: ArrayLike, *, new_measurement: bool = False
    ) -> Array:
        """Standard deviation of ``predict``.

        Args:
            commands: (..., n).
            new_measurement: add the noise of the readings of one more measurement of
                weight 1, for comparison with it.

        Returns:
            (..., m); infinite where it depends on what nothing determines.

        Raises:
            ValueError: the noise is unknown.
        """
        points = self._points("commands", commands, self.num_inputs)
        noise = self._require_noise("prediction uncertainty")
        slopes = derivative(self._whole, self._rows(points), self.estimate)
        covariance = np.asarray(self.joint_covariance)
        variance = ((slopes @ covariance) * slopes).sum(axis=-1)
        std = np.sqrt(np.maximum(variance, 0.0) + float(new_measurement) * noise**2)
        if self.unidentified is not None:
            moved = slopes @ self.unidentified.T
            size = np.abs(slopes) @ np.abs(self.unidentified).T
            std = np.where((np.abs(moved) > 1e-7 * size).any(axis=-1), np.inf, std)
        return std.reshape(*points.shape[:-1], self.num_outputs)

    # -- inside ------------------------------------------------------------------------

    def command_for(
        self,
        desired: ArrayLike,
        limits: ArrayLike | None = None,
        *,
        start: ArrayLike | None = None,
        clip: bool = False,
        max_condition: float = 1e6,
    ) -> Array:
        """Commands that reach desired outputs, by Newton's method from several starts.

        Args:
            desired: (..., m) in the measured unit; m at most n. Where m is less than n
                the command is the one that Newton's method finds near the start. Of an
                arm's pose, position and turn from the nominal orientation at ``start``,
                which then must be given, as ``model.rotation_vectors(start, R)``.
            limits: (n, 2) least and greatest command of each input, if any.
            start: (n,) or (..., n) where the search begins; the measured command whose
                output is nearest when not given.
            clip: where the limits leave no exact command, the one within them whose
                output is nearest, instead of refusing.
            max_condition: greatest condition number of the derivative by the commands,
                in units of their spread and with rows of equal size, that is accepted.

        Returns:
            (..., n) in the command unit.

        Raises:
            ValueError: a desired output is out of reach, or needs a command beyond its
                limits; an output does not respond there; m exceeds n.
        """
        n, m = self.num_inputs, self.num_outputs
        wanted = self._points("desired", desired, m)
        if m > n:
            raise ValueError(
                f"command_for needs at most as many outputs as inputs, got {m} and {n}"
            )
        begin = None
        if start is not None:
            points = self._points("start", start, n)
            begin = np.broadcast_to(points, (*wanted.shape[:-1], n)).reshape(-1, n)
        commands = reach(
            self._whole,
            self.estimate,
            self.commands,
            wanted.reshape(-1, m),
            self.input_names,
            begin=begin,
            bounds=None if limits is None else limits_of(limits, self.input_names),
            clip=clip,
            max_condition=max_condition,
            carry=self._carry(wanted.reshape(-1, m), begin),
        )
        return commands.reshape(*wanted.shape[:-1], n)

    def _carry(self, wanted: Array, start: Array | None) -> Carry | None:
        """Of an arm's pose, whose orientations are relative to the commands."""
        arm = self.model
        if not (isinstance(arm, SerialChain) and isinstance(arm.sensor, Pose)):
            return None
        if start is None:
            raise ValueError(
                "start must be given for an arm's pose: the joints at whose nominal "
                "orientation desired is a turn, as rotation_vectors(start, R) makes it"
            )
        rotations = arm.rotations(start, wanted[:, 3:])

        def carry(commands: Array, rows: NDArray[np.intp]) -> Array:
            turns = arm.rotation_vectors(commands, rotations[rows])
            return np.hstack([wanted[rows, :3], turns])

        return carry

    @property
    def _whole(self) -> Model:
        """The model with its discrepancy."""
        if self.frequencies is None or self.phases is None:
            return self.model
        return WithDiscrepancy(self.model, self.frequencies, self.phases)  # type: ignore[return-value]  # no prior, no file of its own

    @property
    def _undetermined(self) -> NDArray[np.bool_]:
        """(p,) parameters in directions that nothing determines."""
        if self.unidentified is None:
            return np.zeros(len(self.parameters), dtype=np.bool_)
        share = np.abs(self.unidentified)
        share = share > 1e-7 * share.max(axis=1, keepdims=True)
        return np.asarray(share.any(axis=0)[: len(self.parameters)])

    def _rows(self, points: Array) -> Array:
        return points.reshape(-1, self.num_inputs)

    def _no_noise(self, what: str) -> str:
        return (
            f"no {what}: {self.num_measurements} measurements leave {self.dof:.2g} "
            "residual degrees of freedom beside the prior, so the noise is unknown; "
            "measure more or give noise"
        )

    # -- an arm, written back ----------------------------------------------------------

    @property
    def arm(self) -> SerialChain:
        """The arm as calibrated, its parameters nominal, with Position()."""
        return self._chain().calibrated(self.parameters)

    def to_urdf(self, path: str | os.PathLike[str], *, force: bool = False) -> str:
        """See :meth:`jaxcal.models.SerialChain.to_urdf`; returns the tip link."""
        return self._chain().to_urdf(path, self.parameters, force=force)

    def to_dh(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """See :meth:`jaxcal.models.SerialChain.to_dh`."""
        self._chain().to_dh(path, self.parameters, force=force)

    def to_ur_kinematics(
        self, path: str | os.PathLike[str], *, force: bool = False
    ) -> None:
        """See :meth:`jaxcal.models.SerialChain.to_ur_kinematics`."""
        self._chain().to_ur_kinematics(path, self.parameters, force=force)

    def _chain(self) -> SerialChain:
        if not isinstance(self.model, SerialChain):
            raise ValueError(
                f"the model must be an arm, got {type(self.model).__name__}"
            )
        return self.model

    # -- printed, and as a file --------------------------------------------------------

    def summary(self) -> str:
        """The parameters with their 95 % intervals, the noise and the fit, as text."""
        columns = self._columns()
        fixed = int((self.free[: len(self.parameters)] == 0).sum())
        lines = [
            f"Calibration of {type(self.model).__name__}: {self.num_inputs} inputs "
            f"({', '.join(self.input_names)}), {self.num_outputs} outputs "
            f"({', '.join(self.output_names)}), {self.num_measurements} measurements, "
            f"{len(self.parameters)} parameters"
            + (f" ({fixed} fixed)" if fixed else "")
            + (", with discrepancy" if self.phases is not None else "")
            + f", {self.loss} loss"
        ]
        cells = {
            "": columns["parameter"],
            "value": [f"{value: .6g}" for value in columns["value"]],
        }
        if "low" in columns:
            cells["std error"] = [f"{error:.3g}" for error in columns["std_error"]]
            cells["95 % interval"] = [
                f"[{low: .6g}, {high: .6g}]"
                for low, high in zip(columns["low"], columns["high"], strict=True)
            ]
            cells["from data"] = [f"{share:.0%}" for share in columns["from_data"]]
        if any(columns["unit"]):
            cells["unit"] = columns["unit"]
        lines += table.in_lines(cells)
        unit = f" {self.measured_unit}" if self.measured_unit else ""
        size = np.sqrt(np.mean(self.residuals**2, axis=0))
        fit = self.lack_of_fit()
        lines.append(
            f"residuals {in_words(size)}{unit} root mean square, {self.dof:.4g} "
            "degrees of freedom"
            + ("" if fit is None else f"; lack-of-fit p = {fit:.3g}")
        )
        if self.noise_std is None:
            lines.append(self._no_noise("intervals"))
        else:
            source = "as given" if self.noise_known else "from the residuals"
            lines.append(f"noise std {in_words(self.noise_std)}{unit}, {source}")
        if self.unidentified is not None:
            named = [
                name
                for name, lost in zip(self.names, self._undetermined, strict=True)
                if lost
            ]
            lines.append(
                f"not determined, held near the prior's mean: {', '.join(named)}; "
                "see identifiability()"
            )
        for row, weight in self.outliers.items():
            lines.append(
                f"outlier: measurement {row}, {self.distance[row] ** 0.5:.3g} standard "
                f"deviations from the fit of the others, weight {weight:.2g}"
            )
        return "\n".join(lines)

    def _columns(self) -> dict[str, list[Any]]:
        columns: dict[str, list[Any]] = {
            "parameter": list(self.names),
            "value": self.parameters.tolist(),
            "unit": list(getattr(self.model, "units", [""] * len(self.parameters))),
        }
        if self.standard_errors is not None and self.from_data is not None:
            columns["std_error"] = self.standard_errors.tolist()
            columns["low"], columns["high"] = self.confidence_intervals().T.tolist()
            columns["from_data"] = self.from_data.tolist()
        return columns

    def to_dict(self) -> dict[str, Any]:
        """The content of the file: names, numbers and lists, as JSON has them."""
        content = file.content_of(self, _SCHEMA)
        content |= {"model": self.model.to_dict(), "loss": self.loss}
        covariance = self.covariance
        content["derived"] = {
            "parameter_names": list(self.names),
            "parameters": self.parameters.tolist(),
            "covariance": None if covariance is None else covariance.tolist(),
        }
        return content

    @classmethod
    def _fields(cls, content: Mapping[str, Any], model: Model | None) -> dict[str, Any]:
        found = file.fields(content, _SCHEMA)
        for key, kind in (("model", dict), ("loss", str), ("derived", dict)):
            if not isinstance(content.get(key), kind):
                raise ValueError(
                    f'"{key}" must be {"text" if kind is str else "an object"}'
                )
        names = content["derived"].get("parameter_names")
        model = from_dict(content["model"]) if model is None else model
        if list(model.names) != names:
            raise ValueError(
                f"model must have the parameters of the file, {names}, "
                f"got {model.names}"
            )
        sizes = len(found["phases"]) if found["phases"] is not None else 0
        expected = len(names) + sizes * len(found["output_names"])
        if len(found["estimate"]) != expected:
            raise ValueError(f'"estimate" must have shape ({expected},)')
        if (found["noise_std"] is None) != (found["joint_covariance"] is None):
            raise ValueError('"noise_std" and "joint_covariance" contradict each other')
        return found | {"model": model, "loss": content["loss"]}
