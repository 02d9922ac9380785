"""A task of the family, drawn from a seed: structure, prior, noise, costs, budget."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from benchmarks.sequential.family.structures import (
    HELD_OUT,
    TRAINED_ON,
    Limits,
    Questions,
)
from jaxcal.adaptive.grid import GridTask
from jaxcal.checks import whole_number

__all__ = ["BUDGETS", "draw"]

Array = NDArray[np.float64]

BUDGETS = (
    "time", "uses", "number", "time+uses", "time+number", "uses+number",
    "time+uses+number",
)  # fmt: skip
_PASSES = 8  # sessions by which budgets are set
_ENOUGH = 0.8  # share of the information that such a session gains in all
_SHARES = (0.25, 1.2)  # least and largest budget, over what that share takes
_UNKNOWN = 1.5  # least entropy of the prior, nats
_LEAST = 3  # least number of measurements for which a budget is drawn


def draw(
    seed: int,
    structure: str | None = None,
    budget: str | None = None,
    limits: Limits = Limits(),  # noqa: B008  # frozen
    overrun: bool = True,
) -> GridTask:
    """One task of the family; the same arguments give the same task.

    Args:
        seed: of everything that is drawn.
        structure: of ``TRAINED_ON`` or ``HELD_OUT``; one of ``TRAINED_ON`` when None.
        budget: of ``BUDGETS``; drawn when None, time and uses together most often.
        limits: largest sizes of the task.
        overrun: the last measurement may cost more than what is left.

    Raises:
        ValueError: no such structure or budget.
    """
    rng = np.random.default_rng(whole_number("seed", seed, 0))
    known = TRAINED_ON | HELD_OUT
    own = rng.choice(sorted(TRAINED_ON))
    if structure is not None and structure not in known:
        raise ValueError(f"structure must be of {', '.join(known)}, got {structure!r}")
    chances = [0.12, 0.13, 0.03, 0.42, 0.05, 0.1, 0.15]
    drawn = rng.choice(BUDGETS, p=chances)
    if budget is not None and budget not in BUDGETS:
        raise ValueError(f"budget must be of {', '.join(BUDGETS)}, got {budget!r}")
    counted = (budget or str(drawn)).split("+")
    asked = _with_uninformative(rng, known[structure or own](rng, limits))
    count, num_outcomes = asked.likelihood.shape[:2]

    base, travel = _travel(rng, asked)
    extra = np.zeros((count, num_outcomes))
    if rng.random() < 0.4:
        extra += rng.choice([0.0, 1.0], num_outcomes) * rng.uniform(0.0, 4.0) * base
    uses = _uses(rng, asked) if "uses" in counted else np.zeros_like(extra)
    itself = np.arange(count)[:, None]
    after = np.broadcast_to(itself, extra.shape)
    if rng.random() < 0.3:  # an outcome that takes uses ends at the start
        after = np.where(uses > 0, count, after)

    prior = _prior(rng, asked)
    need = _needed(
        rng, asked.likelihood, prior, travel, extra, uses, after, limits.measurements
    )
    low_share = np.clip(_LEAST / need["number"], *_SHARES)
    shares = np.log(low_share), np.log(_SHARES[1])
    number = limits.measurements
    if "number" in counted:
        share = np.exp(rng.uniform(*shares))
        number = int(np.clip(np.rint(share * need["number"]), _LEAST, number))
    seconds: float | tuple[float, float] = np.inf
    if "time" in counted:
        low = need["seconds"] * np.exp(rng.uniform(*shares))
        seconds = (low, low * rng.choice([1.0, rng.uniform(1.0, 3.0)]))
    ends = [1]
    if "uses" in counted:
        max_uses = int(np.clip(np.rint(need["uses"]), 1, limits.uses))
        first = int(rng.integers(1, max_uses + 1))
        ends = list(range(first, int(rng.integers(first, max_uses + 1)) + 1))
    return GridTask.make(
        asked.theta,
        asked.designs,
        asked.likelihood,
        prior=prior,
        travel=travel,
        place_after=after,
        groups=asked.groups if rng.random() < 0.5 else None,
        extra=extra,
        uses=uses,
        seconds=seconds,
        num_uses=ends,
        horizon=number,
        overrun=overrun,
    )


def _needed(
    rng: np.random.Generator,
    table: Array,
    prior: Array,
    travel: Array,
    extra: Array,
    uses: Array,
    after: NDArray[Any],
    horizon: int,
) -> dict[str, float]:
    """Measurements, seconds and uses until the rule of the largest gain per second has
    ``_ENOUGH`` of the information that it gains in ``horizon`` measurements."""
    count, num_outcomes, num_states = table.shape
    flat = table.reshape(-1, num_states)
    noise = special.entr(table).sum(axis=1)
    truth = rng.choice(num_states, _PASSES, p=prior)
    belief = np.repeat(prior[:, None], _PASSES, axis=1)
    place = np.full(_PASSES, len(travel) - 1)
    gained, spent = np.zeros(horizon), np.zeros((horizon, 2))
    each = np.arange(_PASSES)
    for number in range(horizon):
        p = (flat @ belief).reshape(count, num_outcomes, _PASSES)
        gains = special.entr(p).sum(axis=1) - noise @ belief
        seconds = travel[place].T + (p * extra[..., None]).sum(axis=1)
        chosen = (gains / seconds).argmax(axis=0)
        below = table[chosen, :, truth].cumsum(axis=1)[:, :-1]
        outcome = (rng.random((_PASSES, 1)) >= below).sum(axis=1)
        gained[number] = gains[chosen, each].mean()
        took = travel[place, chosen] + extra[chosen, outcome]
        spent[number] = took.mean(), uses[chosen, outcome].mean()
        belief = belief * table[chosen, outcome].T
        belief /= belief.sum(axis=0)
        place = after[chosen, outcome]
    gained = gained.cumsum()
    enough = int(np.argmax(gained >= _ENOUGH * gained[-1])) + 1
    seconds, used = spent[:enough].sum(axis=0)
    return {"number": enough, "seconds": float(seconds), "uses": float(used)}


def _with_uninformative(rng: np.random.Generator, asked: Questions) -> Questions:
    """In a fifth of tasks, outcomes of a few designs are made independent of theta."""
    count, num_outcomes = asked.likelihood.shape[:2]
    if rng.random() > 0.2:
        return asked
    number = int(rng.integers(1, max(count // 4, 1) + 1))
    which = rng.choice(count, number, replace=False)
    table = asked.likelihood.copy()
    table[which] = rng.dirichlet(np.ones(num_outcomes), number)[:, :, None]
    return Questions(asked.theta, asked.designs, table, asked.groups, asked.prior)


def _prior(rng: np.random.Generator, asked: Questions) -> Array:
    """(S,) prior: smooth hills, lumps and correlated coordinates, each at random."""
    theta = asked.theta
    count, dim = theta.shape
    log = np.zeros(count)
    if rng.random() < 0.5:
        rate = rng.uniform(1.0, 8.0) * rng.standard_normal((dim, 8))
        waves = np.cos(theta @ rate + rng.uniform(0.0, 2.0 * np.pi, 8))
        log += rng.uniform(0.2, 2.0) * waves @ rng.standard_normal(8) / 2.0
    if rng.random() < 0.25:
        log += rng.uniform(0.5, 3.0) * (rng.random(count) < rng.uniform(0.05, 0.5))
    if dim > 1 and rng.random() < 0.5:
        log -= (
            0.5 * ((theta - theta[:, :1]) ** 2).sum(axis=1) / rng.uniform(0.1, 0.8) ** 2
        )
    weights = np.exp(log - log.max())
    if asked.prior is not None:
        weights = weights * asked.prior
    weights = weights / weights.sum()
    least = min(_UNKNOWN, 0.9 * np.log((weights > 0.0).sum()))
    while special.entr(weights).sum() < least:
        weights = weights**0.7
        weights = weights / weights.sum()
    return weights


def _travel(rng: np.random.Generator, asked: Questions) -> tuple[float, Array]:
    """Seconds of a measurement, and (A + 1, A) of going there; the last is the start.

    The unit of time is drawn too, because no decider may depend on it.
    """
    at = np.concatenate([asked.designs, asked.designs[:1] * 0.0])
    group = np.append(asked.groups, 0)
    base = float(np.exp(rng.uniform(-2.0, 3.0)))
    away = np.abs(at[:, None] - at[None, :-1])
    away = away.max(axis=-1) if rng.random() < 0.5 else away.sum(axis=-1)
    speed = np.exp(rng.uniform(np.log(0.3), np.log(15.0)))
    speed *= base * (rng.random() < 0.75)
    change = base * rng.choice([0.0, rng.uniform(0.5, 6.0)])
    own = np.ones(len(at) - 1)
    if rng.random() < 0.25:  # some designs take longer than others
        own = np.exp(rng.uniform(0.5, 2.0) * asked.designs[:, -1])
    other = group[:, None] != group[None, :-1]
    return base, base * own + speed * away + change * other


def _uses(rng: np.random.Generator, asked: Questions) -> Array:
    """(A, Y) uses that an outcome takes: of some outcomes, or of some designs."""
    count, num_outcomes = asked.likelihood.shape[:2]
    uses = np.zeros((count, num_outcomes))
    kind = rng.random()
    if kind < 0.75:  # the last outcomes, or the first
        number = int(rng.integers(1, max(num_outcomes // 2, 1) + 1))
        uses[:, -number:] = 1.0
        if rng.random() < 0.3:
            uses = uses[:, ::-1]
    elif kind < 0.9:  # some designs, whatever the outcome
        uses[rng.random(count) < rng.uniform(0.2, 0.7)] = 1.0
    else:  # outcomes of some designs alone
        uses[rng.random(count) < rng.uniform(0.3, 0.8), -1] = 1.0
    if rng.random() < 0.1:
        uses[uses.sum(axis=1) > 0] *= rng.choice([1.0, 2.0])
    return uses.copy()
