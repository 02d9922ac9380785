"""The criterion as a function of commands, and climbs on it.

With G the gradient of phi by the information, the slope of phi by one command u is that
of ``d(u) = trace(B G B.T)``, B the block there. So all commands climb together; then
single ones are moved to where d is largest, and those that must stay where ``allowed``
says move by trial.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import Array
from jaxcal.deadline import Deadline
from jaxcal.designs.box import Box, affordable, descended
from jaxcal.selection.criteria import Criterion
from jaxcal.selection.problem import (
    Blocks,
    CandidateSet,
    Problem,
    blocks_of,
    problem_of,
)

POOL = 512  # points that starts are looked for in
SHARP = (10.0, 50.0, 250.0)  # of the least eigenvalue, by one over it

_SEARCH = 2048  # points that the largest d is looked for in
_ASCENTS = 12  # of the best points, for the largest d
_SWAPS = 6  # of moving single commands
_TRIALS, _SMALLEST = 24, 1e-6  # of a command, in a round of trial; share of the limits
_PAIRED, _GAIN = 6, 1e-7  # inputs up to which differences are tried; of log efficiency
_STEP = 1e-5  # share of the limits, of differences where a model has no derivative
_ROUGH = 1e-3  # the same where derivatives are differences already


@dataclasses.dataclass(frozen=True, eq=False)
class Ascent:
    """Blocks of any command, and the criterion, which joins S scenarios' values."""

    offer: CandidateSet
    box: Box
    problem: Problem
    seed: int
    deadline: Deadline
    each: Criterion  # of a scenario
    worst: bool  # the least of the scenarios counts, else their mean
    weights: Array  # (S,)
    scale: Array  # (S,) ``scale phi + shift`` of a scenario is what is joined
    shift: Array  # (S,)
    block_makers: list[Blocks]  # (S,)
    question: tuple[Any, Any]  # criterion and region, as given

    @property
    def smooth(self) -> bool:
        """Whether what is climbed is smoothed: a least has no slope everywhere."""
        return self.worst or self.each.kind == "least"

    @functools.cached_property
    def prior(self) -> Array:
        """(S, p, p)."""
        return np.stack([member.prior for member in self.problem.members])

    def blocks(self, commands: Array) -> Array:
        """(N, S, q, p) whitened."""
        many = _filled(commands)
        pairs = zip(self.problem.members, self.block_makers, strict=True)
        made = [one.white.of(maker.at("commands", many, True)) for one, maker in pairs]
        return np.stack(made, axis=1)[: len(commands)]

    def information(self, blocks: Array) -> Array:
        """(S, p, p) of all of (N, S, q, p) and what is known."""
        rows = np.moveaxis(blocks, 1, 0).reshape(len(self.prior), -1, blocks.shape[-1])
        return np.asarray(np.matrix_transpose(rows) @ rows + self.prior)

    def phi(self, information: Array) -> Array:
        """(...,) joined value of (..., S, p, p)."""
        each = [
            member.criterion.value(information[..., s, :, :])
            for s, member in enumerate(self.problem.members)
        ]
        values = self.scale * np.stack(each, axis=-1) + self.shift
        return np.asarray(values.min(axis=-1) if self.worst else values @ self.weights)

    def phi_of(self, commands: Array) -> float:
        """The joined value of commands (k, n)."""
        return float(self.phi(self.information(self.blocks(commands))))

    def unit(self, phi: float) -> float:
        """The change of the joined value of which a hundredth is a percent."""
        if self.each.kind != "det":
            return max(abs(phi), 1e-300)
        return float(self.scale[0]) * len(self.each.root)

    def score(self, phi: float) -> float:
        """What is climbed, in which a hundredth is a percent."""
        if self.each.kind == "det":
            return phi / self.unit(phi)
        return float(np.log(phi) if phi > 0.0 else -np.log(-phi))

    def gradient(self, information: Array) -> Array:
        """(S, p, p) of phi by the information, of a worst scenario smoothed."""
        if self.worst:
            phi = float(self.phi(information))
            return self.soft(information, SHARP[-1] / self.unit(phi))[1]
        pairs = zip(self.problem.members, information, strict=True)
        slopes = np.stack([member.criterion.slope(one) for member, one in pairs])
        return slopes * (self.weights * self.scale)[:, None, None]

    def soft(self, information: Array, sharp: float) -> tuple[float, Array, float]:
        """A smooth value below phi, and a bound on phi of other information N.

        The bound is the third plus ``trace(W (N - information))``, W the second. E is
        the least ``trace(W M)`` over W of trace 1 in its own coordinates, so any such W
        bounds it; a worst scenario is bounded by any mixture of all. ``sharp``: how
        sharply the least stands out, by one over phi.
        """
        values, metrics, bounds = [], [], []  # of what the least is taken of
        for s, member in enumerate(self.problem.members):
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
                metrics.append(scale * criterion.slope(one)[None])
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
        return self.score(phi), 1.0 / self.unit(phi) * self.gradient(information)

    def slopes(self, commands: Array, metric: Array) -> Array:
        """(N, n) of d by the commands, in shares of the limits."""
        box, (count, n) = self.box, commands.shape
        moving = len(box.allowed.limits) if box.surface else n  # joints, then labels
        rough = _ROUGH if self.offer.model.fitting.resolution else _STEP
        step = (rough * box.span * np.eye(n))[:moving]
        ahead = np.minimum(commands[:, None] + step, box.limits[:, 1])
        back = np.maximum(commands[:, None] - step, box.limits[:, 0])
        both = np.concatenate([ahead, back]).reshape(-1, n)
        d = leverage(self.blocks(both), metric).reshape(2, count, moving)
        apart = np.einsum("nii->ni", (ahead - back)[..., :moving])
        slopes = np.zeros((count, n))
        slopes[:, :moving] = (d[0] - d[1]) / (apart / box.span[:moving])
        return slopes

    @functools.cached_property
    def spread(self) -> tuple[Array, Array]:
        """(R, n) points over the limits, where d is looked at, and their blocks."""
        model, box = self.offer.model, self.box
        count = POOL if model.fitting.resolution or box.surface else _SEARCH
        count = affordable(model, box, self.deadline, 16, count)
        points = box.drawn(count, self.seed + 1)
        return points, self.blocks(points)


