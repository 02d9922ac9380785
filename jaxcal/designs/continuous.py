"""Designs whose commands are any within limits: ``optimise`` and ``Design.refine``.

A criterion phi is a concave function of the information M of all k commands; over
scenarios, their mean or least is one of the S informations together. With G its
gradient at M, the slope of phi by one command u is that of ``d(u) = trace(B G B.T)``, B
the block there. So all commands climb together, from several starts; then single ones
are moved to where d is largest, and those that must stay where ``allowed`` says move by
trial.

How good: with M0 and G0 of any weighted design, no k commands are better than

    phi(M0) + trace(G0 (P - M0)) + k max of d0(u),

which is tight where M0 is the best weighted design (the equivalence theorem of Kiefer
and Wolfowitz). That maximum over the limits is found by a search, so the bound is no
proof, but for y = A u + b, where d is convex and a corner is its largest.

Sources: Pukelsheim, Optimal Design of Experiments; Meyer and Nachtsheim, 1995.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
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
from jaxcal.models.affine import Affine
from jaxcal.models.model import Model, as_model
from jaxcal.models.uncertainty import Noise, Prior
from jaxcal.selection.criteria import Criterion
from jaxcal.selection.design import Design
from jaxcal.selection.exchange.exchange import exchange_indices
from jaxcal.selection.problem import (
    CandidateSet,
    Problem,
    ScenarioProblem,
    blocks_of,
    problem_of,
)
from jaxcal.selection.problem.scenarios import ScenarioCriterion
from jaxcal.selection.result import Selection

Allowed = Callable[[Array], Any]

_POOL, _SEARCH = 512, 2048  # points that starts, and the largest d, are looked for in
_ASCENTS = 12  # of the best points, for the largest d
_ROUNDS, _SWAPS = 12, 6  # of the bound; of moving single commands
_TRIALS, _SMALLEST = 24, 1e-6  # of a command, in a round of trial; share of the limits
_PAIRED, _GAIN = 6, 1e-7  # inputs up to which differences are tried; of log efficiency
_STEP = 1e-5  # share of the limits, of differences where a model has no derivative
_ROUGH = 1e-3  # the same where derivatives are differences already
_SHARP = (10.0, 50.0, 250.0)  # of the least eigenvalue, by one over it
_SHARP_BOUND = (30.0, 300.0, 3000.0)  # of the largest d, by one over it
_CORNERS = 14  # inputs up to which all corners are looked at
_DRAWS = 200  # batches of points, until enough are allowed
_TOLD = 1e-4  # efficiency that another round of the bound must gain
_SETTLED = 1e-6  # of a weight, which would not change in another round


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Refinement(Selection):
    """Commands between the candidates: the first k rows of ``problem.candidates``."""

    began: float = np.nan  # value of the design that it began with
    search_error: float = np.nan  # share by which two searches for the bound disagree
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
            "search_error": self.search_error,
            "bound_is_proven": self.certain,
        }

    def _table(self) -> list[str]:
        rows = [[f"{x:.6g}" for x in row] for row in self.commands]
        title = f"{len(rows)} commands, method {self.method}"
        return [title, *aligned([self._axes(), *rows])]

    def _limit(self) -> str:
        began = "" if np.isnan(self.began) else f"started at {self.began:.6g}; "
        proof = "proven"
        if not self.certain:
            off = f"repeated searches differ by {self.search_error:.1g}"
            proof = f"by a search, not a proof; {off}"
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

    Raises:
        ValueError: naming the argument, the rule and the value.
    """
    deadline, box = Deadline(seconds("time_limit", time_limit)), _limits(limits)
    model = as_model(model) if model is not None else Affine(len(box), len(box))
    count = _affordable(model, box, deadline, max(16, 3 * (k or 1)), _POOL)
    pool = _drawn(box, count, allowed, seed)
    offer = CandidateSet(
        pool, model, prior, noise, measured, max_replicates=_POOL, scenarios=scenarios
    ).checked()
    search = _Ascent(offer, box, allowed, k, criterion, region, seed, deadline)
    return search.run(None, whole_number("starts", starts, 1))


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

    Raises:
        ValueError: naming the argument, the rule and the value.
    """
    deadline = Deadline(seconds("time_limit", time_limit))
    offer = design.candidate_set
    candidates, available = offer.candidates, offer.available
    if offer.constraints is not None:
        raise ValueError("constraints work with select and score, not with refine")
    if offer.model is None or candidates is None:
        raise ValueError("refine needs candidates and a model, not blocks")
    rows: Any = selection
    if isinstance(selection, Selection):
        rows = selection.indices
        criterion = _same_criterion(selection) if criterion is None else criterion
    rows = array_of("selection", rows, "k").astype(np.int64)
    outside = (rows < 0) | (rows >= len(candidates))
    require_none(outside, rows, f"selection must lie in [0, {len(candidates)})")
    begun = candidates[rows]
    box = _limits(_range(candidates[available], allowed) if limits is None else limits)
    n = candidates.shape[1]
    if len(box) != n:
        raise ValueError(f"limits must be ({n}, 2) for this model, got {box.shape}")
    beyond = (begun < box[:, 0]) | (begun > box[:, 1])
    require_none(beyond, begun, "selection must be within the limits")
    for command in begun[~_permitted(allowed, begun)]:
        raise ValueError(
            f"allowed is False for the starting command {in_words(command)}"
        )
    search = _Ascent(offer, box, allowed, len(begun), criterion, region, seed, deadline)
    return search.run(begun, whole_number("starts", starts, 1))


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


def _affordable(
    model: Model, box: Array, deadline: Deadline, least: int, most: int
) -> int:
    """Points at which a model may be asked for derivatives in an eighth of the time:
    only a function's differences cost what it costs."""
    if not model.resolution:
        return most
    begun, points = time.perf_counter(), box.mean(axis=1)[None].repeat(2, axis=0)
    points[1] += 0.1 * np.ptp(box, axis=1)
    model.jacobian(points, None)
    point_s = 0.5 * (time.perf_counter() - begun)
    return int(np.clip(0.125 * deadline.remaining_s / point_s, least, most))


