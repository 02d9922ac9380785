"""Deciders of sequential measurement on equal sessions: nats, pairs, time a choice."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxcal.adaptive.episodes import Comparison, compare
from jaxcal.adaptive.fit_ahead import fit, outside
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.lookahead import AHEAD
from jaxcal.adaptive.policy import run as policies
from jaxcal.adaptive.rules import (
    SHARES,
    CostRule,
    Gain,
    GainRate,
    Priced,
    Random,
    StateRule,
)
from jaxcal.adaptive.tasks.registry import Entry
from jaxcal.adaptive.tuning import tune

__all__ = ["METHODS", "Result", "evaluate", "seconds_a_choice"]

METHODS = {
    "random": "any measurement",
    "gain": "the largest expected information gain (EIG)",
    "rate": "the largest EIG a second",
    "shares": "EIG per share of time, uses and number left; its constants are fixed",
    "ahead": "shares, over a tree of the next measurements, fitted to the task first",
    "priced": "EIG per price of time and uses, its constants tuned",
    "state": "the same with prices that follow what is left, tuned",
    "policy": "the network that corrects the state rule",
}
_GENERATIONS = 20  # of tuning
_TIMED = 128  # sessions on which a choice is timed
_BATCH = 1024  # sessions at once

Progress = Callable[[str, int, int], None]


@dataclasses.dataclass(frozen=True)
class Result:
    """A table: what each method gains on the same sessions."""

    task: str
    options: Mapping[str, Any]
    seed: int
    reference: str  # whom the others are compared with in pairs
    comparison: Comparison
    seconds: NDArray[np.float64]  # (D,) of one core, a choice
    rules: Mapping[str, CostRule]
    checkpoint: Mapping[str, Any] | None  # meta of the policy
    outside: tuple[str, ...]  # sizes beyond those that ``ahead`` was measured on


def evaluate(
    name: str,
    entry: Entry,
    options: Mapping[str, Any],
    methods: Sequence[str],
    *,
    checkpoint: str | None = None,
    episodes: int = 4096,
    seed: int = 0,
    retune: bool = False,
    progress: Progress = lambda what, done, of: None,
) -> Result:
    """Play every method on the same sessions.

    Args:
        name, entry, options: the task, its entry and options of ``entry.make``.
        methods: of ``METHODS``.
        checkpoint: of the policy; the one that ships when None.
        episodes: sessions.
        seed: of the sessions.
        retune: tune the rules on this task instead of taking the constants that ship.
        progress: told what is done.

    Raises:
        ValueError: an unknown method, or options that the task refuses.
        CheckpointError: there is no such policy.
    """
    for method in methods:
        if method not in METHODS:
            raise ValueError(f"methods must be of {', '.join(METHODS)}, got {method!r}")
    task = jax.tree.map(jnp.asarray, entry.make(**options))
    trained = policies.load(checkpoint) if "policy" in methods else None
    needed = [m for m in ("priced", "state") if m in methods]
    rules = _rules(entry, task, needed, retune, seed, progress)
    played_by, seconds = [], []
    for method in methods:
        if method == "policy":
            assert trained is not None  # loaded above
            decider: Any = trained.decider
        elif method == "ahead" and isinstance(task, GridTask):
            progress("fitting ahead", 0, 1)
            decider = fit(task, seed=seed + 1).decider  # other sessions than judge it
        else:
            decider = _decider(method, rules)
        decider = jax.tree.map(jnp.asarray, decider)
        played = compare(
            task,
            {method: decider},
            episodes,
            seed,
            batch=_BATCH,
            progress=lambda done, method=method: progress(method, done, episodes),  # type: ignore[misc]  # default binds the loop's value
        )
        played_by.append(played)
        seconds.append(seconds_a_choice(task, decider, seed))
    whole = Comparison(
        tuple(methods),
        *(
            np.concatenate([getattr(one, field) for one in played_by])
            for field in ("gain", "entropy_drop", "log_ratio", "choices")
        ),
    )
    rivals = [
        m
        for m in ("state", "ahead", "shares", "priced", "rate", "gain")
        if m in methods
    ]
    return Result(
        task=name,
        options=options,
        seed=seed,
        reference=[*rivals, methods[0]][0],
        comparison=whole,
        seconds=np.array(seconds),
        rules=rules,
        checkpoint=None if trained is None else trained.meta,
        outside=outside(task) if "ahead" in methods else (),
    )


def _rules(
    entry: Entry,
    task: Any,
    needed: Sequence[str],
    retune: bool,
    seed: int,
    progress: Progress,
) -> dict[str, CostRule]:
    """Priced rules: as they ship with the task, or tuned on it now."""
    rules = {}
    for name in needed:
        rule = entry.rules.get(name)
        if rule is None or retune:
            start = {"priced": Priced(), "state": StateRule()}[name]
            tell = functools.partial(progress, f"tuning {name}")
            tell(0, _GENERATIONS)
            # Sessions of another seed than those that judge it.
            rule = tune(
                task,
                start if rule is None else rule,
                episodes=1024,
                generations=_GENERATIONS,
                seed=seed + 1,
                report=lambda number, *_, tell=tell: tell(number, _GENERATIONS),
            )
        rules[name] = rule
    return rules


def _decider(method: str, rules: Mapping[str, CostRule]) -> Any:
    simple = {
        "random": Random(), "gain": Gain(), "rate": GainRate(), "shares": SHARES,
        "ahead": AHEAD,
    }  # fmt: skip
    return simple[method] if method in simple else rules[method]


@jax.jit
def _choose(task: Any, decider: Any, belief: Any, session: Any, keys: Any) -> Any:
    def one(belief: Any, session: Any, key: jax.Array) -> jax.Array:
        key_options, key_choice = jax.random.split(key)
        options = task.options(belief, session, key_options)
        return decider(task, belief, session, options, key_choice)

    return jax.vmap(one)(belief, session, keys)


def seconds_a_choice(task: Any, decider: Any, seed: int) -> float:
    """Processor time of a first choice, in a batch; that of all threads counts."""
    count = min(_TIMED, getattr(task, "batch", _TIMED))
    keys = jax.random.split(jax.random.key(seed), count)
    states = jax.jit(lambda task, keys: jax.vmap(task.begin)(keys))(task, keys)
    jax.block_until_ready(_choose(task, decider, *states, keys))
    best = np.inf
    for _ in range(5):
        begun, passes = time.process_time(), 0
        while passes == 0 or time.process_time() - begun < 0.05:
            jax.block_until_ready(_choose(task, decider, *states, keys))
            passes += 1
        best = min(best, (time.process_time() - begun) / passes / count)
    return best
