"""Designs whose commands are any within limits: ``optimise`` and ``Design.refine``.

A criterion phi is a concave function of the information M of all k commands; over
scenarios, their mean or least is one of the S informations together. All commands climb
together from several starts, then one by one. With M0 and G0, the gradient of phi
there, of the best weighted design of what was found, no k commands have a larger phi
than

    phi(M0) + trace(G0 (P - M0)) + k max of d0(u).

That maximum over the limits is found by a search, so the bound is no proof, but for
y = A u + b, where d is convex and a corner is its largest.

Sources: Pukelsheim, Optimal Design of Experiments; Meyer and Nachtsheim, 1995.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import (
    Array,
    aligned,
    array_of,
    in_words,
    require_none,
    seconds,
    whole_number,
)
from jaxcal.deadline import Deadline
from jaxcal.designs.ascent import (
    POOL,
    SHARP,
    Ascent,
    ascent_of,
    climbed,
    leverage,
    peaks,
    squares,
    swapped,
)
from jaxcal.designs.box import Allowed, affordable, box_of, descended
from jaxcal.models.linear import Affine
from jaxcal.models.model import Model, as_model
from jaxcal.models.uncertainty import Noise, Prior
from jaxcal.selection.criteria import ScenarioCriterion
from jaxcal.selection.design import Design
from jaxcal.selection.exchange.exchange import exchange_indices
from jaxcal.selection.problem import CandidateSet, Problem, ScenarioProblem, problem_of
from jaxcal.selection.result import Selection

_ROUNDS = 12
_SHARP_OF_E = (30.0, 300.0, 3000.0)  # of the largest d, by one over it
_CORNERS = 14  # inputs up to which all corners are looked at
_TOLD = 1e-4  # efficiency that another round must gain
_SETTLED = 1e-6  # of a weight, which would not change in another round


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Refinement(Selection):
    """Commands between the candidates: the first k rows of ``problem.candidates``."""

    began: float = np.nan  # value of the design that it began with
    certain: bool = False  # the bound is proven

    @property
    def commands(self) -> Array:
        """(k, n)."""
        assert self.problem.candidates is not None
        return self.problem.candidates[self.indices]

    _noun = "command"

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, text and lists, as a JSON file takes them."""
        content = super().to_dict()
        del content["indices"], content["labels"]
        return content | {
            "commands": content.pop("candidates"),
            "began": None if np.isnan(self.began) else self.began,
            "bound_is_proven": self.certain,
        }

    def _table(self) -> list[str]:
        rows = [[f"{x:.6g}" for x in row] for row in self.commands]
        title = f"{len(rows)} commands, method {self.method}"
        return [title, *aligned([self._axes(), *rows])]

    def _limit(self) -> str:
        began = "" if np.isnan(self.began) else f"started at {self.began:.6g}; "
        proof = "proven" if self.certain else "by a search, not a proof"
        return f"{began}{super()._limit()}, {proof}"


def optimise(
    limits: ArrayLike,
    k: int | None = None,
    model: Model | None = None,
    *,
    prior: Prior | None = None,
    noise: Noise | None = None,
    criterion: Any = None,
    region: ArrayLike | None = None,
    measured: ArrayLike | None = None,
    allowed: Allowed | None = None,
    starts: int = 8,
    seed: int = 0,
    time_limit: float = 60.0,
    scenarios: Any = None,
) -> Refinement:
    """The k commands within limits whose measurements say most about the parameters.

    Args:
        limits: (n, 2) least and greatest command of each input.
        k: commands to choose, which may repeat; the fewest that identify when None.
        model: of ``jaxcal.models``; ``y = A u + b`` when not given.
        prior, noise, criterion, measured, scenarios: as of ``Design`` and ``select``.
        region: (R, n) commands of criterion I; spread over the limits when not given.
        allowed: f(u (n,)) -> whether the command may be given.
        starts, seed: of the search; of points that are drawn.
        time_limit: seconds, after which the best so far is returned.
    """
    deadline = Deadline(seconds("time_limit", time_limit))
    box = box_of(limits, allowed, getattr(model, "inputs", ()))
    n, starts = len(box.limits), whole_number("starts", starts, 1)
    model = as_model(model) if model is not None else Affine(n, n)
    count = affordable(model, box, deadline, max(16, 3 * (k or 1)), POOL)
    drawn, more = box.drawn(count, seed), {"scenarios": scenarios}
    offer = CandidateSet(
        drawn, model, prior, noise, measured, max_replicates=POOL, **more
    )
    ascent = ascent_of(offer, box, k, criterion, region, seed, deadline)
    return _refined(ascent, None, starts)