def _limits(limits: ArrayLike) -> Array:
    box = array_of("limits", limits, "n", 2)
    bad = box[~(box[:, 0] < box[:, 1])]
    if not len(box) or len(bad):
        got = in_words(bad[0]) if len(bad) else "none"
        raise ValueError(f"limits must be (n, 2), lower below upper, got {got}")
    return box


def _moved(allowed: Allowed | None, commands: Array) -> Array:
    """(L, n) commands that are allowed; an arm's are moved to where it is measured."""
    onto = getattr(allowed, "onto", None)
    if onto is None:
        return commands[_permitted(allowed, commands)]
    moved, there = onto(commands)
    return np.asarray(moved[there])


def _permitted(allowed: Allowed | None, commands: Array) -> NDArray[np.bool_]:
    if allowed is None:
        return np.ones(len(commands), dtype=np.bool_)
    if not callable(allowed):
        raise ValueError(f"allowed must be a function of one command, got {allowed!r}")
    return np.array([bool(allowed(row.copy())) for row in commands], dtype=np.bool_)


def _drawn(box: Array, count: int, allowed: Allowed | None, seed: int) -> Array:
    """(count, n) allowed points that fill the limits evenly, corners among them; where
    few are allowed, points next to them too: a thin set is found by its neighbours."""
    n, rng = len(box), np.random.default_rng(seed)
    # The sequence of Roberts (2018): shares of the root of x^(n + 1) = x + 1.
    root = 2.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / (n + 1.0))
    shares, shift = root ** -np.arange(1.0, n + 1.0), rng.random(n)

    def even(first: int, size: int) -> Array:
        return (shift + np.arange(first, first + size)[:, None] * shares) % 1.0

    corners = np.zeros((0, n))
    if 1 << n <= count // 2:
        corners = np.array(np.meshgrid(*[[0.0, 1.0]] * n)).reshape(n, -1).T
    drawn, size = np.zeros((0, n)), count
    unit = np.concatenate([corners, even(0, size)])
    for batch in range(_DRAWS):
        points = box[:, 0] + unit * np.ptp(box, axis=1)
        drawn = np.concatenate([drawn, _moved(allowed, points)])
        if len(drawn) >= count:
            return drawn[:count]
        if len(drawn) and batch % 2:
            near = drawn[rng.integers(len(drawn), size=size)] - box[:, 0]
            near = near / np.ptp(box, axis=1) + rng.normal(0.0, 0.05, (size, n))
            unit = near.clip(0.0, 1.0)
        else:
            unit = even((batch + 1) * size, size)
    if not len(drawn):
        raise ValueError(
            f"allowed is False at all {_DRAWS * size} points tried within the limits"
        )
    return drawn


