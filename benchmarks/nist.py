"""NIST's 27 nonlinear regressions from both starts: digits of ``jaxcal.identify``.

    python -m benchmarks.nist

Digits are ``-log10`` of the largest error, as a share of NIST's certified value; those
of Lanczos1's deviations are left out: its residuals are the rounding of its readings.
The sets in benchmarks/nist_strd are works of the United States government, not subject
to copyright (NIST/ITL Statistical Reference Datasets). curve_fit is scipy's, from the
same start, as it is called first: no bounds, no derivatives, its own tolerances.
"""

from __future__ import annotations

import dataclasses
import pathlib
import re
import sys
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import jaxcal
from jaxcal.models import FromFunction

FOLDER = pathlib.Path(__file__).parent / "nist_strd"
Array = NDArray[np.float64]


def _gauss(x: Array, *b: float) -> Array:
    peaks = b[2] * np.exp(-((x - b[3]) ** 2) / b[4] ** 2)
    return b[0] * np.exp(-b[1] * x) + peaks + b[5] * np.exp(-(((x - b[6]) / b[7]) ** 2))


def _cubics(x: Array, *b: float) -> Array:
    above = b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3
    return above / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)


def _enso(x: Array, *b: float) -> Array:
    turn, sum_ = 2 * np.pi * x, b[0]
    for period, along, across in ((12, 1, 2), (b[3], 4, 5), (b[6], 7, 8)):
        sum_ = (
            sum_ + b[along] * np.cos(turn / period) + b[across] * np.sin(turn / period)
        )
    return sum_


def _lanczos(x: Array, *b: float) -> Array:
    return sum(b[i] * np.exp(-b[i + 1] * x) for i in (0, 2, 4))


MODELS: dict[str, Callable[..., Array]] = {
    "Misra1a": lambda x, a, b: a * (1 - np.exp(-b * x)),
    "Chwirut1": lambda x, a, b, c: np.exp(-a * x) / (b + c * x),
    "Chwirut2": lambda x, a, b, c: np.exp(-a * x) / (b + c * x),
    "Lanczos3": _lanczos,
    "Gauss1": _gauss,
    "Gauss2": _gauss,
    "DanWood": lambda x, a, b: a * x**b,
    "Misra1b": lambda x, a, b: a * (1 - (1 + b * x / 2) ** -2),
    "Kirby2": lambda x, a, b, c, d, e: (a + b * x + c * x**2) / (1 + d * x + e * x**2),
    "Hahn1": _cubics,
    "Nelson": lambda x, z, a, b, c: a - b * x * np.exp(-c * z),
    "MGH17": lambda x, a, b, c, d, e: a + b * np.exp(-x * d) + c * np.exp(-x * e),
    "Lanczos1": _lanczos,
    "Lanczos2": _lanczos,
    "Gauss3": _gauss,
    "Misra1c": lambda x, a, b: a * (1 - (1 + 2 * b * x) ** -0.5),
    "Misra1d": lambda x, a, b: a * b * x / (1 + b * x),
    "Roszman1": lambda x, a, b, c, d: a - b * x - np.arctan(c / (x - d)) / np.pi,
    "ENSO": _enso,
    "MGH09": lambda x, a, b, c, d: a * (x**2 + x * b) / (x**2 + x * c + d),
    "Thurber": _cubics,
    "BoxBOD": lambda x, a, b: a * (1 - np.exp(-b * x)),
    "Rat42": lambda x, a, b, c: a / (1 + np.exp(b - c * x)),
    "Rat43": lambda x, a, b, c, d: a / (1 + np.exp(b - c * x)) ** (1 / d),
    "MGH10": lambda x, a, b, c: a * np.exp(b / (x + c)),
    "Eckerle4": lambda x, a, b, c: a / b * np.exp(-0.5 * ((x - c) / b) ** 2),
    "Bennett5": lambda x, a, b, c: a * (b + x) ** (-1 / c),
}


@dataclasses.dataclass(frozen=True)
class Certified:
    """A set and what NIST certifies of it."""

    name: str
    commands: Array  # (N, n)
    measured: Array  # (N, 1)
    starts: Array  # (2, p)
    parameters: Array  # (p,)
    deviations: Array  # (p,)
    level: str  # of difficulty

    def f(self, u: Array, theta: Array) -> Array:
        """(N, 1) readings at commands (N, n)."""
        return np.asarray(MODELS[self.name](*u.T, *theta))[:, None]


def read(name: str) -> Certified:
    """A set of the folder."""
    text = (FOLDER / f"{name}.dat").read_text()
    rows = re.findall(r"^ *b\d+ *= +(\S+) +(\S+) +(\S+) +(\S+)", text, re.MULTILINE)
    values = np.array(rows, dtype=np.float64)
    data = np.array(
        [line.split() for line in re.split(r"Data:  .*\n", text)[-1].splitlines()],
        dtype=np.float64,
    )
    measured = np.log(data[:, :1]) if name == "Nelson" else data[:, :1]
    level = re.search(r"(\w+) Level of Difficulty", text)
    assert level is not None
    return Certified(
        name, data[:, 1:], measured, values[:, :2].T, values[:, 2], values[:, 3],
        level[1].lower(),
    )  # fmt: skip


def digits(found: Array, certified: Array) -> float:
    """Digits of the worst that agree, 11 at most: that many are certified."""
    off = float(np.abs(found / certified - 1.0).max())
    return float(np.clip(-np.log10(max(off, 1e-16)), 0.0, 11.0))


def fitted(one: Certified, start: int) -> tuple[float, float, str]:
    """Digits of parameters and deviations, and what the answer says against itself."""
    model = FromFunction(one.f, one.starts[start], batch=True, quiet=True)
    try:
        fit = jaxcal.identify(one.commands, one.measured, model=model, loss="gaussian")
    except ValueError as error:
        return 0.0, 0.0, str(error)
    said = "" if fit.verdict.good else fit.verdict.reasons[0]
    errors: Any = fit.standard_errors
    return digits(fit.parameters, one.parameters), digits(errors, one.deviations), said


def of_scipy(one: Certified, start: int) -> float:
    """Digits of curve_fit's parameters."""
    from scipy.optimize import curve_fit

    def f(x: Array, *theta: float) -> Array:
        return one.f(x.T, np.array(theta))[:, 0]

    try:
        found = curve_fit(f, one.commands.T, one.measured[:, 0], one.starts[start])[0]
    except RuntimeError:
        return 0.0
    return digits(found, one.parameters)


def main(names: list[str]) -> None:
    warnings.simplefilter("ignore")
    print("| set | level | parameters | deviations | curve_fit | it says |")
    print("|---|---|---|---|---|---|")
    for name in names or MODELS:
        one = read(name)
        with np.errstate(all="ignore"):
            both = [(*fitted(one, start), of_scipy(one, start)) for start in (0, 1)]
        of_values, of_errors, said, peer = zip(*both, strict=True)
        pairs = (
            ", ".join(f"{x:.1f}" for x in pair) for pair in (of_values, of_errors, peer)
        )
        reason = said[0] if said[0] == said[1] else "; ".join(filter(None, said))
        print(f"| {name} | {one.level} | {' | '.join(pairs)} | {reason} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