def refine(
    design: Design,
    selection: Selection | ArrayLike,
    limits: ArrayLike | None = None,
    *,
    criterion: Any = None,
    region: ArrayLike | None = None,
    allowed: Allowed | None = None,
    starts: int = 4,
    seed: int = 0,
    time_limit: float = 60.0,
) -> Refinement:
    """The chosen commands moved between the candidates to a better design.

    Args:
        design: what may be measured; ``design.refine(selection, ...)`` asks the same.
        selection: what to begin with, or its (k,) indices; the answer is never worse.
        limits: (n, 2) least and greatest command of each input; the range of the
            available candidates when not given.
        criterion: that of the selection when not given.
        region: of I; the available candidates when not given.
        allowed: f(u (n,)) -> whether a command may be given.
        starts, seed: of the search, the selection among them; of points that are drawn.
        time_limit: seconds, after which the best so far is returned.
    """
    deadline = Deadline(seconds("time_limit", time_limit))
    offer: CandidateSet = design
    candidates, available = offer.candidates, offer.available
    if offer.constraints is not None:
        raise ValueError("constraints work with select and score, not with refine")
    if offer.model is None or candidates is None:
        raise ValueError("refine needs candidates and a model, not blocks")
    rows: Any = selection
    if isinstance(selection, Selection):
        rows = selection.indices
        criterion = _same_criterion(selection) if criterion is None else criterion
    rows = array_of("selection", rows, "k")
    require_none(rows % 1.0 != 0.0, rows, "selection must hold whole numbers")
    outside = (rows < 0) | (rows >= len(candidates))
    require_none(outside, rows, f"selection must lie in [0, {len(candidates)})")
    rows = rows.astype(np.int64)
    require_none(~available[rows], rows, "selection must hold available candidates")
    begun = candidates[rows]
    limits = _range(candidates[available], allowed) if limits is None else limits
    box, n = box_of(limits, allowed, offer.columns), candidates.shape[1]
    if len(box.limits) != n:
        got = box.limits.shape
        raise ValueError(f"limits must be ({n}, 2) for this model, got {got}")
    beyond = begun != box.within(begun)
    require_none(beyond, begun, "selection must be within the limits")
    for command in begun[~box.permitted(begun)]:
        raise ValueError(
            f"allowed is False for the starting command {in_words(command)}"
        )
    starts = whole_number("starts", starts, 1)
    ascent = ascent_of(offer, box, len(begun), criterion, region, seed, deadline)
    return _refined(ascent, begun, starts)


def _range(commands: Array, allowed: Allowed | None) -> Array:
    """(n, 2) least and greatest of commands (N, n), of joints the arm's own limits."""
    limits = np.stack([commands.min(axis=0), commands.max(axis=0)], axis=1)
    joints = np.asarray(getattr(allowed, "limits", np.zeros((0, 2))))
    limits[: len(joints)] = joints
    still = limits[:, 0] == limits[:, 1]  # a column that holds one value
    limits[still, 1] += 1e-9 * np.maximum(np.abs(limits[still, 1]), 1.0)
    return limits


