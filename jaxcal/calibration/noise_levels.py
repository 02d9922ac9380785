"""How many levels of noise the readings of a measurement have, by evidence.

A level for each of many readings, as of a trajectory, cannot be told from few
measurements: their weights would be noise themselves. So one level, one that varies
smoothly along the readings, one for each of a few groups and one for each reading are
compared by Schwarz's criterion; more than one is taken where the evidence is strong
(Kass and Raftery, 1995).
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxcal.calibration.fit_problem import FitProblem, constants
from jaxcal.calibration.least_squares import FitSolution, solve
from jaxcal.checks import Array, Mask
from jaxcal.models.predictions import derivative

_FEW = 30  # measurements from which on a level of its own costs a reading nothing
_STRONG = 6.0  # of Schwarz's criterion, for more than one level
_DEGREES = 8  # at most, of a level that varies smoothly
_TURNS = (2, 3, 4, 5, 6)  # readings taken in turn
_ROUNDS = 4
_SAME = 0.02  # of the logarithm of a profile, which would not change in another round
_LEAST = 10.0  # degrees of freedom of a run of readings
_ONE = "one level for all {} readings of a measurement"
_OWN = "one level for each of the {} readings"


class _Levels(NamedTuple):
    """Which readings share a level, and how it varies over them."""

    says: str
    groups: NDArray[np.intp]  # (q,)
    profile: Array | None  # (q,) up to a common factor; None: the same in a group
    numbers: int  # that describe them


def are_shared(problem: FitProblem) -> bool:
    """Whether few measurements are of parameters that several readings share, and their
    noise is of unknown levels, and of nothing else."""
    model, many = problem.model, not 1 < len(problem.commands) < _FEW
    if problem.noise_known or problem.command_std.any() or model.fitting.multiplicity:
        return False
    if model.default_noise() is not None or many or len(problem.levels) < 2:
        return False
    slopes = derivative(problem.model, problem.commands, problem.mean)
    moved = (slopes != 0.0).any(axis=0)
    return bool((moved.sum(axis=0) > 1)[problem.free].any())


def pooled(problem: FitProblem) -> tuple[FitSolution, str]:
    """The fit with as many levels of noise as the readings, independent and each with a
    level of its own in ``problem``, tell; and which, in words."""
    q = len(problem.levels)
    levels = _Levels(_ONE.format(q), np.zeros(q, np.intp), None, 1)
    try:
        solution = solve(_with(problem, levels))
    except ValueError:  # readings in other units may not converge together
        return solve(problem), _OWN.format(q)
    for _ in range(_ROUNDS):
        better = _best(*_squares(problem, solution))
        if better.says == levels.says:  # a profile by less than it is known to
            off = 0.0
            if better.profile is not None and levels.profile is not None:
                off = np.abs(np.log(better.profile / levels.profile)).max()
            if off < _SAME:
                break
        levels = better
        solution = solve(_with(problem, levels), solution)
    return solution, levels.says


def with_levels_apart(solution: FitSolution) -> FitSolution:
    """The fit with a level for each output where residuals contradict shared ones (F
    test, 0.1 %), without what facts explain: a wrong distance of two sockets is no
    noise along it."""
    q, problem = len(solution.freedom), solution.problem
    stated = problem.noise_known or problem.command_std.any()
    if stated or q == 1 or solution.freedom.min() < 1.0:
        return solution
    from scipy import special

    white = solution.white / solution.level - _by_facts(solution)
    variance = solution.weights @ white**2 / solution.freedom
    high, low = int(variance.argmax()), int(variance.argmin())
    ratio = variance[high] / max(variance[low], np.finfo(np.float64).tiny)
    chance = special.fdtrc(solution.freedom[high], solution.freedom[low], ratio)
    if chance * q * (q - 1) >= 1e-3:
        return solution
    other = solve(dataclasses.replace(problem, levels=np.arange(q)), solution)
    return other if other.freedom.min() >= 1.0 else solution


def _by_facts(solution: FitSolution) -> Array:
    """(N, q) how far residuals are off by facts (``Fitting.facts``), in their noise."""
    if not (count := len(solution.facts)):
        return np.zeros_like(solution.white)
    rows, right, size = solution.weighted_system(0.0)  # facts are its last rows
    step = np.linalg.lstsq(rows[:-count], right[:-count], rcond=1e-10)[0] / size
    return np.asarray(solution.by_theta / solution.level[:, None] @ step)


def _with(problem: FitProblem, levels: _Levels) -> FitProblem:
    problem = dataclasses.replace(problem, levels=levels.groups)
    if levels.profile is None:  # with the same array, by which searches know it
        return problem
    white, std = problem.white / levels.profile, problem.reading_std * levels.profile
    return dataclasses.replace(problem, white=white, reading_std=std)


def _squares(problem: FitProblem, solution: FitSolution) -> tuple[Array, Array]:
    """(q,) sums of squares at level 1, and their degrees of freedom."""
    white = solution.white * (problem.white / solution.problem.white)
    square = solution.weights @ white**2
    if problem.loss is not None:
        square = square / constants(problem.loss, solution.num_readings)[0]
    return square, np.maximum(solution.freedom, 0.0)


def _best(square: Array, freedom: Array) -> _Levels:
    """The levels of the best evidence."""
    q, seen = len(square), freedom > 1e-6
    square = np.maximum(square, 1e-26 * square.max() + 1e-300)
    none = np.zeros(q, np.intp)

    def evidence(levels: _Levels) -> float:
        if levels.profile is None:
            total = np.bincount(levels.groups[seen], freedom[seen], q)
            log = np.log(np.bincount(levels.groups[seen], square[seen], q) + 1e-300)
            log = (log - np.log(np.maximum(total, 1e-300)))[levels.groups]
        else:
            log = 2.0 * np.log(levels.profile)
        fit = freedom * log + square * np.exp(-log)
        cost = levels.numbers * np.log(freedom.sum())
        return float(fit[seen].sum() + cost)

    one = _Levels(_ONE.format(q), none, None, 1)
    others = [_Levels(_OWN.format(q), np.arange(q), None, q)]
    for turn in _TURNS:
        if q % turn == 0 and q > turn:
            says = f"one level for each of {turn} readings in turn"
            others.append(_Levels(says, np.arange(q) % turn, None, turn))
    if q >= 4:
        others.append(_blocks(square, freedom, seen))
    degrees = range(1, 1 + _DEGREES if q >= 2 * _DEGREES else 1)
    shapes = (_smooth(square, freedom, seen, degree) for degree in degrees)
    others += [shape for shape in shapes if shape is not None]
    best = min(others, key=evidence)
    return best if evidence(best) + _STRONG < evidence(one) else one


def _blocks(square: Array, freedom: Array, seen: Mask) -> _Levels:
    """Readings one after another that share a level, halved while that gains."""
    q, price = len(square), 2.0 * np.log(freedom.sum())
    squares = np.append(0.0, np.where(seen, square, 0.0).cumsum())
    freedoms = np.append(0.0, np.where(seen, freedom, 0.0).cumsum())

    def fit(first: Any, last: Any) -> Array:
        total = np.maximum(freedoms[last] - freedoms[first], 1e-300)
        mean = np.maximum((squares[last] - squares[first]) / total, 1e-300)
        return np.asarray(total * np.log(mean))

    open_parts, ends = [(0, q)], [0, q]
    while open_parts:
        first, last = open_parts.pop()
        cuts = np.arange(first + 1, last)
        left, right = freedoms[cuts] - freedoms[first], freedoms[last] - freedoms[cuts]
        cuts = cuts[np.minimum(left, right) >= _LEAST]
        if not cuts.size:
            continue
        gains = fit(first, last) - fit(first, cuts) - fit(cuts, last)
        cut = int(cuts[gains.argmax()])
        if gains.max() > price:
            ends.append(cut)
            open_parts += [(first, cut), (cut, last)]
    groups = np.searchsorted(np.sort(ends)[1:-1], np.arange(q), side="right")
    count = len(ends) - 1
    says = f"one level for each of {count} runs of readings"
    return _Levels(says, groups.astype(np.intp), None, 2 * count - 1)


def _smooth(square: Array, freedom: Array, seen: Mask, degree: int) -> _Levels | None:
    """Levels whose logarithm is a polynomial along the readings, by Chebyshev's."""
    q = len(square)
    basis = np.polynomial.chebyshev.chebvander(np.linspace(-1.0, 1.0, q), degree)
    root = np.sqrt(freedom[seen])[:, None]
    mean = square[seen] / freedom[seen]
    log = np.log(mean) + 1.0 / freedom[seen]
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(30):
            weights = np.linalg.lstsq(root * basis[seen], root[:, 0] * log)[0]
            along = basis[seen] @ weights
            log = along + np.clip(mean * np.exp(-along) - 1.0, -1.0, 3.0)
            if not np.isfinite(log).all():
                return None
    profile = np.exp(0.5 * (basis @ weights))
    says = f"a level that varies smoothly over the {q} readings"
    return _Levels(says, np.zeros(q, np.intp), profile, degree + 1)
