"""How large a machine's errors are, from its readings: the scales of a prior's groups.

The prior says how errors of one kind compare with each other; how large they are
altogether is seldom known. Here a factor for each of the model's ``error_groups()`` and
the level of the noise make the readings most probable (marginal likelihood, the model
linear about the fit), with what the model thinks of each factor beforehand.

Sources: MacKay, 1992; Bishop, Pattern Recognition and Machine Learning, 3.5.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxcal.calibration.least_squares import FitProblem, FitSolution, whiten
from jaxcal.information.blocks import gram, triangle, without
from jaxcal.information.singular import significant
from jaxcal.models.model import ErrorGroups, Model, derivative

__all__ = ["PriorScales", "covariance_of_scales", "group_scales", "misfit_scale"]

Array = NDArray[np.float64]

_LEVEL = 3.0  # factor of one standard deviation of the level, beforehand
_MOST = 5.0  # of a logarithm
_TRIED = np.array([-5.0, -4.0, -3.0, -2.0, -1.2, -0.4, 0.4, 1.2])  # likewise
_SCORES = 100  # steps of Fisher's scoring, at most


class PriorScales(NamedTuple):
    """Factors of the prior's standard deviations."""

    logs: Array  # (G + 1,) of the groups' factors and the level
    factors: Array  # (p,) 1 of parameters of no group
    groups: NDArray[np.int64]  # (p,) -1 of no group
    covariance: Array  # (G, G) of the logarithms of the groups' factors


def group_scales(
    problem: FitProblem, solution: FitSolution, start: PriorScales | None
) -> PriorScales:
    """The factors that make the readings most probable.

    Args:
        problem: with the prior that the factors are of, and a model with groups.
        solution: a fit with any such prior; the model is made linear there.
        start: where the search begins; with factors of one where there is nothing.
    """
    p = len(problem.mean)
    of_model = problem.model.error_groups()
    assert of_model is not None
    groups, num_groups = of_model.members, len(of_model.medians)
    middle, wide = _thought(of_model)
    cost = _evidence(problem, solution, of_model)
    # A level that is known floats too: misfit beyond it is no size of the errors.
    best = middle if start is None else start.logs
    least, slope, curve = cost(best)
    for _ in range(_SCORES):
        step = np.linalg.solve(curve, slope)
        trial = np.clip(best - step, -_MOST, _MOST)
        while (after := cost(trial))[0] > least + 1e-9:
            step *= 0.5
            trial = np.clip(best - step, -_MOST, _MOST)
        gain, best = least - after[0], trial
        least, slope, curve = after
        if gain < 1e-4:
            break
    factors = np.ones(p)
    factors[groups >= 0] = np.exp(best[groups[groups >= 0]])
    if start is None:  # of a rough fit, which begin the next
        return PriorScales(best, factors, groups, np.zeros((num_groups, num_groups)))
    steps = 1e-3 * np.eye(len(best))
    curves = [cost(best + step)[1] - cost(best - step)[1] for step in steps]
    # Half the cost's, in units of what was thought, which the readings only sharpen.
    curve = np.array(curves) / 4e-3 * np.outer(wide, wide)
    size, axes = np.linalg.eigh(curve)
    axes = wide[:, None] * axes
    inside = (axes / np.maximum(size, 1.0)) @ axes.T
    return PriorScales(best, factors, groups, inside[:num_groups, :num_groups])


def _thought(groups: ErrorGroups) -> tuple[Array, Array]:
    """(G + 1,) of the logarithms beforehand: the middle, and a standard deviation."""
    wide = np.log(np.append(groups.spreads, _LEVEL))
    return np.log(np.append(groups.medians, 1.0)), wide


