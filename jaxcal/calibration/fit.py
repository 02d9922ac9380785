"""``Fit``: what identification found, its uncertainty, and predictions."""

from __future__ import annotations

import dataclasses
import functools
import json
import warnings
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.calibration.resolution import COARSE, resolution
from jaxcal.checks import Array, Mask, array_of, numbers
from jaxcal.information.singular import depends
from jaxcal.models.identifiability import Identifiability, identifiability
from jaxcal.models.model import Model
from jaxcal.models.predictions import derivative, predict
from jaxcal.models.uncertainty import Prior
from jaxcal.tables import COMMANDS, MEASURED, of_frame

_FEW = 2000  # rows, among which one may hide
_CHANCE = 0.0002  # of a table, that a reading lies so far above the others' fit
FAR = 0.25  # of the range of what was measured, beyond it


class CalibrationWarning(UserWarning):
    """A calibration is not good, and why; or it is used far from its measurements.

    Python shows the first of each kind for a line of a program, whatever it says, and
    none after ``warnings.simplefilter("ignore", jaxcal.CalibrationWarning)``.
    """

    kind = ""

    def __str__(self) -> str:
        # Python shows a text once for each line: at its first look it is the kind.
        return vars(self).pop("kind", "") or super().__str__()


def warn(text: str, kind: str, stacklevel: int) -> None:
    """Issue a CalibrationWarning of a kind, for which texts of calls differ."""
    warning = CalibrationWarning(text)
    warning.kind = kind
    warnings.warn(warning, stacklevel=stacklevel + 1)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """``y = f(u; theta)`` with the most probable p parameters; P with harmonics.

    Arrays are copied and frozen; letters are their axes (n inputs, m outputs, N
    measurements), and numbers their least value.
    """

    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    command_unit: str  # "" where not stated
    measured_unit: str
    # created, packages, data_sha256, notes, accuracy; prior "stated" where one was
    provenance: Mapping[str, Any]
    model: Model
    loss: str  # of jaxcal.calibration.fit_problem
    estimate: Annotated[Array, "P"]
    joint_covariance: Annotated[Array | None, "PP"]  # None where the noise is unknown
    # Commands are counted from it in joint_covariance; None: from zero.
    centre: Annotated[Array | None, "n"]
    unidentified: Annotated[Array | None, "zP"]  # directions that nothing determines
    prior_mean: Annotated[Array, "P"]
    prior_precision: Annotated[Array, "P", 0.0]  # 0 where nothing was known
    free: Annotated[Array, "P", 0.0]  # 0 where held at the prior's mean, else 1
    commands: Annotated[Array, "Nn"]  # as given
    estimated_commands: Annotated[Array | None, "Nn"]  # where command_std was given
    residuals: Annotated[Array, "Nm"]  # measured less predicted, measured unit
    # At most 1; small for an outlier, 0 where left out.
    loss_weights: Annotated[Array, "N", 0.0]
    # Squared, from the fit without that measurement, in noise.
    distance: Annotated[Array, "N", 0.0]
    dof: Annotated[float, "", 0.0]  # residual degrees of freedom, prior counted
    square: Annotated[float, "", 0.0]  # sum of the squared residuals in noise
    num_readings: Annotated[float, "", 1.0]  # of a measurement, less unknown commands
    noise_std: Annotated[Array | None, "m", 0.0]  # at weight 1, behind all uncertainty
    noise_dof: Annotated[float, "", 0.0]  # of the noise estimated, 0 where given

    def __post_init__(self) -> None:
        fields = vars(self)  # of a frozen class
        for name, value in fields.items():
            if isinstance(value, np.ndarray):
                fields[name] = value = np.array(value)
                value.flags.writeable = False
        fields["provenance"] = json.loads(json.dumps(self.provenance))

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
    def num_measurements(self) -> int:
        """Measurements of positive weight."""
        return int(np.count_nonzero(self.loss_weights > 0.0))

    @property
    def noise_known(self) -> bool:
        """The noise was given; else it comes from the residuals."""
        return self.noise_std is not None and not self.noise_dof

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
        """(p, p) of ``parameters``, directions that nothing determines held fixed; None
        where the noise is unknown."""
        if self.joint_covariance is None:
            return None
        p, turn = len(self.names), to_parameters(self)
        return turn @ self.joint_covariance[:p, :p] @ turn.T

    @property
    def standard_errors(self) -> Array | None:
        """(p,); inf where nothing determines the parameter; None without noise."""
        covariance = self.covariance
        if covariance is None:
            return None
        joint = np.asarray(self.joint_covariance)[: len(covariance), : len(covariance)]
        variance = above_rounding(np.diag(covariance), to_parameters(self), joint)
        return np.where(self.undetermined, np.inf, np.sqrt(variance))

    @property
    def from_data(self) -> Array | None:
        """(p,) share of the prior variance that measurements removed; 0: the value is
        the prior's."""
        if self.standard_errors is None:
            return None
        precision = self.prior_precision[: len(self.parameters)]
        errors = np.where(np.isinf(self.standard_errors), 0.0, self.standard_errors)
        share = np.clip(1.0 - errors**2 * precision, 0.0, 1.0)
        return np.where(self.undetermined | (self.free[: len(share)] == 0), 0.0, share)

    def identifiability(self) -> Identifiability:
        """Which parameters the measurements alone determine, at the estimate."""
        here = Prior(np.inf, mean=self.parameters)
        used = self.commands[self.loss_weights > 0.0]
        return identifiability(self.model, used, prior=here)

    @property
    def affine(self) -> tuple[Array, Array] | None:
        """A (m, n) and b (m,) where the model is affine, else None."""
        return self.model.affine(self.parameters)

    @property
    def matrix(self) -> Array:
        """(m, n) A of an affine model."""
        return self._affine("matrix")[0]

    @property
    def bias(self) -> Array:
        """(m,) b of an affine model."""
        return self._affine("bias")[1]

    def confidence_intervals(self, confidence: float = 0.95) -> Array:
        """(p, 2) lower and upper end for each parameter, one at a time, by Student's t
        where the noise was estimated. A ValueError where it is unknown."""
        noise_of(self, "confidence intervals")
        half = quantile(self, confidence) * np.asarray(self.standard_errors)
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
        std = self.predict_std(commands, new_measurement=new_measurement)
        half = quantile(self, confidence) * std
        return centre - half, centre + half

    # -- the fit -----------------------------------------------------------------------

    @functools.cached_property
    def measured(self) -> Array:
        """(N, m) the readings; of a wrapping one that nearest to the prediction."""
        at = self.commands
        if self.estimated_commands is not None:
            at = self.estimated_commands
        return self.residuals + predict(self.whole, at, self.estimate)

    @functools.cached_property
    def outliers(self) -> dict[int, float]:
        """Rows too far from the fit of the others (1 % in all) and their weights."""
        from scipy import special

        most = special.chdtri(self.num_readings, 0.01 / self.num_measurements)
        times, limit = studentised(self)
        far = (self.distance > most) | (times > limit)
        if far.any() and self.noise_dof:
            step = resolution(self.measured, COARSE)
            far &= (np.abs(deleted(self)) > 2.0 * step).any(axis=1)
        (rows,) = far.nonzero()
        return {int(i): float(self.loss_weights[i]) for i in rows}

    def lack_of_fit(self) -> float | None:
        """p-value of residuals at least this large under a noise that was given, small
        if the model, a row or that noise is wrong; None if none was given."""
        if not self.noise_known or self.dof < 0.5:
            return None
        from scipy import special

        return float(special.chdtrc(self.dof, self.square))

    # -- prediction --------------------------------------------------------------------

    def predict(self, commands: ArrayLike) -> Array:
        """Outputs (..., m) at commands (..., n); a warning tells of far ones."""
        points = as_points(self, "commands", commands, self.num_inputs)
        rows = points.reshape(-1, self.num_inputs)
        say_far("command", slice(None), [(self.input_names, rows, self._range)])
        return outputs_at(self, points)

    @functools.cached_property
    def _range(self) -> Array:
        """(2, n) the least and the largest command that counts."""
        used = self.commands[self.loss_weights > 0.0]
        return np.stack([used.min(axis=0), used.max(axis=0)])

    def predict_std(
        self, commands: ArrayLike, *, new_measurement: bool = False
    ) -> Array:
        """(..., m) standard deviation of ``predict`` at commands (..., n), infinite
        where it depends on undetermined parameters. A ValueError without noise.

        ``new_measurement`` adds the noise of one more measurement of weight 1.
        """
        points = as_points(self, "commands", commands, self.num_inputs)
        noise = noise_of(self, "prediction uncertainty")
        rows = points.reshape(-1, self.num_inputs)
        variance = variance_of(self, rows, noise**2 if new_measurement else 0.0 * noise)
        return np.sqrt(variance).reshape(*points.shape[:-1], self.num_outputs)

    # -- inside ------------------------------------------------------------------------

    @functools.cached_property
    def whole(self) -> Model:
        """The model with the harmonics that were found, if any: its last parameters."""
        more = len(self.estimate) > len(self.names)
        return self.model.fitting.misfit_model() if more else self.model

    @property
    def undetermined(self) -> Mask:
        """(p,) parameters in directions that nothing determines."""
        if self.unidentified is None:
            return np.zeros(len(self.parameters), dtype=np.bool_)
        return np.asarray(self.unidentified[:, : len(self.parameters)].any(axis=0))

    def _affine(self, name: str) -> tuple[Array, Array]:
        if self.affine is None:
            raise AttributeError(f"{name}: only an affine model y = A u + b has this")
        return self.affine


