"""How large a machine's errors are, from its readings: the scales of a prior's groups.

A factor for each of the model's ``error_groups()`` and the level of the noise make the
readings most probable (marginal likelihood, the model linear about the fit), with what
the model thinks of each factor beforehand.

Sources: MacKay, 1992; Bishop, Pattern Recognition and Machine Learning, 3.5.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from typing import NamedTuple

import numpy as np

from jaxcal.calibration.fit_problem import FitProblem
from jaxcal.calibration.least_squares import FitSolution
from jaxcal.checks import Array
from jaxcal.information.blocks import gram, triangle, without
from jaxcal.information.singular import significant
from jaxcal.models.model import ErrorGroups, Model
from jaxcal.models.predictions import derivative

_LEVEL = 3.0  # factor of one standard deviation of the level, beforehand
_MOST = 5.0  # of a logarithm
_LARGEST = 2.5  # of a factor, 12: beyond it an arm in sockets shrinks until all fit
_FIRST = 1.6  # of a factor in a rough fit, 5: an arm that has shrunk stays so
# Logarithms of misfit's factor.
_TRIED = np.array([-5.0, -4.0, -3.0, -2.0, -1.2, -0.4, 0.4, 1.2])
_ERRORS = np.exp(np.linspace(0.0, 6.0, 120))  # where their quantile is looked up
_SCORES = 100  # steps of Fisher's scoring, at most


class PriorScales(NamedTuple):
    """Factors of the prior's standard deviations."""

    logs: Array  # (G + 1,) of the groups' factors and the level
    factors: Array  # (p,) 1 of parameters of no group
    covariance: Array  # (G, G) of the logarithms of the groups' factors


def group_scales(
    problem: FitProblem, solution: FitSolution, start: PriorScales | None
) -> PriorScales:
    """The factors, of the problem's prior, that make the readings most probable. The
    model is made linear at ``solution``; the search begins at ``start``, with factors
    of one where there is nothing."""
    of_model = problem.model.fitting.error_groups()
    assert of_model is not None
    groups, num_groups = of_model.members, len(of_model.medians)
    evidence = _Evidence(problem, solution, of_model)
    if start is None:
        evidence.most[:-1] = _FIRST
    # A level that is known floats too: misfit beyond it is no size of the errors.
    best = evidence.middle if start is None else start.logs
    least = _EvidenceOfScales(evidence, best)
    for _ in range(_SCORES):
        step = np.linalg.solve(least.curvature, least.slope)
        trial = np.clip(best - step, -_MOST, evidence.most)
        while (after := _EvidenceOfScales(evidence, trial)).value > least.value + 1e-9:
            step *= 0.5
            trial = np.clip(best - step, -_MOST, evidence.most)
        gain, best, least = least.value - after.value, trial, after
        if gain < 1e-4:
            break
    factors = np.where(groups >= 0, np.exp(best[groups]), 1.0)
    if start is None:  # of a rough fit, which begin the next
        return PriorScales(best, factors, np.zeros((num_groups, num_groups)))
    steps = 1e-3 * np.eye(len(best))
    curves = [
        _EvidenceOfScales(evidence, best + step).slope - least.slope for step in steps
    ]
    # Half the value's, in units of what was thought, which the readings only sharpen.
    wide = evidence.wide
    curve = np.array(curves) / 2e-3 * np.outer(wide, wide)
    size, axes = np.linalg.eigh(curve)
    axes = wide[:, None] * axes
    inside = (axes / np.maximum(size, 1.0)) @ axes.T
    return PriorScales(best, factors, inside[:num_groups, :num_groups])


class _Evidence:
    """-2 log marginal likelihood of the logarithms (G + 1,) of the groups' factors and
    the level, with what is thought of them; the model is linear about a solution."""

    def __init__(
        self, problem: FitProblem, solution: FitSolution, groups: ErrorGroups
    ) -> None:
        rows, right = _reduced(problem, solution)
        sized = groups.members[problem.free & (problem.precision > 0.0)]
        group = np.arange(len(groups.medians))
        self.members = sized == group[:, None]  # (G, s)
        # Of the logarithms beforehand, (G + 1,): the middle, and a standard deviation.
        self.middle = np.log(np.append(groups.medians, 1.0))
        self.wide = np.log(np.append(groups.spreads, _LEVEL))
        self.most = np.append(np.full(len(group), _LARGEST), _MOST)  # (G + 1,)
        self.count, width = len(right), rows.shape[1]
        # All that the readings say is in a triangle; the rest of them is noise alone.
        factor = triangle(np.column_stack([rows, right]))
        top = min(width, len(factor))
        self.rest = float((factor[top:, width] ** 2).sum())
        self.rows, self.right = factor[:top, :width], factor[:top, width]