def ascent_of(
    offer: CandidateSet,
    box: Box,
    k: int | None,
    criterion: Any,
    region: ArrayLike | None,
    seed: int,
    deadline: Deadline,
) -> Ascent:
    problem = problem_of(offer, k, criterion, region)
    weights, scale, shift = np.ones(1), np.ones(1), np.zeros(1)
    inner, worst, alone = problem.criterion.each, False, [offer]
    if (joint := problem.joint) is not None:
        if joint.criterion.of_efficiency or inner.of_each:
            raise ValueError(
                f"refine does not support criterion {joint.criterion.name}: between "
                "candidates nothing proves a scenario's own optimum, or which "
                "prediction is the least certain"
            )
        weights, (scale, shift) = joint.weights, joint.terms()
        worst, alone = joint.criterion.least, offer.by_scenario()
    makers = [blocks_of(one, inner.by_name, inner.of_region) for one in alone]
    return Ascent(
        offer, box, problem, seed, deadline, inner, worst, weights, scale, shift,
        makers, (criterion, region),
    )  # fmt: skip


def squares(blocks: Array) -> Array:
    """(N, S, p, p) what each of (N, S, q, p) adds to the information."""
    return np.matrix_transpose(blocks) @ blocks


def leverage(blocks: Array, metric: Array) -> Array:
    """(N,) d of (N, S, q, p)."""
    return np.asarray(((blocks @ metric) * blocks).sum(axis=(1, 2, 3)))


def _filled(commands: Array) -> Array:
    """Commands and copies of the last up to a power of two: JAX compiles by number."""
    more = (1 << (len(commands) - 1).bit_length()) - len(commands)
    return np.concatenate([commands, np.repeat(commands[-1:], more, axis=0)])


def climbed(ascent: Ascent, commands: Array) -> tuple[Array, float]:
    """All commands together up to a local optimum, never lower than they were."""
    box, best, best_phi = ascent.box, commands, ascent.phi_of(commands)
    if not np.isfinite(best_phi):
        return best, best_phi
    if box.surface:
        return _tried(ascent, best, best_phi)
    unit = ascent.unit(best_phi)

    def down(x: Array) -> tuple[float, Array]:
        if not ascent.deadline.passed:
            u = box.low + x.reshape(commands.shape) * box.span
            information = ascent.information(ascent.blocks(u))
            phi = float(ascent.phi(information))
            if np.isfinite(phi):
                value, metric = ascent.goal(information, phi, SHARP[-1], unit)
                return -value, -ascent.slopes(u, metric).ravel()
        return 1e10, np.zeros_like(x)

    ends = _lowest(ascent, down, commands, 300)
    phi = ascent.phi_of(ends)
    if phi > best_phi and box.permitted(ends).all():
        best, best_phi = ends, phi
    if box.allowed is not None or ascent.smooth:
        best, best_phi = _tried(ascent, best, best_phi)
    return best, best_phi


def _lowest(ascent: Ascent, down: Any, commands: Array, iterations: int) -> Array:
    """Commands (N, n) within the limits, gone down by shares of these."""
    box = ascent.box
    start = ((commands - box.low) / box.span).clip(0.0, 1.0).ravel()
    ends = descended(down, start, 0.0, 1.0, iterations, ascent.deadline)
    return box.within(box.low + ends.reshape(commands.shape) * box.span)