def stated_prior(fit: Fit) -> Prior | None:
    """The prior that ``identify`` was given, unless sized; None: the model's."""
    if fit.provenance.get("prior") != "stated":
        return None
    p, names = len(fit.names), np.array(fit.names)
    with np.errstate(divide="ignore"):
        std = fit.prior_precision[:p] ** -0.5
    held = names[fit.free[:p] == 0.0].tolist()
    return Prior(std, mean=fit.prior_mean[:p], fixed=held)


def to_parameters(fit: Fit) -> Array:
    """(p, p) from the coordinates of ``joint_covariance`` to ``parameters``."""
    if fit.centre is None:
        return np.eye(len(fit.names))
    return np.asarray(fit.model.fitting.centred(-fit.centre))


def outputs_at(fit: Fit, commands: ArrayLike) -> Array:
    """``predict`` without a warning."""
    points = as_points(fit, "commands", commands, fit.num_inputs)
    outputs = predict(fit.whole, points.reshape(-1, fit.num_inputs), fit.estimate)
    return outputs.reshape(*points.shape[:-1], fit.num_outputs)


def variance_of(fit: Fit, rows: Array, of_readings: Array) -> Array:
    """(N, m) of ``predict`` at ``rows`` (N, n) and of readings (m,) there."""
    slopes, covariance = linearised(fit, rows)
    variance = above_rounding(
        ((slopes @ covariance) * slopes).sum(axis=-1), slopes, covariance
    )
    more = fit.model.fitting.unexplained(fit, rows) ** 2
    variance = variance + np.maximum(more, of_readings) + session_std(fit) ** 2
    if fit.unidentified is not None:
        variance = np.where(depends(slopes, unseen_directions(fit)), np.inf, variance)
    return variance


