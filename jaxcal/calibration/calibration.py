"""``Calibration``: the identified map, its uncertainty, its inverse and its file."""

from __future__ import annotations

import copy
import dataclasses
import functools
import importlib
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.calibration import file
from jaxcal.calibration.check import Check, check, verification
from jaxcal.calibration.discrepancy import WithDiscrepancy
from jaxcal.calibration.inverse import Carry, limits_of, reach, solve_affine
from jaxcal.calibration.verdict import Verdict, verdict
from jaxcal.checks import in_words, numbers
from jaxcal.models import (
    Affine,
    Model,
    Pose,
    Prior,
    SerialChain,
    from_dict,
    identifiability,
)
from jaxcal.models.checked import derivative, predict
from jaxcal.models.identifiability import Identifiability

__all__ = ["Calibration"]

Array = NDArray[np.float64]

_SCHEMA = file.Schema(
    shapes={
        "estimate": "P",
        "joint_covariance": "PP",
        "centre": "n",
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
        *("joint_covariance", "centre", "unidentified", "estimated_commands"),
        *("noise_std", "frequencies", "phases"),
    ),
    not_negative=(
        *("prior_precision", "free", "loss_weights", "distance", "noise_std"),
        *("noise_dof", "dof", "square"),
    ),
    positive=(),
)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Calibration:
    """The identified map from commands u (n inputs) to outputs y (m of them).

    ``y = f(u; theta)`` with the most probable p parameters; P of them with those of the
    discrepancy, if any. ``identify`` fills it, in closed form where the model is affine
    and nothing else is asked for. Arrays are copied and frozen on entry.
    """

    residuals: Array  # (N, m) measured less predicted, measured unit
    noise_std: Array | None  # (m,) at weight 1, behind every uncertainty
    noise_known: bool  # True: noise_std was given; False: it comes from the residuals
    noise_dof: float  # degrees of freedom of the noise estimated, 0 where known
    num_measurements: int  # of positive weight
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    command_unit: str  # "" where not stated
    measured_unit: str
    provenance: Mapping[str, Any]  # created, packages, data_sha256, notes
    model: Model
    loss: str  # "student" or "gaussian"
    estimate: Array  # (P,)
    joint_covariance: Array | None  # (P, P); None where the noise is unknown
    centre: Array | None  # (n,) of the affine closed form: with b the outputs there
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

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value = np.array(value)
                value.setflags(write=False)
                object.__setattr__(self, field.name, value)
        object.__setattr__(self, "provenance", copy.deepcopy(self.provenance))

    def __repr__(self) -> str:
        return self.summary()

    # -- parameters --------------------------------------------------------------------

    @property
    def num_inputs(self) -> int:
        """n."""
        return len(self.input_names)

    @property
    def num_outputs(self) -> int:
        """m."""
        return len(self.output_names)

    @property
    def parameters(self) -> Array:
        """(p,) of the model."""
        return self.estimate[: len(self.model.names)]

    @property
    def names(self) -> tuple[str, ...]:
        """p names of the parameters."""
        return self.model.names

    @property
    def covariance(self) -> Array | None:
        """(p, p) of ``parameters``, directions that nothing determines held fixed.

        None where the noise is unknown.
        """
        if self.joint_covariance is None:
            return None
        p, n, m = len(self.names), self.num_inputs, self.num_outputs
        if self.centre is None:
            return self.joint_covariance[:p, :p]
        # b = (the outputs at the centre) - A centre
        to_bias = np.eye(p)
        to_bias[m * n :, : m * n] = -np.kron(np.eye(m), self.centre)
        return to_bias @ self.joint_covariance @ to_bias.T

    @property
    def standard_errors(self) -> Array | None:
        """(p,); infinite where nothing determines the parameter; None as above."""
        covariance = self.covariance
        if covariance is None:
            return None
        return np.where(self._undetermined, np.inf, np.sqrt(np.diag(covariance)))

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
        self._require_affine("matrix")
        return self.parameters[: -self.num_outputs].reshape(self.num_outputs, -1)

    @property
    def bias(self) -> Array:
        """(m,) b of an affine model."""
        self._require_affine("bias")
        return self.parameters[-self.num_outputs :]

    def confidence_intervals(self, confidence: float = 0.95) -> Array:
        """(p, 2) lower and upper end for each parameter, one at a time.

        Student's t where the noise was estimated, the normal where it was given.

        Args:
            confidence: probability in (0, 1).

        Raises:
            ValueError: the noise is unknown, or ``confidence`` is not in (0, 1).
        """
        self._require_noise("confidence intervals")
        half = self._quantile(confidence) * np.asarray(self.standard_errors)
        return np.stack([self.parameters - half, self.parameters + half], axis=-1)

    def predict_interval(
        self,
        commands: ArrayLike,
        confidence: float = 0.95,
        *,
        new_measurement: bool = False,
    ) -> tuple[Array, Array]:
        """Lower and upper end, (..., m) each; arguments as for ``predict_std``."""
        centre = self.predict(commands)
        half = self._quantile(confidence) * self.predict_std(
            commands, new_measurement=new_measurement
        )
        return centre - half, centre + half

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
        rows = self._rows(points)
        if self.centre is not None:
            rows = rows - self.centre
        slopes = derivative(self._whole, rows, self.estimate)
        covariance = np.asarray(self.joint_covariance)
        variance = ((slopes @ covariance) * slopes).sum(axis=-1)
        std = np.sqrt(np.maximum(variance, 0.0) + float(new_measurement) * noise**2)
        if self.unidentified is not None:
            moved = slopes @ self.unidentified.T
            size = np.abs(slopes) @ np.abs(self.unidentified).T
            std = np.where((np.abs(moved) > 1e-7 * size).any(axis=-1), np.inf, std)
        return std.reshape(*points.shape[:-1], self.num_outputs)

    # -- the inverse -------------------------------------------------------------------

    def command_for(
        self,
        desired: ArrayLike,
        limits: ArrayLike | None = None,
        *,
        start: ArrayLike | None = None,
        clip: bool = False,
        max_condition: float = 1e6,
    ) -> Array:
        """Commands that reach desired outputs.

        Of a square affine map its inverse, else Newton's method from several starts;
        within limits the nearest output.

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
        if isinstance(self.model, Affine) and m == n and self.phases is None:
            begin = solve_affine(self, wanted.reshape(-1, m), max_condition)
        elif start is not None:
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

    # -- can it be trusted -------------------------------------------------------------

    @functools.cached_property
    def verdict(self) -> Verdict | None:
        """Of an arm: does its model explain the readings, does it help, what is wrong.

        Held-out errors with an interval beside those of the nominal arm, the scatter
        against the sensor's usual noise, and by name: outliers, contacts of another
        socket, a socket that was moved, parameters far from what was known. None for
        other models, and where the noise is unknown.
        """
        return verdict(self)

    def check(
        self,
        commands: ArrayLike,
        measured: ArrayLike,
        *,
        tolerance: float | None = None,
        placed_anew: bool = False,
    ) -> Check:
        """Does the calibration still hold, by a few new measurements.

        A chi-square test (F where the noise was estimated) of the readings against the
        predictions, with the uncertainty of both, at 5 % false alarms.

        Args:
            commands: (N, n).
            measured: (N, m) readings there.
            tolerance: how far, root mean square over the calibration's commands, the
                outputs may drift; three times the noise when not given.
            placed_anew: of an arm, what its sensor reads (sockets, planes, anchors)
                stands elsewhere than at the calibration.

        Returns:
            "holds", "does not hold", or "cannot be told": a drift of one parameter by
            more than the tolerance would be seen with less than 80 % probability.
        """
        return check(self, commands, measured, tolerance, placed_anew)

    def verification(
        self, candidates: ArrayLike, k: int, *, region: ArrayLike | None = None
    ) -> NDArray[np.int64]:
        """The k of the candidates that show best that the calibration is wrong.

        Args:
            candidates: (M, n) commands that could be measured.
            k: two or three see what many random ones see.
            region: (R, n) commands where it is used, which say how much a drift of a
                parameter matters; those of the calibration when not given.

        Returns:
            (k,) indices.
        """
        return verification(self, candidates, k, region)

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
        affine = isinstance(self.model, Affine)
        what = "y = A u + b" if affine else f"of {type(self.model).__name__}"
        fixed = int((self.free[: len(self.parameters)] == 0).sum())
        lines = [
            f"Calibration {what}: {self.num_inputs} inputs "
            f"({', '.join(self.input_names)}), {self.num_outputs} outputs "
            f"({', '.join(self.output_names)}), {self.num_measurements} measurements, "
            f"{len(self.parameters)} parameters"
            + (f" ({fixed} fixed)" if fixed else "")
            + (", with discrepancy" if self.phases is not None else "")
            + f", {self.loss} loss"
        ]
        cells = {"": columns["parameter"]}
        if affine:
            cells["meaning"] = columns["meaning"]
        cells |= {
            "value": [f"{value: .6g}" for value in columns["value"]],
        }
        if "low" in columns:
            cells["std error"] = [f"{error:.3g}" for error in columns["std_error"]]
            cells["95 % interval"] = [
                f"[{low: .6g}, {high: .6g}]"
                for low, high in zip(columns["low"], columns["high"], strict=True)
            ]
            if self.prior_precision.any() or self.unidentified is not None:
                cells["from data"] = [f"{share:.0%}" for share in columns["from_data"]]
        if any(columns["unit"]):
            cells["unit"] = columns["unit"]
        lines += _in_lines(cells)
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
            if self.dof < 0.5:
                lines.append("no residual degree of freedom: the noise is not checked")
        if self.verdict is not None:
            lines += str(self.verdict).splitlines()
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
        columns: dict[str, list[Any]] = {"parameter": list(self.names)}
        if isinstance(self.model, Affine):
            columns["meaning"] = [
                *(f"{y} per {u}" for y in self.output_names for u in self.input_names),
                *(f"{y} at u = 0" for y in self.output_names),
            ]
        columns |= {"value": self.parameters.tolist(), "unit": self._units}
        if self.standard_errors is not None and self.from_data is not None:
            columns["std_error"] = self.standard_errors.tolist()
            columns["low"], columns["high"] = self.confidence_intervals().T.tolist()
            columns["from_data"] = self.from_data.tolist()
        return columns

    def to_frame(self) -> Any:
        """One row per parameter: value, unit, std_error, low and high (95 %), ...

        Returns:
            A ``pandas.DataFrame``; the last three only where the noise is known.

        Raises:
            ImportError: pandas is not installed.
        """
        try:
            pandas = importlib.import_module("pandas")
        except ModuleNotFoundError:
            raise ImportError(
                "to_frame needs pandas, which is not installed: pip install pandas"
            ) from None
        return pandas.DataFrame(self._columns()).set_index("parameter")

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
        if isinstance(self.model, Affine):
            content["derived"]["matrix"] = self.matrix.tolist()
            content["derived"]["bias"] = self.bias.tolist()
        return content

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a versioned JSON file atomically; see ``docs/calibration.md``.

        Raises:
            OSError: the folder is missing, not writable or full; the old file stays.
        """
        file.write(path, self.to_dict())

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], *, model: Model | None = None
    ) -> Calibration:
        """Read a file that ``save`` wrote.

        Args:
            path: the file.
            model: the model, where it holds a function, which no file can.

        Raises:
            OSError: it cannot be read.
            ValueError: as of ``from_dict``; the message names the file too.
        """
        content = file.read(path)
        try:
            return cls.from_dict(content, model=model)
        except ValueError as error:
            raise ValueError(f"{os.fspath(path)}: {error}") from None

    @classmethod
    def from_dict(cls, content: Any, *, model: Model | None = None) -> Calibration:
        """The inverse of ``to_dict``.

        Raises:
            ValueError: it is not a calibration, of another version, or damaged; the
                message names the key.
        """
        file.require_version(content)
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
        return cls(**found, model=model, loss=content["loss"])

    # -- inside ------------------------------------------------------------------------

    def _points(self, name: str, values: ArrayLike, width: int) -> Array:
        points = numbers(name, values)
        if points.ndim < 1 or points.shape[-1] != width:
            raise ValueError(
                f"{name} must have shape (..., {width}), got {points.shape}"
            )
        return points

    def _require_noise(self, what: str) -> Array:
        if self.noise_std is None:
            raise ValueError(self._no_noise(what))
        return self.noise_std

    def _quantile(self, confidence: float) -> float:
        """Half-width of an interval in standard errors."""
        if not 0.0 < confidence < 1.0:
            raise ValueError(f"confidence must be in (0, 1), got {confidence}")
        from scipy import special  # loads in half the time of scipy.stats

        upper = 0.5 + 0.5 * confidence
        if self.noise_known:
            return float(special.ndtri(upper))
        return float(special.stdtrit(self.noise_dof, upper))

    def _no_noise(self, what: str) -> str:
        left = f"only {self.dof:.2g}" if self.dof >= 0.5 else "no"
        return (
            f"no {what}: {self.num_measurements} measurements leave {left} residual "
            f"degree of freedom for {int(self.free.sum())} free parameters, so the "
            "noise is unknown; measure more or give noise_std"
        )

    @property
    def _units(self) -> list[str]:
        """p units of the parameters, "" where not known."""
        if not isinstance(self.model, Affine):
            return list(getattr(self.model, "units", [""] * len(self.names)))
        per = f"/{self.command_unit}" if self.command_unit else ""
        slope = (self.measured_unit or "1") + per if per else self.measured_unit
        m = self.num_outputs
        return [slope] * (m * self.num_inputs) + [self.measured_unit] * m

    def _require_affine(self, name: str) -> None:
        if not isinstance(self.model, Affine):
            raise AttributeError(f"{name}: only an affine model y = A u + b has one")


def _in_lines(columns: dict[str, list[str]]) -> list[str]:
    """A header and a line for each row, columns padded to the same width."""
    widths = [max(map(len, [name, *column])) for name, column in columns.items()]
    lines = []
    for row in [list(columns), *zip(*columns.values(), strict=True)]:
        padded = [f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)]
        lines.append(("  " + "  ".join(padded)).rstrip())
    return lines
