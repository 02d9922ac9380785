"""Deciders of sequential measurement on equal sessions: nats, pairs, time a choice."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jaxcal.adaptive.episodes import compare
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.lookahead import AHEAD, fit
from jaxcal.adaptive.policy import training as policies
from jaxcal.adaptive.rules import (
    SHARES,
    Gain,
    GainRate,
    Priced,
    Random,
    StateRule,
)
from jaxcal.adaptive.session import jit_by_class
from jaxcal.adaptive.tasks.registry import Entry
from jaxcal.adaptive.tuning import tune
from jaxcal.checks import Array
from jaxcal.evaluation.report import Evaluation, MethodResult, Summary, finite

METHODS = {
    "random": "any measurement",
    "gain": "the largest expected information gain (EIG)",
    "rate": "the largest expected information gain per second",
    "shares": "EIG per share of time, uses and number left; constants not tuned",
    "ahead": "shares, over a tree of the next measurements; constants tuned first",
    "priced": "EIG per price of time and uses; constants tuned",
    "state": "EIG per price that depends on what is left; constants tuned",
    "policy": "the trained network, which corrects a rule",
}
_RIVALS = ("state", "ahead", "shares", "priced", "rate", "gain")
_GENERATIONS = 20  # of tuning
_TIMED = 128  # sessions on which a choice is timed

Progress = Callable[[str, int, int], None]


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class DeciderResult(MethodResult):
    """What one method learned in every session; ``values`` (B, 1) in nats."""

    entropy_drop: Array  # (B,) nats
    log_ratio: Array  # (B,) log posterior less log prior, at the truth
    choices: Array  # (B,) measurements made


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class DeciderEvaluation(Evaluation):
    """Deciders on the same sessions; ``reference`` (B,) are the nats of ``rival``."""

    title: ClassVar[str] = "Sequential measurement: deciders in equal sessions"
    about: ClassVar[str] = (
        "All methods play the same sessions, with the same truth, budget and noise of "
        "every measurement. Nats: sum of the expected information gains of the "
        "measurements, with its standard error (95 % intervals in the figure). Time: "
        "per choice on one core, averaged over a batch."
    )

    task: str
    options: Mapping[str, Any]
    results: tuple[DeciderResult, ...]
    rival: str  # the method that the others are compared with in pairs
    rules: Mapping[str, Any]

    def summarise(self) -> Summary:
        """What table, page and JSON show."""
        shown = ", ".join(f"{name} = {value}" for name, value in self.options.items())
        sessions, rival = len(self.reference), self.rival
        return Summary(
            "",
            f"{self.task}{f' ({shown})' if shown else ''}, seed {self.seed}: "
            f"{sessions:,} sessions, information gained in nats",
            (
                ("method", lambda row: row.result.method),
                ("nats", lambda row: _interval(row.numbers["nats"], "")),
                (
                    f"less {rival}, paired",
                    lambda row: _interval(row.numbers["paired"].get(rival), "+"),
                ),
                ("choices", lambda row: f"{row.numbers['choices']:.1f}"),
                (
                    "time each",
                    lambda row: f"{1e3 * row.numbers['seconds_per_choice']:.3g} ms",
                ),
            ),
            self.rows(),
            {
                "task": self.task,
                "options": dict(self.options),
                "episodes": sessions,
                "seed": self.seed,
            },
        )

    def summary(self, result: DeciderResult) -> dict[str, Any]:
        """The numbers of one method, as documented in docs/evaluation.md."""
        numbers = {
            "label": result.label,
            "nats": _moments(result.values[:, 0]),
            "entropy_drop": _moments(result.entropy_drop),
            "log_ratio_at_truth": _moments(result.log_ratio),
            "choices": float(result.choices.mean()),
            "seconds_per_choice": float(result.seconds),
            "paired": {
                other.method: _moments((result.values - other.values)[:, 0])
                for other in self.results
                if other is not result
            },
        }
        if result.method in self.rules:
            constants = dataclasses.asdict(self.rules[result.method])
            numbers["constants"] = {name: float(x) for name, x in constants.items()}
        return numbers


def _moments(values: Array) -> dict[str, float | None]:
    error = values.std(ddof=1) / np.sqrt(len(values))
    return {"mean": finite(values.mean()), "standard_error": finite(error)}


def _interval(numbers: Mapping[str, Any] | None, sign: str) -> str:
    if numbers is None or numbers["mean"] is None:  # the rival itself
        return ""
    return f"{numbers['mean']:{sign}.3f} ± {numbers['standard_error']:.3f}"


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
) -> DeciderEvaluation:
    """Play every method, of ``METHODS``, on the same sessions of a seed; refused are
    another method, options that the task does not take, and a policy that is missing.

    Args:
        name, entry, options: the task, its entry and options of ``entry.make``.
        checkpoint: of the policy; the one that ships when None.
        retune: tune the rules on this task instead of taking the constants that ship.
    """
    for method in methods:
        if method not in METHODS:
            raise ValueError(f"methods must be of {', '.join(METHODS)}, got {method!r}")
    task = jax.tree.map(jnp.asarray, entry.make(**options))
    trained = policies.load(checkpoint) if "policy" in methods else None
    rules: dict[str, Any] = {}
    for rule, start in {"priced": Priced(), "state": StateRule()}.items():
        if rule in methods:
            rules[rule] = entry.rules.get(rule, start)
            if retune or rule not in entry.rules:
                progress(f"tuning {rule}", 0, _GENERATIONS)
                # On sessions of another seed than those that judge it.
                rules[rule] = tune(
                    task,
                    rules[rule],
                    episodes=1024,
                    generations=_GENERATIONS,
                    seed=seed + 1,
                    report=lambda number, *_, rule=rule: progress(
                        f"tuning {rule}", number, _GENERATIONS
                    ),
                )
    deciders: dict[str, Any] = {
        "random": Random(), "gain": Gain(), "rate": GainRate(), "shares": SHARES,
        "ahead": AHEAD, **rules,
    }  # fmt: skip
    if trained is not None:
        deciders["policy"] = trained.decider
    if "ahead" in methods and isinstance(task, GridTask):
        progress("fitting ahead", 0, 1)  # on other sessions than judge it
        deciders["ahead"] = fit(task, seed=seed + 1)
    results = []
    for method in methods:
        decider = jax.tree.map(jnp.asarray, deciders[method])
        played = compare(
            task,
            {method: decider},
            episodes,
            seed,
            progress=lambda done, method=method: progress(method, done, episodes),  # type: ignore[misc]  # default binds the loop's value
        )
        result = DeciderResult(
            method=method,
            checkpoint=trained.meta if trained and method == "policy" else None,
            label=METHODS[method],
            values=played.gain.T,
            seconds=seconds_a_choice(task, decider, seed),
            entropy_drop=played.entropy_drop[0],
            log_ratio=played.log_ratio[0],
            choices=played.choices[0],
        )
        results.append(result)
    rival = next((name for name in _RIVALS if name in methods), methods[0])
    return DeciderEvaluation(
        task=name,
        options=options,
        seed=seed,
        results=tuple(results),
        reference=results[methods.index(rival)].values[:, 0],
        rival=rival,
        rules=rules,
    )


@jit_by_class
def _choose(task: Any, decider: Any, belief: Any, session: Any, keys: Any) -> Any:
    def one(belief: Any, session: Any, key: jax.Array) -> jax.Array:
        key_options, key_choice = jax.random.split(key)
        options = task.options(belief, session, key_options)
        return decider(task, belief, session, options, key_choice)

    return jax.vmap(one)(belief, session, keys)


@jit_by_class
def _begin(task: Any, keys: jax.Array) -> Any:
    return jax.vmap(task.begin)(keys)


def seconds_a_choice(task: Any, decider: Any, seed: int) -> float:
    """Processor time of a first choice, in a batch; that of all threads counts."""
    count = min(_TIMED, getattr(task, "batch", _TIMED))
    keys = jax.random.split(jax.random.key(seed), count)
    states = _begin(task, keys)
    jax.block_until_ready(_choose(task, decider, *states, keys))
    best = np.inf
    for _ in range(5):
        begun, passes = time.process_time(), 0
        while passes == 0 or time.process_time() - begun < 0.05:
            jax.block_until_ready(_choose(task, decider, *states, keys))
            passes += 1
        best = min(best, (time.process_time() - begun) / passes / count)
    return best


def decider_figures(evaluation: DeciderEvaluation) -> dict[str, Any]:
    """Mean nats by method, and less those of the rival in pairs, 95 % intervals."""
    from jaxcal.evaluation.figures import intervals, styles_of
    from jaxcal.reports.plots import GREY, panels

    results, rival = evaluation.results, evaluation.rival
    names = [result.method for result in results]
    size = (9.0, 0.9 + 0.42 * len(names))
    figure, axes_pair = panels(size, shape=(1, 2))
    nats_of = [result.values[:, 0] for result in results]
    less = [evaluation.less(result)[:, 0] for result in results]
    for axes, samples in zip(axes_pair, (nats_of, less), strict=True):
        ends = []
        for values in samples:
            half = 1.96 * values.std(ddof=1) / np.sqrt(len(values))
            ends.append(values.mean() + np.array([-half, 0.0, half]))
        intervals(axes, names, ends, styles_of(results))
    axes_pair[0].set_xlabel("information gained in a session (nats)")
    axes_pair[1].set_xlabel(f"paired difference to {rival} (nats)")
    axes_pair[1].axvline(0.0, color=GREY, linestyle="--", zorder=0)
    return {"sequential": figure}