def _tried(ascent: Ascent, commands: Array, phi: float) -> tuple[Array, float]:
    """Commands moved one by one by trial, where they are allowed."""
    rng, commands = np.random.default_rng(ascent.seed), commands.copy()
    radius = np.full(len(commands), 0.1)
    ahead = np.zeros_like(commands)  # the way that was last taken
    blocks = ascent.blocks(commands)
    while radius.max() > _SMALLEST and not ascent.deadline.passed:
        for i in np.flatnonzero(radius > _SMALLEST):
            information = ascent.information(blocks)
            slope = ascent.slopes(commands[[i]], ascent.gradient(information))[0]
            ways = [slope, ahead[i]]
            trial = _trials(ascent.box, commands[i], radius[i], ways, rng)
            radius[i] *= 0.5
            if not len(trial):
                continue
            new = ascent.blocks(trial)
            phis = ascent.phi(information - squares(blocks[i]) + squares(new))
            j = int(np.argmax(phis))
            if phis[j] > phi:
                gained = ascent.score(float(phis[j])) - ascent.score(phi)
                ahead[i] = (trial[j] - commands[i]) / ascent.box.span
                commands[i], blocks[i], phi = trial[j], new[j], float(phis[j])
                if gained > _GAIN:
                    radius[i] = min(4.0 * radius[i], 0.3)
    return commands, phi


def _trials(
    box: Box, command: Array, radius: float, ways: list[Array], rng: np.random.Generator
) -> Array:
    """(T, n) allowed commands about one, at a distance of the radius in limits: along
    the ways, the slope first, also beside what is not allowed, along axes and their
    differences, and anywhere."""
    n, slope = len(command), ways[0]
    ways = [*ways, *np.eye(n), *-np.eye(n), *rng.normal(size=(_TRIALS, n))]
    if n <= _PAIRED:
        ways += [*(np.eye(n)[:, None] - np.eye(n)).reshape(-1, n)]
    unit = np.array(ways)
    unit = unit[unit.any(axis=1)]
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    trial = box.within(command + radius * unit * box.span)
    if box.surface:
        return box.moved(trial)
    free = box.permitted(trial)
    if free.all() or not free.any():
        return trial[free]
    # Along the slope, less its part across the border.
    across = unit[free].mean(axis=0) - unit[~free].mean(axis=0)
    along = slope - (slope @ across) / (across @ across or 1.0) * across
    beside = command + np.outer(radius * np.array([1.0, 0.3, 0.1]), along) * (
        box.span / (np.linalg.norm(along) or 1.0)
    )
    return np.concatenate([trial[free], box.moved(box.within(beside))])


def swapped(ascent: Ascent, commands: Array, phi: float) -> tuple[Array, float]:
    """Single commands moved to where d is largest, then all together, again."""
    for _ in range(_SWAPS):
        blocks = ascent.blocks(commands)
        information = ascent.information(blocks)
        ends, _ = peaks(ascent, ascent.gradient(information))
        rest = information - squares(blocks)  # (k, S, p, p)
        gained = ascent.phi(rest[:, None] + squares(ascent.blocks(ends))[None])
        i, j = np.unravel_index(np.argmax(gained), gained.shape)
        if not gained[i, j] > phi or ascent.deadline.passed:
            break
        trial = commands.copy()
        trial[i] = ends[j]
        trial, higher = climbed(ascent, trial)
        if ascent.score(higher) < ascent.score(phi) + 1e-9:
            break
        commands, phi = trial, higher
    return commands, phi


def peaks(ascent: Ascent, metric: Array) -> tuple[Array, Array]:
    """Local maxima (A, n) of d, and d there."""
    points, blocks = ascent.spread
    shares, starts = points / ascent.box.span, list[int]()
    for row in np.argsort(-leverage(blocks, metric)).tolist():  # far from each other
        apart = np.abs(shares[row] - shares[starts]).max(axis=1)
        if apart.min(initial=np.inf) > 0.05:
            starts.append(row)
        if len(starts) == 2 * _ASCENTS:
            break
    points = points[starts]
    d = leverage(ascent.blocks(points), metric)
    if ascent.box.surface:
        return _wandered(ascent, points, d, metric)
    box, size = ascent.box, float(d.max()) or 1.0

    def down(x: Array) -> tuple[float, Array]:
        u = box.low + x.reshape(points.shape) * box.span
        value = leverage(ascent.blocks(u), metric).sum() / size
        return -value, -ascent.slopes(u, metric).ravel() / size

    ends = _lowest(ascent, down, points, 150)
    higher = leverage(ascent.blocks(ends), metric)
    better = (higher > d) & box.permitted(ends)
    return np.where(better[:, None], ends, points), np.where(better, higher, d)


def _wandered(
    ascent: Ascent, points: Array, d: Array, metric: Array
) -> tuple[Array, Array]:
    """Ends of climbs by trial on a surface, and d there."""
    rng, box = np.random.default_rng(ascent.seed), ascent.box
    for radius in 0.1 * 0.7 ** np.arange(20):
        for i in range(len(points)):
            ways = rng.normal(size=(8, points.shape[1]))
            trial = box.moved(box.within(points[i] + radius * ways * box.span))
            if not len(trial):
                continue
            heights = leverage(ascent.blocks(trial), metric)
            j = int(heights.argmax())
            if heights[j] > d[i]:
                points[i], d[i] = trial[j], heights[j]
    return points, d