def _descended(
    down: Callable[[Array], tuple[float, Array]],
    x: Array,
    low: float,
    high: float,
    iterations: int,
    deadline: Deadline,
) -> Array:
    """The lowest point on the way down from x between low and high.

    Spectral projected gradients (Birgin, Martinez and Raydan, 2000). Unlike L-BFGS of
    scipy it calls no BLAS, whose threads wait for each other.
    """
    value, slope = down(x)
    best, least, history = x, value, [value]
    length = 0.1 / max(float(np.abs(slope).max()), 1e-300)
    for _ in range(iterations):
        step = (x - length * slope).clip(low, high) - x
        gain = float(slope @ step)
        if deadline.passed or gain > -1e-14 * max(1.0, abs(value)):
            break
        share = 1.0
        for _ in range(30):
            trial = x + share * step
            new_value, new_slope = down(trial)
            if new_value <= max(history) + 1e-4 * share * gain:
                break
            share *= 0.3
        else:
            break
        moved, turned = trial - x, new_slope - slope
        bent = float(moved @ turned)
        square = float(moved @ moved)
        length = min(max(square / bent, 1e-10), 1e10) if bent > 0.0 else 10.0 * length
        x, value, slope = trial, new_value, new_slope
        history = [*history[-6:], value]
        if value < least:
            best, least = x, value
    return best


def _filled(commands: Array) -> Array:
    """Commands and copies of the last up to a power of two: JAX compiles by number."""
    more = (1 << (len(commands) - 1).bit_length()) - len(commands)
    return np.concatenate([commands, np.repeat(commands[-1:], more, axis=0)])


def _slope(criterion: Criterion, information: Array) -> Array:
    """(p, p) gradient of the criterion by the information (p, p)."""
    half = np.linalg.solve(information, criterion.root.T)  # M^-1 C.T
    covariance = criterion.root @ half
    if criterion.kind == "det":
        return np.asarray(half @ np.linalg.solve(covariance, half.T))
    if criterion.kind == "trace":
        return np.asarray(half @ half.T)
    values, vectors = np.linalg.eigh(covariance)
    along = half @ vectors[:, -1]
    return np.asarray(np.outer(along, along) / values[-1] ** 2)


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