def session_std(fit: Fit) -> Array:
    """(m,) standard deviation between sessions; 0 where one alone was stated."""
    of_sessions = fit.provenance.get("sessions", {"std": [0.0]})
    return np.broadcast_to(np.array(of_sessions["std"]), (fit.num_outputs,))


def linearised(fit: Fit, rows: Array, *, misfit: bool = True) -> tuple[Array, Array]:
    """(N, m, P) derivatives of predictions at ``rows`` (N, n), and the covariance
    (P, P) of all parameters; without ``misfit`` of the model's alone, as if there
    were no harmonics but those that were fitted."""
    if fit.centre is not None:
        rows = rows - fit.centre
    joint, p = np.asarray(fit.joint_covariance), len(fit.names)
    if misfit or fit.estimate[p:].any():
        return derivative(fit.whole, rows, fit.estimate), joint
    by = joint[:p, p:]
    within = joint[:p, :p] - by * fit.prior_precision[p:] @ by.T
    return derivative(fit.model, rows, fit.parameters), within


def deleted(fit: Fit) -> Array:
    """(N, m) residuals from the fit without each measurement, by its mean leverage."""
    noise = np.asarray(fit.noise_std)
    square = ((fit.residuals / (noise + (noise == 0.0))) ** 2).sum(axis=1)
    off: Array = fit.residuals * (fit.distance / (square + (square == 0.0)))[:, None]
    return off


def studentised(fit: Fit) -> tuple[Array, float]:
    """(N,) how far each measurement is from the fit of the others, in their noise, and
    what one in 2,500 such tables reaches: by Student's t of each output, so that no
    reading hides in the noise that it makes itself. 0 where the noise was given, or
    rows weigh less than others."""
    none = np.zeros(len(fit.residuals)), 1.0
    noise = np.asarray(fit.noise_std)  # 0-d of none
    exact = fit.noise_known or fit.estimated_commands is not None
    if exact or noise.ndim == 0 or not noise.all() or len(none[0]) > _FEW:
        return none
    dof = fit.dof / len({*noise.tolist()})  # of a level
    weighed = (fit.loss_weights != 1.0).any() or fit.prior_precision.any()
    if weighed or dof < 2.0:
        return none
    from scipy import special

    square = fit.residuals * deleted(fit) / noise**2
    share = np.minimum(square / dof, 1.0 - 1e-12).max(axis=1)
    times = np.sqrt(share * (dof - 1.0) / (1.0 - share))
    return times, float(-special.stdtrit(dof - 1.0, _CHANCE / square.size))


