"""Whether a calibration may be used, why not, and what to do next: one answer for all.

``Verdict`` is what ``Model.verdict`` returns; ``verdict`` is the answer of a model that
knows no better, by the rules of ``jaxcal.models.reasons``. Summary, report, exit codes
and warnings ask no one else.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import Array
from jaxcal.late import late
from jaxcal.models.reasons import RULES, computed, never_measured, not_invertible

if TYPE_CHECKING:
    from jaxcal.calibration import Calibration
    from jaxcal.calibration.fit import Fit

_CHECK = "a change of the machine (check, jaxcal check)"
USE = (
    "use it (command_for, jaxcal command); check it with a few new readings after "
    f"{_CHECK}"
)
_PREDICT = (
    f"use it (predict, jaxcal predict); check it with a few new readings after {_CHECK}"
)


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Whether a calibration may be used; ``print`` shows reasons and the next step."""

    good: bool
    reasons: tuple[str, ...]  # against it, or worth knowing
    next_step: str
    unit: str = ""  # of the readings, and of the lengths or angles in the reasons

    def lines(self) -> tuple[str, ...]:
        """What it says, without the last line, which is the verdict itself."""
        return self.reasons

    def __str__(self) -> str:
        word = "good" if self.good else "not good"
        return "\n".join([*self.lines(), f"{word}; next: {self.next_step}"])

    _repr_html_ = late("jaxcal.reports.shown:as_html")


class CalibrationWarning(UserWarning):
    """A calibration is not good; the text is its verdict.

    Python shows the first for each line that calls ``identify``, whatever it says, and
    none after ``warnings.simplefilter("ignore", jaxcal.CalibrationWarning)``.
    """

    new = False  # set where it is issued: Python has not looked at its text yet

    def __str__(self) -> str:
        # Python shows a text once for each line: at its first look all are the same.
        return "not good" if vars(self).pop("new", False) else super().__str__()


def left_out(fit: Fit) -> Array:
    """(N, m) residual of each measurement from the fit without it, to first order."""
    noise = fit.require_noise("held-out errors")
    slopes, covariance = fit.linear(fit.commands, misfit=False)
    spread = slopes @ covariance @ np.matrix_transpose(slopes)
    root = np.diag(1.0 / np.where(noise > 0.0, noise, 1.0))
    share = np.minimum(fit.loss_weights, 1.0)[:, None, None]
    values, vectors = np.linalg.eigh(np.eye(len(noise)) - share * root @ spread @ root)
    turned = np.matrix_transpose(vectors) / np.maximum(values, 0.02)[..., None]
    white = vectors @ turned @ root @ fit.residuals[..., None]
    return np.asarray(np.linalg.solve(root, white)[..., 0])


def between_sessions(fit: Calibration, labels: NDArray[np.intp]) -> Array:
    """(m,) standard deviation of readings of another session, beyond what is expected.

    Each session of ``labels`` (N,) is predicted from a fit of the others; a ValueError
    where none of these determines the model.
    """
    square, expected = [], []
    for label in np.unique(labels):
        try:
            trial = fit.again(fit.model, fit.stated_prior, labels != label)
        except ValueError:
            continue
        rows = (labels == label) & (fit.loss_weights > 0.0)
        if trial.noise_std is not None and rows.any():
            commands = fit.commands[rows]
            off = fit.model.wrapped(
                fit.measured[rows] - trial.predict(commands), commands
            )
            square.append(off**2)
            expected.append(trial.predict_std(commands, new_measurement=True) ** 2)
    if not square:
        raise ValueError("sessions: each fit without one session must be possible")
    excess = np.vstack(square).mean(axis=0) - np.vstack(expected).mean(axis=0)
    return np.sqrt(excess.clip(0.0))


def verdict(fit: Calibration) -> Verdict:
    """Good if no rule speaks against the fit and its inverse is not refused.

    Where readings were not measured, that is the only reason given: the others would
    follow from it.
    """
    first = never_measured(fit) or computed(fit)
    reasons = [first] if first else [reason for rule in RULES if (reason := rule(fit))]
    if not reasons and (refusal := not_invertible(fit)):
        reasons = [refusal]
    use = USE if fit.num_outputs <= fit.num_inputs else _PREDICT
    return Verdict(
        good=not reasons,
        reasons=tuple(reason.fact for reason in reasons),
        next_step=reasons[0].remedy if reasons else use,
        unit=fit.measured_unit,
    )
