"""Structures of the family: the unknown, the designs and the law of the outcomes.

Each structure is a function of a random generator and of sizes that returns
``Questions``. Those of ``HELD_OUT`` are never trained on: the benchmark is drawn from
them.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

__all__ = ["HELD_OUT", "TRAINED_ON", "Limits", "Questions"]

Array = NDArray[Any]


@dataclasses.dataclass(frozen=True)
class Limits:
    """The largest task, in each of its sizes."""

    states: int = 4096
    designs: int = 256
    outcomes: int = 16
    uses: int = 5  # budget of a session
    measurements: int = 64
    groups: int = 4


@dataclasses.dataclass(frozen=True)
class Questions:
    """S states, A designs, Y outcomes, before costs and budgets."""

    theta: Array  # (S, d) from 0 to 1
    designs: Array  # (A, e) from 0 to 1
    likelihood: Array  # (A, Y, S)
    groups: NDArray[np.int64]  # (A,)
    prior: Array | None = None  # (S,) where the structure has one of its own


def _cells(count: int) -> Array:
    return (np.arange(count) + 0.5) / count


def _grid(*axes: Array) -> Array:
    """(S, d) all combinations, the last axis the fastest."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def _side(rng: np.random.Generator, dim: int, limits: Limits, least: int = 4) -> int:
    """Cells on each of ``dim`` axes; large grids are as likely as small ones."""
    max_side = int(min(48 if dim > 1 else 128, limits.states ** (1.0 / dim) + 1e-9))
    least = min(least, max_side)
    return int(np.rint(np.exp(rng.uniform(np.log(least), np.log(max_side)))))