class _EvidenceOfScales:
    """The value for logarithms of scales (G + 1,); slope and curvature when asked."""

    def __init__(self, evidence: _Evidence, logs: Array) -> None:
        from scipy.linalg.lapack import dpotrf, dpotrs

        self.evidence = evidence
        self.scaled = evidence.rows * np.exp(logs[:-1] @ evidence.members)
        self.level, self.top = np.exp(2.0 * logs[-1]), len(evidence.right)
        self.covariance = gram(self.scaled.T) + self.level * np.eye(self.top)
        self.root, self.failed = dpotrf(self.covariance)
        if self.failed:  # beyond rounding
            log_det = np.linalg.slogdet(self.covariance)[1]
            self.white = self.inverse @ evidence.right
        else:
            log_det = 2.0 * np.log(self.root.diagonal()).sum()
            self.white = dpotrs(self.root, evidence.right)[0]
        alone = (evidence.count - self.top) * 2.0 * logs[-1]
        alone += evidence.rest / self.level
        self.off = (logs - evidence.middle) / evidence.wide
        value = evidence.right @ self.white + alone + log_det
        self.value = float(value + self.off @ self.off)

    @functools.cached_property
    def inverse(self) -> Array:
        """(top, top) of ``covariance``, that of the readings."""
        from scipy.linalg.lapack import dtrtri

        if self.failed:
            return np.asarray(np.linalg.inv(self.covariance))
        return gram(dtrtri(self.root)[0].T)

    @functools.cached_property
    def shown(self) -> Array:
        """(top, s) ``inverse @ scaled``."""
        return np.asarray(self.inverse @ self.scaled)

    @property
    def slope(self) -> Array:
        """(G + 1,)."""
        evidence, white = self.evidence, self.white
        members, square = evidence.members, white @ white
        by_factors = members @ (self.shown * self.scaled).sum(axis=0)
        by_factors = by_factors - members @ (white @ self.scaled) ** 2
        by_level = self.level * (np.trace(self.inverse) - square) + evidence.count
        by_level = by_level - self.top - evidence.rest / self.level
        slope = np.append(by_factors, by_level)
        return np.asarray(2.0 * (slope + self.off / evidence.wide))

    @property
    def curvature(self) -> Array:
        """(G + 1, G + 1) as it is expected to be."""
        evidence, level, shown = self.evidence, self.level, self.shown
        members = evidence.members
        curve = np.diag(evidence.wide**-2.0)
        curve[:-1, :-1] += 2.0 * members @ (self.scaled.T @ shown) ** 2 @ members.T
        across = 2.0 * level * members @ (shown**2).sum(axis=0)
        curve[-1, :-1] = curve[:-1, -1] = across
        square = level**2 * (self.inverse**2).sum()
        curve[-1, -1] += 2.0 * (square + evidence.count - self.top)
        return 2.0 * curve


def misfit_scale(
    with_misfit: Model, problem: FitProblem, solution: FitSolution, scales: PriorScales
) -> tuple[float, float]:
    """How much less -2 log marginal likelihood is at best with misfit that was not
    fitted, the last parameters and group of ``with_misfit``; and the root of its mean
    squared factor."""
    more = len(with_misfit.names) - len(problem.mean)
    std = np.asarray(with_misfit.default_prior().std)[-more:]
    groups = with_misfit.fitting.error_groups()
    assert groups is not None
    beside = copy.copy(solution)
    beside.parameters = np.append(solution.parameters, np.zeros(more))
    whole = dataclasses.replace(
        problem,
        model=with_misfit,
        mean=np.append(problem.mean, np.zeros(more)),
        precision=np.append(problem.precision, std**-2.0),
        free=np.append(problem.free, np.ones(more, dtype=np.bool_)),
    )
    evidence = _Evidence(whole, beside, groups)
    logs, least = scales.logs.copy(), np.zeros(len(_TRIED))
    rest = np.delete(np.arange(len(logs)), -2)
    for k, tried in enumerate(_TRIED):
        logs[-2] = tried
        for _ in range(2):  # steps of the other scales
            trial = _EvidenceOfScales(evidence, logs)
            curve = trial.curvature[np.ix_(rest, rest)]
            step = np.linalg.solve(curve, trial.slope[rest])
            after = logs[rest] - np.clip(step, -1.0, 1.0)
            logs[rest] = np.clip(after, -_MOST, evidence.most[rest])
        least[k] = _EvidenceOfScales(evidence, logs).value
    shares = np.exp(-0.5 * (least - least.min()))
    square = float(shares @ np.exp(2.0 * _TRIED) / shares.sum())
    thought = (_TRIED - evidence.middle[-2]) / evidence.wide[-2]
    gains = least - thought**2
    return float(gains[0] - gains.min()), float(np.sqrt(square))


