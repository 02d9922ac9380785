"""How large an arm's errors are, from its readings: the scales of the prior's groups.

The prior says how errors of lengths compare with each other, and those of angles; how
large they are altogether is seldom known. Here two factors, of all lengths and all
angles of the table, and the level of the noise make the readings most probable
(marginal likelihood, the model linear about the fit), with a factor of three either
way as what is thought of each beforehand. Sources: MacKay, 1992; Bishop, Pattern
Recognition and Machine Learning, 3.5.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.calibration.solve import Solution, Task
from jaxcal.information.blocks import without
from jaxcal.models import SerialChain
from jaxcal.models.checked import derivative

__all__ = ["group_sizes"]

Array = NDArray[np.float64]

_THOUGHT = np.log(3.0)  # standard deviation of the logarithm of each factor
_MOST = 5.0  # of a logarithm


def group_sizes(arm: SerialChain, task: Task, found: Solution) -> Array:
    """(p,) factors of the prior's standard deviations: lengths, angles, others one.

    Args:
        arm: whose table has the groups.
        task: with the prior that the factors are of.
        found: a fit with any such prior; the model is made linear there.
    """
    from scipy import optimize

    p = len(arm.names)
    in_table = np.arange(p) < arm.table.size
    lengths = in_table & (np.array(arm.units) == "length")
    groups = np.where(lengths, 0, np.where(in_table, 1, 2))
    rows, right = _reduced(arm, task, found)
    sized = task.free[:p] & (task.precision[:p] > 0.0)
    groups = np.asarray(groups)[sized]
    count, width = len(right), rows.shape[1]
    # All that the readings say is in a triangle; the rest of them is noise alone.
    triangle = np.asarray(np.linalg.qr(np.column_stack([rows, right]), mode="r"))
    top = min(width, len(triangle))
    rest = float((triangle[top:, width] ** 2).sum())
    rows, right = triangle[:top, :width], triangle[:top, width]

    def cost(logs: Array) -> float:
        """-2 log marginal likelihood, and what is thought of the factors."""
        scaled = rows * np.exp(np.append(logs[:2], 0.0))[groups]
        level = np.exp(2.0 * logs[2])
        root = np.linalg.cholesky(scaled @ scaled.T + level * np.eye(top))
        white = np.linalg.solve(root, right)
        likely = 2.0 * np.log(np.diagonal(root)).sum() + white @ white
        alone = (count - top) * 2.0 * logs[2] + rest / level
        return float(likely + alone + ((logs / _THOUGHT) ** 2).sum())

    most = 1e-9 if task.known else _MOST
    bounds = [(-_MOST, _MOST), (-_MOST, _MOST), (-most, most)]
    best = optimize.minimize(cost, np.zeros(3), method="L-BFGS-B", bounds=bounds)
    factors = np.ones(p)
    factors[lengths] = np.exp(best.x[0])
    factors[in_table & ~lengths] = np.exp(best.x[1])
    return factors


def _reduced(arm: SerialChain, task: Task, found: Solution) -> tuple[Array, Array]:
    """Rows (R, s) by standard deviations of what a prior knows, and readings (R,).

    In units of the noise, the usual one where it is not known, and free of the
    parameters of which nothing is known.
    """
    p = len(arm.names)
    theta, free, precision = found.parameters[:p], task.free[:p], task.precision[:p]
    white = task.white
    if not task.known:
        white = white / np.asarray(arm.default_noise().std)[:, None]
    white = white * np.sqrt(np.minimum(found.weights, 1.0))[:, None, None]
    slopes = derivative(arm, task.commands, theta)
    off = found.residuals[..., None] + slopes @ (theta - task.mean[:p])[:, None]
    right = (white @ off).ravel()
    rows = (white @ slopes).reshape(len(right), p)
    known = rows[:, free & (precision > 0.0)]
    known = known / np.sqrt(precision[free & (precision > 0.0)])
    flat = rows[:, free & (precision == 0.0)]
    if flat.shape[1]:
        flat = flat / (np.linalg.norm(flat, axis=0) + 1e-300)
        known, right = without(flat, known, right)
    return known, right