def _below(rng: np.random.Generator, distance: Array) -> Array:
    """Probability of a yes: a step from 0 to 1 at distance 0, with wrong answers."""
    sigma = rng.choice([0.0, np.exp(rng.uniform(np.log(0.005), np.log(0.15)))])
    wrong = rng.choice([0.0, rng.uniform(0.0, 0.12)], size=2)
    if rng.random() < 0.6:
        wrong[:] = wrong[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        step = special.ndtr(distance / sigma)
    step = np.where(np.isnan(step), 0.5, step)
    return np.asarray(wrong[0] + (1.0 - wrong.sum()) * step)


def _yes_no(p: Array) -> Array:
    return np.stack([1.0 - p, p], axis=1)


def _bins(rng: np.random.Generator, mean: Array, limits: Limits) -> Array:
    """(A, Y, S) of readings with Gaussian noise in bins; ``mean`` (A, S)."""
    count = int(rng.integers(2, limits.outcomes + 1))
    low, high = mean.min(), mean.max()
    span = max(high - low, 1e-9)
    edges = low + span * np.arange(1, count) / count
    sigma = span * np.exp(rng.uniform(np.log(0.02), np.log(0.4)))
    cdf = special.ndtr((edges[None, :, None] - mean[:, None, :]) / sigma)
    ends = np.zeros_like(mean)[:, None]
    p = np.diff(np.concatenate([ends, cdf, ends + 1.0], axis=1), axis=1)
    slip = rng.choice([0.0, rng.uniform(0.0, 0.15)])
    return np.asarray((1.0 - slip) * p + slip / count)


def _answers(rng: np.random.Generator, mean: Array, limits: Limits) -> Array:
    """(A, Y, S) of readings in bins, or of whether ``mean`` exceeds a quantile."""
    if limits.outcomes > 2 and rng.random() < 0.6:
        return _bins(rng, mean, limits)
    middle = np.quantile(mean, rng.uniform(0.3, 0.7))
    return _yes_no(_below(rng, (mean - middle) / max(np.ptp(mean), 1e-9)))


def _ungrouped(designs: Array) -> NDArray[np.int64]:
    return np.zeros(len(designs), np.int64)


def _per_joint(
    rng: np.random.Generator, joints: int, limits: Limits
) -> tuple[NDArray[np.int64], Array]:
    """(A,) joint and (A,) level of tests that go along each of several joints."""
    max_levels = limits.designs // joints
    count = int(rng.integers(min(5, max_levels), min(max_levels, 40) + 1))
    levels = np.linspace(0.0, 1.0, count + 2)[1:-1]
    return np.repeat(np.arange(joints), count), np.tile(levels, joints)


# -- trained on ------------------------------------------------------------------------


def thresholds(rng: np.random.Generator, limits: Limits) -> Questions:
    """One to four thresholds; a test on one of them says whether it lies below."""
    joints = int(rng.integers(1, 5))
    theta = _grid(*[_cells(_side(rng, joints, limits, 3))] * joints)
    joint, level = _per_joint(rng, joints, limits)
    p = _below(rng, level[:, None] - theta[:, joint].T)
    return Questions(theta, np.column_stack([joint, level]), _yes_no(p), joint)


def band(rng: np.random.Generator, limits: Limits) -> Questions:
    """An interval by centre and width; a test says inside, or below, inside, above."""
    side = _side(rng, 2, limits)
    theta = _grid(_cells(side), 0.05 + 0.5 * _cells(side))
    at = np.linspace(0.0, 1.0, int(rng.integers(8, min(limits.designs, 48) + 1)))
    low = theta[:, 0] - 0.5 * theta[:, 1]
    high = theta[:, 0] + 0.5 * theta[:, 1]
    above_low = _below(rng, at[:, None] - low)
    above_high = _below(rng, at[:, None] - high) * above_low
    if limits.outcomes > 2 and rng.random() < 0.4:
        table = np.stack([1 - above_low, above_low - above_high, above_high], axis=1)
    else:
        table = _yes_no(above_low - above_high)
    return Questions(theta, at[:, None], table, _ungrouped(at))


def place(rng: np.random.Generator, limits: Limits) -> Questions:
    """A place on a line or in the plane; a reading that falls with the distance."""
    dim = int(rng.integers(1, 3))
    theta = _grid(*[_cells(_side(rng, dim, limits, 5))] * dim)
    side = int(limits.designs ** (1.0 / dim) + 1e-9)
    side = int(rng.integers(min(4, side), min(side, 40 if dim == 1 else 12) + 1))
    at = _grid(*[_cells(side)] * dim)
    away = np.linalg.norm(at[:, None] - theta[None], axis=-1)
    radius = rng.uniform(0.08, 0.45)
    if rng.random() < 0.5:
        table = _yes_no(_below(rng, radius - away))
    else:
        table = _answers(rng, np.exp(-0.5 * (away / radius) ** 2), limits)
    return Questions(theta, at, table, _ungrouped(at))


def wave(rng: np.random.Generator, limits: Limits) -> Questions:
    """Frequency and phase of a sine; readings of it along a line."""
    side = _side(rng, 2, limits)
    least = rng.uniform(0.3, 1.5)
    theta = _grid(_cells(side), _cells(side))
    frequency = least * np.exp(theta[:, 0] * rng.uniform(0.5, 2.0))
    at = np.linspace(0.0, 1.0, int(rng.integers(8, min(limits.designs, 48) + 1)))
    mean = np.sin(2.0 * np.pi * (at[:, None] * frequency + theta[:, 1]))
    return Questions(theta, at[:, None], _answers(rng, mean, limits), _ungrouped(at))


def slope(rng: np.random.Generator, limits: Limits) -> Questions:
    """Middle and width of a smooth step from no to yes."""
    side = _side(rng, 2, limits)
    theta = _grid(_cells(side), _cells(side))
    width = 0.01 * np.exp(theta[:, 1] * np.log(30.0))
    at = np.linspace(0.0, 1.0, int(rng.integers(8, min(limits.designs, 48) + 1)))
    guess, miss = rng.choice([0.0, rng.uniform(0.0, 0.15)], size=2)
    step = special.expit((at[:, None] - theta[:, 0]) / width)
    return Questions(
        theta, at[:, None], _yes_no(guess + (1 - guess - miss) * step), _ungrouped(at)
    )


def play(rng: np.random.Generator, limits: Limits) -> Questions:
    """Width of a joint's play and offset of a reading, reached from either side."""
    side = _side(rng, 2, limits)
    theta = _grid(_cells(side), _cells(side))
    way, level = _per_joint(rng, 2, limits)
    bend = rng.uniform(0.0, 1.0)
    mean = theta[:, 1] + (way[:, None] - 0.5) * theta[:, 0] * (
        1.0 + bend * level[:, None]
    )
    table = _answers(rng, mean + level[:, None] * rng.uniform(0.0, 0.5), limits)
    return Questions(theta, np.column_stack([way, level]), table, way)


def curves(rng: np.random.Generator, limits: Limits) -> Questions:
    """Which of many smooth random functions; readings of it on a line or a plane."""
    count = int(np.exp(rng.uniform(np.log(12), np.log(limits.states))))
    dim = int(rng.integers(1, 3))
    max_side = int(min(limits.designs, 64) ** (1.0 / dim) + 1e-9)
    at = _grid(*[_cells(int(rng.integers(min(4, max_side), max_side + 1)))] * dim)
    lengths = np.exp(rng.uniform(np.log(1.0), np.log(8.0)))
    rate = lengths * rng.standard_normal((dim, 24))
    basis = np.cos(at @ rate + rng.uniform(0.0, 2.0 * np.pi, 24))
    mean = basis @ rng.standard_normal((24, count)) / np.sqrt(24.0)
    theta = _cells(count)[:, None]
    return Questions(theta, at, _answers(rng, mean, limits), _ungrouped(at))


def codes(rng: np.random.Generator, limits: Limits) -> Questions:
    """Which of many states, where every design separates some from the others."""
    count = int(np.exp(rng.uniform(np.log(6), np.log(min(limits.states, 256)))))
    number = int(rng.integers(5, min(limits.designs, 48) + 1))
    share = rng.uniform(0.05, 0.5, number)
    inside = rng.random((number, count)) < share[:, None]
    at = _cells(number)[:, None]
    table = _yes_no(_below(rng, inside - 0.5))
    return Questions(_cells(count)[:, None], at, table, _ungrouped(at))


def sums(rng: np.random.Generator, limits: Limits) -> Questions:
    """Two or three coordinates; readings of weighted sums of them."""
    dim = int(rng.integers(2, 4))
    theta = _grid(*[_cells(_side(rng, dim, limits, 3))] * dim)
    number = int(rng.integers(6, min(limits.designs, 48) + 1))
    weights = rng.standard_normal((number, dim)) * (rng.random((number, dim)) < 0.7)
    table = _answers(rng, weights @ (theta - 0.5).T, limits)
    at = np.clip(0.5 + 0.2 * weights, 0.0, 1.0)
    return Questions(theta, at, table, _ungrouped(at))


def two_ways(rng: np.random.Generator, limits: Limits) -> Questions:
    """Two thresholds, up and down, of one kind of test; one is often the larger."""
    side = _side(rng, 2, limits)
    theta = _grid(_cells(side), _cells(side))
    way, level = _per_joint(rng, 2, limits)
    bent = theta ** np.array([1.0, np.exp(rng.uniform(-0.7, 0.7))])
    p = _below(rng, level[:, None] - bent[:, way].T)
    near = np.exp(-0.5 * ((theta[:, 0] - theta[:, 1]) / rng.uniform(0.1, 0.6)) ** 2)
    return Questions(theta, np.column_stack([way, level]), _yes_no(p), way, near)


# -- held out --------------------------------------------------------------------------


def ranking(rng: np.random.Generator, limits: Limits) -> Questions:
    """An order of up to six things; two of them are compared at a time."""
    max_things = max(n for n in (3, 4, 5, 6) if special.factorial(n) <= limits.states)
    count = int(rng.integers(min(4, max_things), max_things + 1))
    orders = np.array(list(itertools.permutations(range(count))), float)
    pairs = np.array(list(itertools.combinations(range(count), 2)))[: limits.designs]
    ahead = (orders[:, pairs[:, 0]] - orders[:, pairs[:, 1]]).T / count
    table = _yes_no(_below(rng, ahead))
    return Questions(
        orders / (count - 1), pairs / (count - 1.0), table, _ungrouped(pairs)
    )


def stops(rng: np.random.Generator, limits: Limits) -> Questions:
    """Three end stops, each above the one before; a push on one of them."""
    side = int(rng.integers(7, 15))
    while special.comb(side, 3) > limits.states:
        side -= 1
    cells = np.array(list(itertools.combinations(range(side), 3)), float)
    theta = (cells + 0.5) / side
    joint, level = _per_joint(rng, 3, limits)
    p = _below(rng, level[:, None] - theta[:, joint].T)
    return Questions(theta, np.column_stack([joint, level]), _yes_no(p), joint)


def pools(rng: np.random.Generator, limits: Limits) -> Questions:
    """Which of several parts are faulty; some of them are tested together."""
    max_parts = min(10, int(np.log2(limits.states)))
    parts = int(rng.integers(min(6, max_parts), max_parts + 1))
    theta = _grid(*[np.arange(2.0)] * parts)
    number = int(rng.integers(parts, min(limits.designs, 40) + 1))
    pool = rng.random((number, parts)) < rng.uniform(0.15, 0.5, number)[:, None]
    pool[np.arange(number), rng.integers(0, parts, number)] = True
    hit = (pool.astype(float) @ theta.T) > 0.5
    rate = rng.uniform(0.1, 0.5, parts)
    prior = np.where(theta > 0.5, rate, 1.0 - rate).prod(axis=1)
    table = _yes_no(_below(rng, hit - 0.5))
    return Questions(theta, pool.astype(float), table, _ungrouped(pool), prior)


def decay(rng: np.random.Generator, limits: Limits) -> Questions:
    """Amplitude and time constant of a decay; it is read after a wait."""
    side = _side(rng, 2, limits)
    theta = _grid(_cells(side), _cells(side))
    tau = 0.05 * np.exp(theta[:, 1] * np.log(20.0))
    wait = np.linspace(0.0, 1.0, int(rng.integers(8, min(limits.designs, 40) + 1)))
    mean = (0.3 + 0.7 * theta[:, 0]) * np.exp(-wait[:, None] / tau)
    table = _answers(rng, mean, limits)
    return Questions(theta, wait[:, None], table, _ungrouped(wait))


def corner(rng: np.random.Generator, limits: Limits) -> Questions:
    """The corner of a rectangle in the plane; a probe says inside or outside."""
    theta = _grid(*[_cells(_side(rng, 2, limits))] * 2)
    side = int(min(np.sqrt(limits.designs), 10))
    at = _grid(*[_cells(side)] * 2)
    reach = (theta[None] - at[:, None]).min(axis=-1)
    return Questions(theta, at, _yes_no(_below(rng, reach)), _ungrouped(at))


def dead_zone(rng: np.random.Generator, limits: Limits) -> Questions:
    """Width and centre of a zone without output; a command gives a reading."""
    side = _side(rng, 2, limits)
    theta = _grid(_cells(side), 0.6 * _cells(side))
    at = np.linspace(0.0, 1.0, int(rng.integers(8, min(limits.designs, 40) + 1)))
    off = at[:, None] - theta[:, 0]
    mean = np.sign(off) * np.maximum(np.abs(off) - 0.5 * theta[:, 1], 0.0)
    return Questions(theta, at[:, None], _answers(rng, mean, limits), _ungrouped(at))


Structure = Callable[[np.random.Generator, Limits], Questions]

TRAINED_ON: dict[str, Structure] = {
    f.__name__: f
    for f in (
        thresholds, band, place, wave, slope, play, curves, codes, sums, two_ways,
    )
}  # fmt: skip
HELD_OUT: dict[str, Structure] = {
    f.__name__: f for f in (ranking, stops, pools, decay, corner, dead_zone)
}
