"""The constants of a priced rule, tuned on a task by the cross-entropy method."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxcal.adaptive.episodes import play
from jaxcal.adaptive.rules import Rule
from jaxcal.adaptive.session import SequentialTask
from jaxcal.checks import whole_number

R = TypeVar("R", bound=Rule)

_SPREAD = 0.7  # of the first generation, in units of ``Rule.moved``
_SMOOTH = 0.7  # weight of the elite in the next mean and spread


def tune(
    task: SequentialTask,
    rule: R,
    *,
    episodes: int = 2048,
    generations: int = 20,
    population: int = 24,
    elite: int = 6,
    seed: int = 0,
    report: Callable[[int, float, R], None] = lambda number, nats, rule: None,
) -> R:
    """The rule with the constants that gain most on a task's sessions.

    Every set of constants plays the same sessions, others in each generation, so that
    sets are compared in pairs and none is chosen for the sessions it drew.
    Rules are pytrees: all sets run through one compiled program.

    Args:
        task: whose sessions are played.
        rule: where to start.
        episodes: sessions of a generation.
        generations, population, elite: of the cross-entropy method.
        seed: of the sessions and of the search.
        report: called after each generation with its number, the elite's mean of nats
            and the rule at its centre.
    """
    for name, value in (("episodes", episodes), ("generations", generations)):
        whole_number(name, value, 1)
    if not 1 < elite < population:
        raise ValueError(
            f"elite must be between 1 and population = {population}, got {elite}"
        )

    def nats(rule: R, number: int) -> float:
        key = jax.random.fold_in(jax.random.key(seed), number)
        keys = jax.random.split(key, episodes)
        arrays = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), rule)
        return float(play(task, arrays, keys).gain.mean())

    return search(
        rule, generations, population, elite, seed, nats_of=nats, report=report
    )


def search(
    rule: R,
    generations: int,
    population: int,
    elite: int,
    seed: int,
    *,
    nats_of: Callable[[R, int], float],
    spread: float = _SPREAD,
    report: Callable[[int, float, R], None] = lambda number, nats, rule: None,
) -> R:
    """Cross-entropy search that maximises ``nats_of(rule, generation)``."""
    rng = np.random.default_rng(seed)
    centre = np.zeros(rule.num_free)
    spreads = np.full(rule.num_free, spread)
    for number in range(generations):
        tried = centre + spreads * rng.standard_normal((population, rule.num_free))
        tried[0] = centre
        nats = np.array([nats_of(rule.moved(x), number) for x in tried])
        best = np.argsort(-nats)[:elite]
        centre = (1 - _SMOOTH) * centre + _SMOOTH * tried[best].mean(axis=0)
        spreads = (1 - _SMOOTH) * spreads + _SMOOTH * tried[best].std(axis=0)
        report(number + 1, float(nats[best].mean()), rule.moved(centre))
    return rule.moved(centre)
