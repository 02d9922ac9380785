"""Whether a calibration may be used, why not, and what to do next: one answer for all.

``Verdict`` is what ``Model.verdict`` returns; ``verdict`` is the answer of a model that
knows no better. Summary, report, exit codes and warnings ask no one else.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["USE", "Verdict", "left_out", "outlying", "verdict"]

Array = NDArray[np.float64]
Fit = Any  # a jaxcal.Calibration, whose package imports this one

UNLIKELY = 1e-4  # p-value of lack of fit under the noise that was given

USE = (
    "use it (command_for, jaxcal command); check it with a few new readings after a "
    "change of the machine (check, jaxcal check)"
)


@dataclasses.dataclass(frozen=True)
class Verdict:
    """Whether a calibration may be used; printed, the reasons and the next step."""

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


def outlying(fit: Fit, row: int) -> str:
    """How far a measurement is from the others, which do not have to be near it."""
    return (
        f"measurement {row} is {fit.distance[row] ** 0.5:.3g} standard deviations from "
        "the fit of the others"
    )


def verdict(fit: Fit) -> Verdict:
    """Good with a known noise, every parameter determined, no outlier, no misfit."""
    findings: list[tuple[str, str]] = []  # a reason and what to do about it
    if fit.noise_std is None:
        findings.append(
            (
                fit.no_noise("intervals"),
                "measure more rows, or state noise_std, --noise",
            )
        )
    if fit.unidentified is not None and fit.undetermined.any():
        names = ", ".join(fit.names[i] for i in np.flatnonzero(fit.undetermined))
        findings.append(
            (
                f"not determined, held near the prior's mean: {names}; see "
                "identifiability()",
                "measure rows that determine them: "
                "select(candidates, model=..., measured=commands)",
            )
        )
    if fit.outliers:
        rows = ", ".join(map(str, fit.outliers))
        again = f"measure again, or leave out, measurement {rows} (counted from 0)"
        findings += [
            (f"{outlying(fit, row)}, weight {weight:.2g}", again)
            for row, weight in fit.outliers.items()
        ]
    lack = fit.lack_of_fit()
    if lack is not None and lack < UNLIKELY:
        findings.append(
            (
                f"lack of fit under the noise that was given: p = {lack:.2g}",
                "look at the residuals (report, --report): a pattern asks for a model "
                "with more terms, none for a larger noise",
            )
        )
    return Verdict(
        good=not findings,
        reasons=tuple(reason for reason, _ in findings),
        next_step=findings[0][1] if findings else USE,
        unit=fit.measured_unit,
    )