def _same_criterion(selection: Selection) -> Any:
    """The criterion of a selection, asked for again."""
    criterion = selection.problem.criterion
    if isinstance(criterion, ScenarioCriterion):
        return criterion
    if criterion.by_name:
        raise ValueError(
            f"criterion {criterion.name} must be repeated with its parameters: "
            f"refine(..., criterion=jaxcal.{type(criterion).__name__}([...]))"
        )
    return criterion.name


def _refined(ascent: Ascent, begun: Array | None, starts: int) -> Refinement:
    """The best from ``begun`` (k, n), and other starts."""
    offer, criterion_within = ascent.offer, ascent.problem.criterion
    first_phi = -np.inf if begun is None else ascent.phi_of(begun)
    best, best_phi = begun, first_phi
    for start in _starts(ascent, begun, starts):
        commands, phi = climbed(ascent, start)
        if phi > best_phi:
            best, best_phi = commands, phi
        if ascent.deadline.passed:
            break
    if best is None or not np.isfinite(best_phi):
        raise ValueError(
            "limits allow no design that identifies every parameter: the best found is "
            "singular"
        )
    best, best_phi = swapped(ascent, best, best_phi)
    bound, certain = upper_bound(ascent, best, best_phi)
    began = np.nan if begun is None else float(criterion_within.reported(first_phi))
    problem = _judged(ascent, best)
    value, log_det = problem.values(np.arange(len(best))[None])
    return Refinement(
        np.arange(len(best)), float(value[0]), float(log_det[0]),
        "optimise" if begun is None else "refine", False, ascent.deadline.elapsed_s,
        problem, seed=ascent.seed, known_bound=float(criterion_within.reported(bound)),
        axes=offer.axes or offer.columns or None,
        began=began, certain=certain,
    )  # fmt: skip


def _starts(ascent: Ascent, begun: Array | None, count: int) -> Iterator[Array]:
    """Designs (k, n), the best guesses first; none of them singular."""
    rng, problem = np.random.default_rng(ascent.seed), ascent.problem
    candidates = ascent.offer.candidates
    usable = np.flatnonzero(ascent.offer.available)
    if begun is not None:
        yield begun
        count -= 1
        usable = usable[ascent.box.permitted(candidates[usable])]
    for i in range(count):
        share = usable
        if i:  # another part of the pool
            few = max(4 * problem.num_regressors, 2 * problem.k, 24)
            share = rng.permutation(usable)[: min(few, len(usable))]
        one = _among(problem, np.isin(np.arange(len(candidates)), share))
        try:
            yield candidates[exchange_indices(one, 10, ascent.seed + i)]
        except ValueError:  # singular: another part
            continue


def _among(problem: Problem, available: NDArray[np.bool_]) -> Problem:
    """The problem where these may be chosen, each as often as there are commands."""
    rules: dict[str, Any] = {
        "available": available,
        "required": np.zeros(0, dtype=np.int64),
        "max_replicates": problem.k,
    }
    if isinstance(problem, ScenarioProblem):
        rules["members"] = tuple(_among(one, available) for one in problem.members)
    return dataclasses.replace(problem, **rules)


def _judged(ascent: Ascent, commands: Array) -> Problem:
    """The problem of commands (k, n), which come first, and all candidates."""
    offer, joint = ascent.offer, ascent.problem.joint
    criterion, region = ascent.question
    pool = offer.candidates[offer.available]
    of_one = getattr(criterion, "criterion", criterion)
    if region is getattr(of_one, "region", None) is None and ascent.each.of_region:
        region = pool
    beside = CandidateSet(
        np.concatenate([commands, pool]), offer.model, offer.prior, offer.noise,
        offer.measured, scenarios=tuple(offer.scenarios) if joint else None,
    )  # fmt: skip
    beside.axes = offer.axes
    return problem_of(beside, len(commands), criterion, region)


def upper_bound(ascent: Ascent, commands: Array, phi: float) -> tuple[float, bool]:
    """Upper bound on phi of k commands, of which these have phi; is it proven?"""
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
    for sharp in _SHARP_OF_E:
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