def unseen_directions(fit: Fit) -> Array:
    """(z, P) directions that nothing determines, as ``linearised`` has the slopes."""
    if fit.unidentified is None:
        return np.zeros((0, len(fit.estimate)))
    if fit.centre is None:
        return fit.unidentified
    return fit.unidentified @ np.asarray(fit.model.fitting.centred(fit.centre)).T


def as_points(fit: Fit, name: str, values: ArrayLike, width: int) -> Array:
    """(..., width) commands, or outputs; of a data frame by name."""
    points = numbers(name, columns_of(fit, name, values))
    if points.ndim < 1 or points.shape[-1] != width:
        raise ValueError(f"{name} must have shape (..., {width}), got {points.shape}")
    return points


def columns_of(fit: Fit, name: str, values: ArrayLike, *, quiet: bool = False) -> Any:
    """The calibration's columns of a data frame, in its order; else as given. What
    it has beside them is said, unless ``quiet``."""
    inputs, outputs = fit.input_names, fit.output_names
    if name in ("desired", "measured", "readings"):
        beside = None if quiet else inputs
        return of_frame(name, values, outputs, MEASURED, beside=beside)
    levels = getattr(fit.model, "levels", ())
    return of_frame(name, values, inputs, COMMANDS, None, levels, outputs)


def noise_of(fit: Fit, what: str) -> Array:
    if fit.noise_std is None:
        raise ValueError(no_noise(fit, what))
    return fit.noise_std


def quantile(fit: Fit, confidence: float) -> float:
    """Half-width of an interval in standard errors."""
    if not 0.0 < array_of("confidence", confidence) < 1.0:
        raise ValueError(f"confidence must be in (0, 1), got {confidence}")
    from scipy import special  # loads in half the time of scipy.stats

    upper = 0.5 + 0.5 * confidence
    if fit.noise_known:
        return float(special.ndtri(upper))
    return float(special.stdtrit(fit.noise_dof, upper))


def no_noise(fit: Fit, what: str) -> str:
    left = f"only {fit.dof:.2g}" if fit.dof >= 0.5 else "no"
    return (
        f"no {what}, because the noise is unknown: {fit.num_measurements} "
        f"measurements leave {left} residual degree of freedom for "
        f"{int(fit.free.sum())} free parameters. Measure more, or give noise_std"
    )


def above_rounding(variance: Array, rows: Array, covariance: Array) -> Array:
    """(...) variances of rows (..., P), none below what rounding leaves of theirs.
    Where directions are known to very different degrees, a sum of their covariance (P,
    P) may cancel to zero or less: that is not known to be certain."""
    terms = (rows**2 * np.diag(covariance)).sum(axis=-1)
    return np.asarray(np.maximum(variance, np.finfo(np.float64).eps * terms))


def say_far(
    what: str,
    used: Any,
    sides: Sequence[tuple[Sequence[str], Array, Array]],
    stacklevel: int = 3,
) -> None:
    """Warn of points (``what`` they are) far outside of what was measured: of each side
    names of columns, points (P, k), and (N, k), of which ``used`` (N,) count."""
    far, worst, count = set(), "", len(sides[0][1])
    for names, values, measured in sides:
        low, high = measured[used].min(axis=0), measured[used].max(axis=0)
        width = np.where(high > low, high - low, np.inf)
        beyond = np.maximum(low - values, values - high) / width
        far |= {*np.flatnonzero((beyond > FAR).any(axis=1))}
        if far and not worst:
            i, j = np.unravel_index(beyond.argmax(), beyond.shape)
            worst = (
                f"{what} {i + 1} has {names[j]} = {values[i, j]:.6g}, measured "
                f"range {low[j]:.6g} to {high[j]:.6g}"
            )
    if far:
        warn(
            f"{len(far)} of {count} {what}s {'is' if len(far) == 1 else 'are'} far "
            f"outside the measurements, where the calibration is untested: {worst}",
            f"{what}s are far outside the measurements",
            stacklevel,
        )
