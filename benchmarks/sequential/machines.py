"""Policies trained on three tasks of a machine, against what is not trained.

    python -m benchmarks.sequential.machines                # 20 minutes on one core
    python -m benchmarks.sequential.machines --only backlash --seeds 1 --updates 20

Backlash, transmission error and breakaway on coarse grids, each with a budget of time.
The rule ``state`` is tuned on each, ``ahead`` is fitted, and a policy is trained from
the rule for each seed; all play the same sessions.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Mapping
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcal.adaptive.episodes import compare
from jaxcal.adaptive.evaluation import seconds_a_choice
from jaxcal.adaptive.lookahead import fit
from jaxcal.adaptive.policy import training
from jaxcal.adaptive.policy.config import PPO, PolicyConfig
from jaxcal.adaptive.rules import SHARES, Gain, StateRule
from jaxcal.adaptive.tasks import registry
from jaxcal.adaptive.tuning import tune
from jaxcal.arguments import Parser, several, values_of

__all__ = ["TASKS", "main"]

TASKS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "backlash": (
        "examples/tasks/backlash.py",
        {"cells": 24, "offset_cells": 5, "bin_width": 0.1, "sigma": 0.05,
         "seconds": (5.0, 20.0)},
    ),
    "transmission": (
        "examples/tasks/transmission.py",
        {"cells": 24, "phases": 8, "num_postures": 25, "num_bins": 8,
         "seconds": (6.0, 24.0)},
    ),
    "breakaway": (
        "benchmarks/tasks/breakaway.py",
        {"cells": 24, "spread": 0.01, "seconds": (8.0, 24.0)},
    ),
}  # fmt: skip


@dataclasses.dataclass
class Options:
    """What is trained and played."""

    only: Annotated[
        list[str] | None, "tasks, comma separated", "LIST", several(str, "names")
    ] = None
    seeds: Annotated[int, "policies of each task", (1,)] = 3
    seed: Annotated[int, "of the first", "S", (0,)] = 0
    updates: Annotated[int, "of each training", (1,)] = 70
    episodes: Annotated[int, "sessions that all play", (2,)] = 4096


def main(options: Options) -> None:
    """Train, play and print a row for each method."""
    print("| task | method | nats | less `ahead` | ms a choice | trained, s |")
    print("|---|---|---|---|---|---|")
    for name in options.only or TASKS:
        rows(name, options)


def rows(name: str, options: Options) -> None:
    """Rows of one task, as they are ready."""
    path, values = TASKS[name]
    task = jax.tree.map(jnp.asarray, registry.load(path).make(**values))
    rule = tune(task, StateRule(), episodes=1024, generations=14, seed=1)
    constants = {f.name: float(getattr(rule, f.name)) for f in dataclasses.fields(rule)}
    base = StateRule(**constants)

    def played(decider: Any) -> np.ndarray:
        decider = jax.tree.map(jnp.asarray, decider)
        gain: np.ndarray = compare(task, {name: decider}, options.episodes, 7).gain[0]
        return gain

    ahead = fit(task, seed=2)
    least = played(ahead)

    def row(method: str, decider: Any, trained: str = "") -> None:
        gain = played(decider)
        less = gain - least
        (nats, error), (more, its) = (
            (x.mean(), x.std(ddof=1) / np.sqrt(len(x))) for x in (gain, less)
        )
        difference = "" if method == "`ahead`" else f"{more:+.3f} ± {its:.3f}"
        ms = 1e3 * seconds_a_choice(task, jax.tree.map(jnp.asarray, decider), 0)
        print(
            f"| {name} | {method} | {nats:.3f} ± {error:.3f} | {difference} | "
            f"{ms:.3f} | {trained} |",
            flush=True,
        )

    rules = {"gain": Gain(), "shares": SHARES, "ahead": ahead, "state": base}
    for method, decider in rules.items():
        row(f"`{method}`", decider)
    for seed in range(options.seed, options.seed + options.seeds):
        config = PolicyConfig(
            path, base, values, seed=seed,
            ppo=dataclasses.replace(PPO, num_updates=options.updates),
        )  # fmt: skip
        with tempfile.TemporaryDirectory() as folder:
            begun = time.perf_counter()
            training.train(config, folder)
            seconds = time.perf_counter() - begun
            row(
                f"`policy`, seed {seed}",
                training.load(folder).decider,
                f"{seconds:.0f}",
            )


if __name__ == "__main__":
    command = Parser(prog="python -m benchmarks.sequential.machines").of(main)
    main(**values_of(command.parse_args()))