class _Ascent:
    """Blocks of any command, the criterion, and the moves of a search."""

    def __init__(
        self,
        offer: CandidateSet,
        box: Array,
        allowed: Allowed | None,
        k: int | None,
        criterion: Any,
        region: ArrayLike | None,
        seed: int,
        deadline: Deadline,
    ) -> None:
        self.offer, self.box, self.deadline = offer, box, deadline
        self.allowed, self.seed = allowed, seed
        self.low, self.span = box[:, 0], np.ptp(box, axis=1)
        assert offer.candidates is not None and offer.model is not None
        self.asked, self.region = criterion, region
        problem = self.problem = problem_of(offer, k, criterion, region)
        self.k, self.objective = problem.k, problem.criterion
        # What joins the values of S scenarios; S is 1 where there are none.
        self.members, self.weights, self.worst = problem.members, np.ones(1), False
        self.scale, self.shift, self.each = np.ones(1), np.zeros(1), problem.criterion
        if (joint := problem.joint) is not None:
            if joint.criterion.of_efficiency:
                raise ValueError(
                    f"refine does not support criterion {joint.criterion.name}: "
                    "between candidates no scenario's own optimum is proven"
                )
            self.weights, (self.scale, self.shift) = joint.weights, joint.terms()
            self.each, self.worst = joint.criterion.each, joint.criterion.least
        # Their least is climbed smoothed.
        self.smooth = self.worst or self.each.kind == "least"
        self.prior = np.stack([member.prior for member in self.members])
        alone = offer.by_scenario() if len(self.members) > 1 else [offer]
        self.block_makers = [
            blocks_of(one, self.each.by_name, self.each.of_region) for one in alone
        ]
        # Commands lie on a surface in the limits, as of an arm that touches something.
        self.surface = hasattr(allowed, "onto")
        self.rough = _ROUGH if offer.model.resolution else _STEP

    def blocks(self, commands: Array) -> Array:
        """(N, S, q, p) whitened."""
        many = _filled(commands)
        pairs = zip(self.members, self.block_makers, strict=True)
        found = [one.white.of(made.at("commands", many, True)) for one, made in pairs]
        return np.stack(found, axis=1)[: len(commands)]

    @staticmethod
    def squares(blocks: Array) -> Array:
        """(N, S, p, p) what each of (N, S, q, p) adds to the information."""
        return np.matrix_transpose(blocks) @ blocks

    def information(self, blocks: Array) -> Array:
        """(S, p, p) of all of (N, S, q, p) and what is known."""
        rows = np.moveaxis(blocks, 1, 0).reshape(len(self.prior), -1, blocks.shape[-1])
        return np.asarray(np.matrix_transpose(rows) @ rows + self.prior)

    def phi(self, information: Array) -> Array:
        """(...,) joined value of (..., S, p, p)."""
        each = [
            member.criterion.value(information[..., s, :, :])
            for s, member in enumerate(self.members)
        ]
        values = self.scale * np.stack(each, axis=-1) + self.shift
        return np.asarray(values.min(axis=-1) if self.worst else values @ self.weights)

    def phi_of(self, commands: Array) -> float:
        """The joined value of commands (k, n)."""
        return float(self.phi(self.information(self.blocks(commands))))

    def unit(self, phi: float) -> float:
        """The change of the joined value of which a hundredth is a percent."""
        if self.objective.kind != "det":
            return max(abs(phi), 1e-300)
        return float(self.scale[0]) * len(self.each.root)

    def gradient(self, information: Array) -> Array:
        """(S, p, p) of phi by the information, of a worst scenario smoothed."""
        if self.worst:
            phi = float(self.phi(information))
            return self.soft(information, _SHARP[-1] / self.unit(phi))[1]
        slopes = [
            _slope(member.criterion, one)
            for member, one in zip(self.members, information, strict=True)
        ]
        return np.stack(slopes) * (self.weights * self.scale)[:, None, None]

    def soft(self, information: Array, sharp: float) -> tuple[float, Array, float]:
        """A smooth value below phi, and a bound on phi of other information N.

        The bound is the third plus ``trace(W (N - information))``, W the second. E is
        the least ``trace(W M)`` over W of trace 1 in its own coordinates, so any such W
        bounds it; a worst scenario is bounded by any mixture of all. ``sharp``: how
        sharply the least stands out, by one over phi.
        """
        values, metrics, bounds = [], [], []  # of what the least is taken of
        for s, member in enumerate(self.members):
            criterion, one, scale = member.criterion, information[s], self.scale[s]
            if criterion.kind == "least":
                half = np.linalg.inv(criterion.root)
                eigenvalues, vectors = np.linalg.eigh(half.T @ one @ half)
                along = (half @ vectors).T
                values.append(scale * eigenvalues)
                metrics.append(scale * along[:, :, None] * along[:, None, :])
                bounds.append((metrics[-1] * one).sum(axis=(1, 2)))
            else:
                value = scale * float(criterion.value(one)) + self.shift[s]
                values.append(np.array([value]))
                metrics.append(scale * _slope(criterion, one)[None])
                bounds.append(values[-1])
        terms = np.array(values)  # (S, p) or (S, 1)
        lowest = terms.min() if self.worst else terms.min(axis=1, keepdims=True)
        shares = np.exp(-sharp * (terms - lowest))
        total = shares.sum() if self.worst else shares.sum(axis=1, keepdims=True)
        least = lowest - np.log(total) / sharp
        shares = shares / total
        if not self.worst:
            least = float(self.weights @ least[:, 0])
            shares = shares * self.weights[:, None]
        metric = np.einsum("sl,slab->sab", shares, np.array(metrics))
        return float(least), metric, float((shares * np.array(bounds)).sum())

    def goal(
        self, information: Array, phi: float, sharp: float, unit: float
    ) -> tuple[float, Array]:
        """What is climbed, smoothed where it has to be, and its slope (S, p, p)."""
        if self.smooth:
            value, metric, _ = self.soft(information, sharp / unit)
            return value / unit, metric / unit
        score, rate = self.score(phi)
        return score, rate * self.gradient(information)

    def score(self, phi: float) -> tuple[float, float]:
        """What is climbed, in which a hundredth is a percent, and its slope by phi."""
        if self.objective.kind == "det":
            size = self.unit(phi)
            return phi / size, 1.0 / size
        if self.objective.kind == "trace":
            return -float(np.log(-phi)), -1.0 / phi
        return float(np.log(phi)), 1.0 / phi

    @staticmethod
    def leverage(blocks: Array, metric: Array) -> Array:
        """(N,) d of (N, S, q, p)."""
        return np.asarray(((blocks @ metric) * blocks).sum(axis=(1, 2, 3)))

    def slopes(self, commands: Array, metric: Array) -> Array:
        """(N, n) of d by the commands, in shares of the limits."""
        exact = self._exact_slopes(commands, metric)
        if exact is not None:
            return exact * self.span
        count, n = commands.shape
        moving = len(self.allowed.limits) if self.surface else n  # type: ignore[union-attr]  # joints, then labels
        step = (self.rough * self.span * np.eye(n))[:moving]
        ahead = np.minimum(commands[:, None] + step, self.box[:, 1])
        back = np.maximum(commands[:, None] - step, self.box[:, 0])
        both = np.concatenate([ahead, back]).reshape(-1, n)
        d = self.leverage(self.blocks(both), metric).reshape(2, count, moving)
        apart = np.einsum("nii->ni", (ahead - back)[..., :moving])
        slopes = np.zeros((count, n))
        slopes[:, :moving] = (d[0] - d[1]) / (apart / self.span[:moving])
        return slopes

    def _exact_slopes(self, commands: Array, metric: Array) -> Array | None:
        """(N, n) by the model's own derivative, where it has one."""
        total, many = np.zeros_like(commands), _filled(commands)
        for s, member in enumerate(self.members):
            basis = member.white.basis
            unwhitened = basis @ metric[s] @ basis.T
            slopes = self.block_makers[s].leverage_slopes(many, unwhitened)
            if slopes is None:
                return None
            total += slopes[: len(commands)]
        return total

    def run(self, begun: Array | None, starts: int) -> Refinement:
        """From ``begun`` (k, n), and other starts."""
        rng = np.random.default_rng(self.seed)
        first_phi = -np.inf if begun is None else self.phi_of(begun)
        began, best, best_phi = np.nan, begun, first_phi
        for start in self._starts(begun, starts, rng):
            commands, phi = self._climbed(start)
            if phi > best_phi:
                best, best_phi = commands, phi
            if self.deadline.passed:
                break
        if best is None or not np.isfinite(best_phi):
            raise ValueError(
                "limits allow no design that identifies every parameter: the best "
                "found is singular"
            )
        best, best_phi = self._swapped(best, best_phi)
        bound, error, certain = self._bound(best, best_phi)
        if begun is not None:
            began = float(self.objective.reported(first_phi))
        problem, value, log_det = self._judged(best)
        assert begun is None or best_phi >= first_phi
        return Refinement(
            indices=np.arange(self.k),
            value=value,
            log_det=log_det,
            method="optimise" if begun is None else "refine",
            proven=False,
            seconds=self.deadline.elapsed_s,
            problem=problem,
            seed=self.seed,
            known_bound=float(self.objective.reported(bound)),
            axes=self.offer.axes or getattr(self.offer.model, "inputs", None) or None,
            began=began,
            search_error=error,
            certain=certain,
        )

    def _starts(self, begun: Array | None, count: int, rng: np.random.Generator) -> Any:
        """Designs (k, n), the best guesses first; none of them singular."""
        if begun is not None:
            yield begun
            count -= 1
        candidates = self.offer.candidates
        assert candidates is not None
        usable = np.flatnonzero(self.offer.available)
        if self.allowed is not None and begun is not None:
            usable = usable[_permitted(self.allowed, candidates[usable])]
        for i in range(count):
            share = usable
            if i:  # another part of the pool
                few = max(4 * self.problem.num_regressors, 2 * self.k, 24)
                share = rng.permutation(usable)[: min(few, len(usable))]
            one = _among(self.problem, np.isin(np.arange(len(candidates)), share))
            try:
                yield candidates[exchange_indices(one, 10, self.seed + i)]
            except ValueError:  # singular: another part
                continue

    def _climbed(self, commands: Array) -> tuple[Array, float]:
        """All commands together up to a local optimum, never lower than they were."""
        shape = commands.shape
        best, best_phi = commands, self.phi_of(commands)
        if not np.isfinite(best_phi):
            return best, best_phi
        unit = self.unit(best_phi)

        def down(x: Array) -> tuple[float, Array]:
            if self.deadline.passed:
                return 1e10, np.zeros_like(x)
            at = self.low + x.reshape(shape) * self.span
            information = self.information(self.blocks(at))
            phi = float(self.phi(information))
            if not np.isfinite(phi):
                return 1e10, np.zeros_like(x)
            value, metric = self.goal(information, phi, _SHARP[-1], unit)
            return -value, -self.slopes(at, metric).ravel()

        if self.surface:
            return self._tried(best, best_phi)
        there = self._lowest(down, commands, 300)
        phi = self.phi_of(there)
        if phi > best_phi and _permitted(self.allowed, there).all():
            best, best_phi = there, phi
        if self.allowed is not None or self.smooth:
            best, best_phi = self._tried(best, best_phi)
        return best, best_phi

    def _lowest(self, down: Any, commands: Array, iterations: int) -> Array:
        """Commands (N, n) within the limits, gone down by shares of these."""
        start = ((commands - self.low) / self.span).clip(0.0, 1.0).ravel()
        ends = _descended(down, start, 0.0, 1.0, iterations, self.deadline)
        return self._within(self.low + ends.reshape(commands.shape) * self.span)

    def _within(self, commands: Array) -> Array:
        return commands.clip(self.box[:, 0], self.box[:, 1])

    def _tried(self, commands: Array, phi: float) -> tuple[Array, float]:
        """Commands moved one by one by trial, where they are allowed."""
        rng = np.random.default_rng(self.seed)
        commands = commands.copy()
        radius = np.full(len(commands), 0.1)
        ahead = np.zeros_like(commands)  # the way that was last taken
        blocks = self.blocks(commands)
        while radius.max() > _SMALLEST and not self.deadline.passed:
            for i in np.flatnonzero(radius > _SMALLEST):
                information = self.information(blocks)
                metric = self.gradient(information)
                slope = self.slopes(commands[[i]], metric)[0]
                trial = self._trials(commands[i], radius[i], slope, ahead[i], rng)
                radius[i] *= 0.5
                if not len(trial):
                    continue
                new = self.blocks(trial)
                rest = information - self.squares(blocks[i])
                phis = self.phi(rest + self.squares(new))
                j = int(np.argmax(phis))
                if phis[j] > phi:
                    gained = self.score(float(phis[j]))[0] - self.score(phi)[0]
                    ahead[i] = (trial[j] - commands[i]) / self.span
                    commands[i], blocks[i], phi = trial[j], new[j], float(phis[j])
                    if gained > _GAIN:
                        radius[i] = min(4.0 * radius[i], 0.3)
        return commands, phi

    def _trials(
        self, command: Array, radius: float, slope: Array, ahead: Array, rng: Any
    ) -> Array:
        """(T, n) allowed commands about one, at a distance of the radius in limits:
        along the slope, also beside what is not allowed, on as before, along axes and
        their differences, and anywhere."""
        n = len(command)
        ways = [slope, ahead, *np.eye(n), *-np.eye(n), *rng.normal(size=(_TRIALS, n))]
        if n <= _PAIRED:
            pairs = np.eye(n)[:, None] - np.eye(n)
            ways += [*pairs.reshape(-1, n)]
        unit = np.array(ways)
        unit = unit[unit.any(axis=1)]
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        trial = self._within(command + radius * unit * self.span)
        if self.surface:
            return _moved(self.allowed, trial)
        free = _permitted(self.allowed, trial)
        if free.all() or not free.any():
            return trial[free]
        across = unit[free].mean(axis=0) - unit[~free].mean(axis=0)
        more = self._beside(command, radius, slope, across)
        return np.concatenate([trial[free], more])

    def _beside(
        self, command: Array, radius: float, slope: Array, across: Array
    ) -> Array:
        """(T, n) allowed commands along the slope, less its part ``across`` (n,)."""
        size = across @ across
        along = slope - (slope @ across) / (size or 1.0) * across
        trial = command + np.outer(radius * np.array([1.0, 0.3, 0.1]), along) * (
            self.span / (np.linalg.norm(along) or 1.0)
        )
        trial = self._within(trial)
        return trial[_permitted(self.allowed, trial)]

    def _swapped(self, commands: Array, phi: float) -> tuple[Array, float]:
        """Single commands moved to where d is largest, then all together, again."""
        for _ in range(_SWAPS):
            blocks = self.blocks(commands)
            information = self.information(blocks)
            peaks, _, _ = self._peaks(self.gradient(information))
            new = self.blocks(peaks)
            rest = information - self.squares(blocks)  # (k, S, p, p)
            gained = self.phi(rest[:, None] + self.squares(new)[None])
            i, j = np.unravel_index(np.argmax(gained), gained.shape)
            if not gained[i, j] > phi or self.deadline.passed:
                break
            trial = commands.copy()
            trial[i] = peaks[j]
            there, higher = self._climbed(trial)
            if self.score(higher)[0] < self.score(phi)[0] + 1e-9:
                break
            commands, phi = there, higher
        return commands, phi

    @functools.cached_property
    def _spread(self) -> Array:
        """(R, n) points over the limits, where d is looked at."""
        model = self.offer.model
        assert model is not None
        count = _POOL if model.resolution or self.surface else _SEARCH
        count = _affordable(model, self.box, self.deadline, 16, count)
        return _drawn(self.box, count, self.allowed, self.seed + 1)

    @functools.cached_property
    def _spread_blocks(self) -> Array:
        return self.blocks(self._spread)

    def _peaks(self, metric: Array) -> tuple[Array, Array, float]:
        """Local maxima (A, n) of d, d there, and by how much two searches disagree."""
        d = self.leverage(self._spread_blocks, metric)
        shares, starts = self._spread / self.span, list[int]()
        for row in np.argsort(-d).tolist():  # far from each other
            apart = np.abs(shares[row] - shares[starts]).max(axis=1)
            if apart.min(initial=np.inf) > 0.05:
                starts.append(row)
            if len(starts) == 2 * _ASCENTS:
                break
        ends, heights = self._ascents(self._spread[starts], metric)
        other, most = sorted(heights[half::2].max(initial=-np.inf) for half in (0, 1))
        return ends, heights, float(most - other if np.isfinite(other) else most)

    def _ascents(self, points: Array, metric: Array) -> tuple[Array, Array]:
        """Ends (A, n) of climbs from points, and d there."""
        shape = points.shape
        d = self.leverage(self.blocks(points), metric)
        if self.surface:
            return self._wandered(points, d, metric)
        size = float(d.max()) or 1.0

        def down(x: Array) -> tuple[float, Array]:
            at = self.low + x.reshape(shape) * self.span
            value = self.leverage(self.blocks(at), metric).sum() / size
            return -value, -self.slopes(at, metric).ravel() / size

        there = self._lowest(down, points, 150)
        higher = self.leverage(self.blocks(there), metric)
        kept = (higher > d) & _permitted(self.allowed, there)
        return np.where(kept[:, None], there, points), np.where(kept, higher, d)

    def _wandered(self, points: Array, d: Array, metric: Array) -> tuple[Array, Array]:
        """Ends of climbs by trial, and d there."""
        rng, points, d = np.random.default_rng(self.seed), points.copy(), d.copy()
        for radius in 0.1 * 0.7 ** np.arange(20):
            for i in range(len(points)):
                ways = rng.normal(size=(8, points.shape[1]))
                trial = self._within(points[i] + radius * ways * self.span)
                trial = _moved(self.allowed, trial)
                if not len(trial):
                    continue
                heights = self.leverage(self.blocks(trial), metric)
                j = int(heights.argmax())
                if heights[j] > d[i]:
                    points[i], d[i] = trial[j], heights[j]
        return points, d

    def _bound(self, commands: Array, phi: float) -> tuple[float, float, bool]:
        """Upper bound on phi of k commands; share two searches differ by; is it proven.

        The best weighted design of the commands and the peaks found so far gives M0.
        """
        assert self.offer.model is not None
        convex = self.offer.model.affine(self.offer.model.nominal) is not None
        certain = convex and len(self.box) <= _CORNERS
        support, blocks = commands, self.blocks(commands)
        weights = np.ones(len(commands)) / len(commands)
        best, error = np.inf, 0.0
        lowered = self.smooth and not self.worst  # E: its metric is found by itself
        metric = self.gradient(self.information(blocks))
        for _ in range(_ROUNDS):
            begun = weights
            if lowered:
                metric, information = self._lowered(metric, blocks), self.prior
                at = float((metric * self.prior).sum())
            else:
                weights = self._weights(blocks, weights)
                roots = np.sqrt(self.k * weights)[:, None, None, None]
                information = self.information(roots * blocks)
                at = float(self.phi(information))
                if not np.isfinite(at):
                    break
                if self.worst:
                    sharp = _SHARP[-1] / self.unit(at)
                    _, metric, at = self.soft(information, sharp)
                else:
                    metric = self.gradient(information)
            off = float((metric * (self.prior - information)).sum())
            if certain:
                peaks = np.array(np.meshgrid(*self.box)).reshape(len(self.box), -1).T
                differ = 0.0
                heights = self.leverage(self.blocks(peaks), metric)
            else:
                peaks, heights, differ = self._peaks(metric)
                heights = np.append(heights, self.leverage(blocks, metric))
                peaks = np.concatenate([peaks, support])
            highest, before = float(heights.max()), best
            bound = at + off + self.k * highest
            if bound < best:
                best, error = bound, differ / max(highest, 1e-300)
            gap = self._share(phi, best)
            if gap > 1.0 - 1e-9 or self.deadline.passed:
                break
            if np.isfinite(before) and gap - self._share(phi, before) < _TOLD:
                if self.k * highest + off < 1e-6 * max(abs(at), 1.0):
                    break
            new = self._new_support(peaks, heights, support)
            if len(new):
                support = np.concatenate([support, new])
                blocks = np.concatenate([blocks, self.blocks(new)])
                fill = np.full(len(new), 0.02 / len(new))
                weights = np.concatenate([0.98 * weights, fill])
            elif lowered or np.abs(weights - begun).max() < _SETTLED:
                break  # the weights have converged
        return max(best, phi), error, certain

    def _lowered(self, metric: Array, blocks: Array) -> Array:
        """(S, p, p) of which E's bound at blocks (N, S, q, p) and the spread is low.

        Any W of trace 1 in E's coordinates bounds k commands by ``trace(W P)`` and k
        times the largest ``trace(W B.T B)``: convex, and lowered here by the square
        root of each scenario's W, the largest smoothed.
        """
        grams = self.squares(np.concatenate([blocks, self._spread_blocks]))
        roots = np.stack([member.criterion.root for member in self.members])
        halves = np.linalg.inv(roots)
        sizes = (self.scale * self.weights)[:, None, None]
        values, vectors = np.linalg.eigh(
            roots @ metric @ np.matrix_transpose(roots) / sizes
        )
        begun = vectors * np.sqrt(np.maximum(values, 1e-6))[:, None, :]
        unit = self.k * float(self.leverage(blocks, metric).max())

        def of(x: Array) -> tuple[Array, Array, Array]:
            v = x.reshape(begun.shape)
            v = v / np.sqrt((v * v).sum(axis=(1, 2), keepdims=True))
            along = halves @ v
            return v, along, sizes * along @ np.matrix_transpose(along)

        def down(x: Array, sharp: float) -> tuple[float, Array]:
            v, along, w = of(x)
            d = np.tensordot(grams, w, 3) * self.k / unit
            e = np.exp(sharp * (d - d.max()))
            mean = np.tensordot(e / e.sum(), grams, 1)
            slope = (self.prior + self.k * mean) / unit
            value = d.max() + np.log(e.sum()) / sharp + (w * self.prior).sum() / unit
            slope = 2.0 * sizes * np.matrix_transpose(halves) @ slope @ along
            slope -= (slope * v).sum(axis=(1, 2), keepdims=True) * v
            return float(value), slope.ravel()

        x = begun.ravel()
        for sharp in _SHARP_BOUND:
            smoothed = functools.partial(down, sharp=sharp)
            x = _descended(smoothed, x, -np.inf, np.inf, 300, self.deadline)
            x = of(x)[0].ravel()
        return of(x)[2]

    def _new_support(self, peaks: Array, heights: Array, support: Array) -> Array:
        """The highest peaks that are not in the support of a weighted design yet."""
        highest = np.argsort(-heights)[: 2 * self.problem.num_regressors]
        new = peaks[highest]
        apart = np.abs((new[:, None] - support) / self.span).max(axis=2)
        return np.asarray(new[(apart > 1e-6).all(axis=1)])

    def _share(self, phi: float, bound: float) -> float:
        value, best = map(float, map(self.objective.reported, (phi, bound)))
        return float(self.objective.efficiency(value, best))

    def _weights(self, blocks: Array, weights: Array) -> Array:
        """(S,) of sum 1, near the best for k commands at these blocks (S, q, p)."""
        grams = self.k * self.squares(blocks)
        information = np.tensordot(weights, grams, 1) + self.prior
        unit = self.unit(float(self.phi(information)))

        def down(z: Array, sharp: float) -> tuple[float, Array]:
            e = np.exp(z - z.max())
            w = e / e.sum()
            information = np.tensordot(w, grams, 1) + self.prior
            phi = float(self.phi(information))
            if not np.isfinite(phi) and self.each.kind != "least":
                return 1e10, np.zeros_like(z)
            value, metric = self.goal(information, phi, sharp, unit)
            slope = (grams * metric).sum(axis=(1, 2, 3))
            return -value, -w * (slope - w @ slope)

        logits = np.log(np.maximum(weights, 1e-9))
        for sharp in _SHARP if self.smooth else _SHARP[:1]:
            smoothed = functools.partial(down, sharp=sharp)
            logits = _descended(smoothed, logits, -np.inf, np.inf, 300, self.deadline)
        e = np.exp(logits - logits.max())
        return np.asarray(e / e.sum())

    def _judged(self, commands: Array) -> tuple[Problem, float, float]:
        """The problem of commands and all candidates; value and log det of them."""
        offer = self.offer
        assert offer.candidates is not None
        pool = offer.candidates[offer.available]
        region = self.region
        of_one = getattr(self.asked, "criterion", self.asked)
        if region is getattr(of_one, "region", None) is None and self.each.of_region:
            region = pool
        scenarios = tuple(offer.scenarios) if len(self.members) > 1 else None
        beside = CandidateSet(
            np.concatenate([commands, pool]), offer.model, offer.prior, offer.noise,
            offer.measured, scenarios=scenarios,
        ).checked()  # fmt: skip
        problem = problem_of(beside, self.k, self.asked, region)
        value, log_det = problem.values(np.arange(self.k)[None])
        return problem, float(value[0]), float(log_det[0])