def _evidence(
    problem: FitProblem, solution: FitSolution, groups: ErrorGroups
) -> Callable[[Array], tuple[float, Array, Array]]:
    """-2 log marginal likelihood of the logarithms (G + 1,), with slope and curve."""
    from scipy.linalg.lapack import dpotrf, dtrtri

    middle, wide = _thought(groups)
    rows, right = _reduced(problem, solution)
    sized = groups.members[problem.free & (problem.precision > 0.0)]
    count, width = len(right), rows.shape[1]
    # All that the readings say is in a triangle; the rest of them is noise alone.
    factor = triangle(np.column_stack([rows, right]))
    top = min(width, len(factor))
    rest = float((factor[top:, width] ** 2).sum())
    rows, right = factor[:top, :width], factor[:top, width]
    member = sized == np.arange(len(groups.medians))[:, None]  # (groups, s)

    def cost(logs: Array) -> tuple[float, Array, Array]:
        """-2 log marginal likelihood with what is thought of the factors.

        Its slope and what its curvature is expected to be beside it.
        """
        scaled = rows * np.exp(logs[:-1] @ member)
        level = np.exp(2.0 * logs[-1])
        square = gram(scaled.T) + level * np.eye(top)
        root, failed = dpotrf(square)
        if failed:  # beyond rounding
            inverse, log_det = np.linalg.inv(square), np.linalg.slogdet(square)[1]
        else:
            inverse = gram(dtrtri(root)[0].T)
            log_det = 2.0 * np.log(root.diagonal()).sum()
        white, seen = inverse @ right, inverse @ scaled
        spread = member @ (seen * scaled).sum(axis=0)
        alone = (count - top) * 2.0 * logs[-1] + rest / level
        value = right @ white + alone + log_det
        slope = np.append(
            spread - member @ (white @ scaled) ** 2,
            level * (np.trace(inverse) - white @ white) + count - top - rest / level,
        )
        curve = np.diag(wide**-2.0)
        curve[:-1, :-1] += 2.0 * member @ (scaled.T @ seen) ** 2 @ member.T
        curve[-1, :-1] = curve[:-1, -1] = 2.0 * level * member @ (seen**2).sum(axis=0)
        curve[-1, -1] += 2.0 * (level**2 * (inverse**2).sum() + count - top)
        off = (logs - middle) / wide
        value = float(value + off @ off)
        return value, 2.0 * (slope + off / wide), 2.0 * curve

    return cost


def misfit_scale(
    with_misfit: Model, problem: FitProblem, solution: FitSolution, scales: PriorScales
) -> tuple[float, float]:
    """What misfit that was not fitted would gain, and how large it is.

    Args:
        with_misfit: the model with it: its last parameters, the last of its groups.
        problem: without it, with the prior that the factors are of.
        solution: its solution.
        scales: of it.

    Returns:
        How much less -2 log marginal likelihood is at best with it, and the root of its
        mean squared factor.
    """
    more = len(with_misfit.names) - len(problem.mean)
    std = np.asarray(with_misfit.default_prior().std)[-more:]
    groups = with_misfit.error_groups()
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
    cost = _evidence(whole, beside, groups)
    middle, wide = _thought(groups)
    logs, least = scales.logs.copy(), np.zeros(len(_TRIED))
    rest = np.flatnonzero(np.arange(len(logs)) != len(logs) - 2)
    for k, tried in enumerate(_TRIED):
        logs[-2] = tried
        for _ in range(2):  # steps of the other scales
            _, slope, curve = cost(logs)
            step = np.linalg.solve(curve[np.ix_(rest, rest)], slope[rest])
            logs[rest] = np.clip(logs[rest] - np.clip(step, -1.0, 1.0), -_MOST, _MOST)
        least[k] = cost(logs)[0]
    shares = np.exp(-0.5 * (least - least.min()))
    square = float(shares @ np.exp(2.0 * _TRIED) / shares.sum())
    gains = least - ((_TRIED - middle[-2]) / wide[-2]) ** 2
    return float(gains[0] - gains.min()), float(np.sqrt(square))


def covariance_of_scales(
    problem: FitProblem, solution: FitSolution, scales: PriorScales
) -> Array:
    """(P, P) what the scales, which are estimates too, add to the covariance.

    Mean and covariance of the parameters are averaged over the scales; the model is
    linear.
    """
    free = problem.free
    groups = scales.groups[free]
    weights = np.sqrt(np.minimum(solution.weights, 1.0))[:, None, None]
    rows = (weights * solution.rows).reshape(-1, solution.rows.shape[-1])
    fact_rows = problem.model.facts(solution.parameters)[1][:, free]
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

    # The logarithm of a size has a long upper tail where few errors show it: its mean
    # is above the most probable one, by its variance, less where the prior sets it.
    of_model = problem.model.error_groups()
    assert of_model is not None
    variance = np.diagonal(scales.covariance)
    skew = variance * (1.0 - variance / _thought(of_model)[1][:-1] ** 2)
    skew = np.where(of_model.medians < 1.0, 0.0, skew)  # of what may not be there
    wider = np.sqrt(1.0 + 2.0 * skew)
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


def _reduced(problem: FitProblem, solution: FitSolution) -> tuple[Array, Array]:
    """Rows (R, s) by standard deviations of what a prior knows, and readings (R,).

    Free of the parameters of which nothing is known.
    """
    free, precision = problem.free, problem.precision[problem.free]
    slopes = solution.by_theta
    if problem.model is not solution.problem.model:
        theta = solution.parameters
        slopes = derivative(problem.model, problem.commands, theta)[..., free]
        slopes = whiten(problem.white, slopes)
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
    return informed, right