def covariance_of_scales(solution: FitSolution, scales: PriorScales) -> Array:
    """(P, P) what the scales, which are estimates too, add to the covariance: mean and
    covariance of a linear model's parameters are averaged over them."""
    problem, of_model = solution.problem, solution.problem.model.fitting.error_groups()
    assert of_model is not None
    free = problem.free
    groups = of_model.members[free]
    weights = np.sqrt(np.minimum(solution.weights, 1.0))[:, None, None]
    rows = (weights * solution.rows).reshape(-1, solution.rows.shape[-1])
    fact_rows = solution.fact_rows[:, free]
    square = gram(rows) + fact_rows.T @ fact_rows
    precision = problem.precision[free]
    scale = 1.0 / np.sqrt(np.diagonal(square) + precision + 1e-300)
    off = (solution.parameters - problem.mean)[free]
    right = scale * (square @ off + precision * off)  # as the fit balances them

    square = scale[:, None] * square * scale
    value, vectors = np.linalg.eigh(square + np.diag(scale**2 * precision))
    none = vectors[:, ~significant(value, squares=True)]  # nothing determines these
    square, none = square + none @ none.T, none @ none.T

    def at(logs: Array) -> tuple[Array, Array]:
        factor = np.where(groups >= 0, np.exp(-2.0 * logs[groups]), 1.0)
        inverse = np.linalg.inv(square + np.diag(scale**2 * precision * factor)) - none
        return inverse @ right, inverse

    variance = np.diagonal(scales.covariance)
    there = of_model.medians >= 1.0  # else misfit, which may not be there
    above, tailed = _moments(variance, np.log(of_model.spreads))
    skew = np.where(there, above, 0.0)
    wider = np.sqrt(np.where(there, tailed / variance, 1.0))
    values, axes = np.linalg.eigh(wider[:, None] * scales.covariance * wider)
    nodes = np.sqrt(3.0 * np.maximum(values, 0.0)) * axes  # of Gauss and Hermite
    first, least = at(np.zeros(len(values)))
    spread = np.zeros_like(square)
    shares = [1.0 - len(values) / 3.0, *[1.0 / 6.0] * 2 * len(values)]
    for share, node in zip(shares, [0.0 * skew, *nodes.T, *-nodes.T], strict=True):
        mean, covariance = at(skew + node)
        spread += share * (covariance - least + np.outer(mean - first, mean - first))
    values, axes = np.linalg.eigh(spread)
    spread = (np.maximum(values, 0.0) * axes) @ axes.T
    result = np.zeros((len(free), len(free)))
    result[np.ix_(free, free)] = scale[:, None] * spread * scale
    return result


def _moments(variance: Array, wide: Array) -> tuple[Array, Array]:
    """(G,) mean, above the most probable value, and variance of logarithms of sizes.
    Where few errors show a size its logarithm has a long upper tail, which ends as what
    was thought of it does. As many errors as make it so sharp have squares of a chi
    squared distribution. The mean is such that 1.96 standard deviations of an error of
    that size hold 95 % of them. ``variance`` (G,) is one over the curvature of the
    density at its top, ``wide`` (G,) a standard deviation of what was thought."""
    from scipy import special

    logs = np.linspace(-3.0, 4.0, 141) * wide[:, None]
    square = np.square(logs / wide[:, None])
    freedom = np.maximum(1.0 / variance - wide**-2.0, 0.0)[:, None] / 2.0
    density = np.exp(-freedom * (logs + 0.5 * np.exp(-2.0 * logs) - 0.5) - 0.5 * square)
    density /= density.sum(axis=1, keepdims=True)
    mean = (density * logs).sum(axis=1)
    spread = (density * np.square(logs - mean[:, None])).sum(axis=1)
    # Three nodes of Gauss and Hermite have this mean square.
    square = (2.0 + np.cosh(2.0 * np.sqrt(3.0 * spread))) / 3.0
    half = np.empty_like(mean)
    for k, row in enumerate(density):
        beyond = row @ special.ndtr(-_ERRORS * np.exp(-logs[k])[:, None])
        half[k] = np.interp(-0.025, -beyond, _ERRORS)
    return np.log(half / 1.96) - 0.5 * np.log(square), spread


def _reduced(problem: FitProblem, solution: FitSolution) -> tuple[Array, Array]:
    """Rows (R, s) by standard deviations of what a prior knows, and readings (R,), free
    of the parameters of which nothing is known."""
    free, precision = problem.free, problem.precision[problem.free]
    slopes = solution.by_theta
    more = len(problem.mean) - len(solution.problem.mean)
    if more:  # misfit that was not fitted
        theta = solution.parameters
        rows = derivative(problem.model, problem.commands, theta)[..., -more:]
        rows = solution.whitened(rows, theta[:-more])
        slopes = np.concatenate([slopes, rows], axis=2)
    # One level for all: what the fit found of how they compare is kept.
    level = solution.level / np.exp(np.log(solution.level).mean())
    size = np.sqrt(np.minimum(solution.weights, 1.0))[:, None] / level
    off = solution.white + slopes @ (solution.parameters - problem.mean)[free]
    right = (size * off).ravel()
    rows = (size[..., None] * slopes).reshape(len(right), -1)
    informed = rows[:, precision > 0.0] / np.sqrt(precision[precision > 0.0])
    flat = rows[:, precision == 0.0]
    if flat.shape[1]:
        flat = flat / (np.linalg.norm(flat, axis=0) + 1e-300)
        informed, right = without(flat, informed, right)
    if not len(right):
        raise ValueError(
            f"measured has {len(rows)} readings, too few for {flat.shape[1]} unknowns "
            "without a prior: measure more"
        )
    return informed, right
