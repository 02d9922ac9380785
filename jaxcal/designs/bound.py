"""What no k commands within the limits better.

With M0 and G0, the gradient of phi there, of any weighted design, no k commands have a
larger phi than

    phi(M0) + trace(G0 (P - M0)) + k max of d0(u),

which is tight where M0 is the best weighted design (the equivalence theorem of Kiefer
and Wolfowitz). That maximum over the limits is found by a search, so the bound is no
proof, but for y = A u + b, where d is convex and a corner is its largest.
"""

from __future__ import annotations

import functools

import numpy as np

from jaxcal.checks import Array
from jaxcal.designs.ascent import SHARP, Ascent, leverage, peaks, squares
from jaxcal.designs.box import descended

_ROUNDS = 12
_SHARP = (30.0, 300.0, 3000.0)  # of the largest d, by one over it
_CORNERS = 14  # inputs up to which all corners are looked at
_TOLD = 1e-4  # efficiency that another round must gain
_SETTLED = 1e-6  # of a weight, which would not change in another round


def upper_bound(ascent: Ascent, commands: Array, phi: float) -> tuple[float, bool]:
    """Upper bound on phi of k commands, of which these have phi; is it proven?

    The best weighted design of the commands and the peaks found so far gives M0.
    """
    model, limits, k = ascent.offer.model, ascent.box.limits, len(commands)
    certain = model.affine(model.nominal) is not None and len(limits) <= _CORNERS
    support, blocks = commands, ascent.blocks(commands)
    weights, best = np.ones(k) / k, np.inf
    lowered = ascent.smooth and not ascent.worst  # E: its metric is found by itself
    metric = ascent.gradient(ascent.information(blocks))
    for _ in range(_ROUNDS):
        begun = weights
        if lowered:
            metric, information = _lowered(ascent, metric, blocks), ascent.prior
            value = float((metric * ascent.prior).sum())
        else:
            weights = _weights(ascent, blocks, weights)
            roots = np.sqrt(k * weights)[:, None, None, None]
            information = ascent.information(roots * blocks)
            value = float(ascent.phi(information))
            if not np.isfinite(value):
                break
            if ascent.worst:
                sharp = SHARP[-1] / ascent.unit(value)
                _, metric, value = ascent.soft(information, sharp)
            else:
                metric = ascent.gradient(information)
        off = float((metric * (ascent.prior - information)).sum())
        if certain:
            ends = np.array(np.meshgrid(*limits)).reshape(len(limits), -1).T
            heights = leverage(ascent.blocks(ends), metric)
        else:
            ends, heights = peaks(ascent, metric)
            heights = np.append(heights, leverage(blocks, metric))
            ends = np.concatenate([ends, support])
        highest, before = float(heights.max()), best
        best = min(best, value + off + k * highest)
        gap = _share(ascent, phi, best)
        if gap > 1.0 - 1e-9 or ascent.deadline.passed:
            break
        if np.isfinite(before) and gap - _share(ascent, phi, before) < _TOLD:
            if k * highest + off < 1e-6 * max(abs(value), 1.0):
                break
        # The highest that are not in the support yet.
        new = ends[np.argsort(-heights)[: 2 * ascent.problem.num_regressors]]
        apart = np.abs((new[:, None] - support) / ascent.box.span).max(axis=2)
        new = new[(apart > 1e-6).all(axis=1)]
        if len(new):
            support = np.concatenate([support, new])
            blocks = np.concatenate([blocks, ascent.blocks(new)])
            fill = np.full(len(new), 0.02 / len(new))
            weights = np.concatenate([0.98 * weights, fill])
        elif lowered or np.abs(weights - begun).max() < _SETTLED:
            break  # the weights have converged
    return max(best, phi), certain


def _share(ascent: Ascent, phi: float, bound: float) -> float:
    """The efficiency that a bound leaves."""
    criterion = ascent.problem.criterion
    value, best = map(float, map(criterion.reported, (phi, bound)))
    return float(criterion.efficiency(value, best))


def _lowered(ascent: Ascent, metric: Array, blocks: Array) -> Array:
    """(S, p, p) of which E's bound at blocks (N, S, q, p) and the spread is low.

    Any W of trace 1 in E's coordinates bounds k commands by ``trace(W P)`` and k times
    the largest ``trace(W B.T B)``: convex, and lowered here by the square root of each
    scenario's W, the largest smoothed.
    """
    grams = squares(np.concatenate([blocks, ascent.spread[1]]))
    roots = np.stack([member.criterion.root for member in ascent.problem.members])
    halves, k, prior = np.linalg.inv(roots), ascent.problem.k, ascent.prior
    sizes = (ascent.scale * ascent.weights)[:, None, None]
    values, vectors = np.linalg.eigh(
        roots @ metric @ np.matrix_transpose(roots) / sizes
    )
    begun = vectors * np.sqrt(np.maximum(values, 1e-6))[:, None, :]
    unit = k * float(leverage(blocks, metric).max())

    def of(x: Array) -> tuple[Array, Array, Array]:
        v = x.reshape(begun.shape)
        v = v / np.sqrt((v * v).sum(axis=(1, 2), keepdims=True))
        along = halves @ v
        return v, along, sizes * along @ np.matrix_transpose(along)

    def down(x: Array, sharp: float) -> tuple[float, Array]:
        v, along, w = of(x)
        d = np.tensordot(grams, w, 3) * k / unit
        e = np.exp(sharp * (d - d.max()))
        mean = np.tensordot(e / e.sum(), grams, 1)
        slope = (prior + k * mean) / unit
        value = d.max() + np.log(e.sum()) / sharp + (w * prior).sum() / unit
        slope = 2.0 * sizes * np.matrix_transpose(halves) @ slope @ along
        slope -= (slope * v).sum(axis=(1, 2), keepdims=True) * v
        return float(value), slope.ravel()

    x = begun.ravel()
    for sharp in _SHARP:
        smoothed = functools.partial(down, sharp=sharp)
        x = descended(smoothed, x, -np.inf, np.inf, 300, ascent.deadline)
        x = of(x)[0].ravel()
    return of(x)[2]


def _weights(ascent: Ascent, blocks: Array, weights: Array) -> Array:
    """(N,) of sum 1, near the best for k commands at these blocks (N, S, q, p)."""
    grams = ascent.problem.k * squares(blocks)
    information = np.tensordot(weights, grams, 1) + ascent.prior
    unit = ascent.unit(float(ascent.phi(information)))

    def down(z: Array, sharp: float) -> tuple[float, Array]:
        e = np.exp(z - z.max())
        w = e / e.sum()
        information = np.tensordot(w, grams, 1) + ascent.prior
        phi = float(ascent.phi(information))
        if not np.isfinite(phi) and ascent.each.kind != "least":
            return 1e10, np.zeros_like(z)
        value, metric = ascent.goal(information, phi, sharp, unit)
        slope = (grams * metric).sum(axis=(1, 2, 3))
        return -value, -w * (slope - w @ slope)

    logits = np.log(np.maximum(weights, 1e-9))
    for sharp in SHARP if ascent.smooth else SHARP[:1]:
        smoothed = functools.partial(down, sharp=sharp)
        logits = descended(smoothed, logits, -np.inf, np.inf, 300, ascent.deadline)
    e = np.exp(logits - logits.max())
    return np.asarray(e / e.sum())
