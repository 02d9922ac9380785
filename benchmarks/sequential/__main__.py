"""Public tasks of sequential design: a compiled look-ahead beside published figures.

    python -m benchmarks.sequential [--only ROW ...] [--episodes N] [--seed S]
        [--json FILE]

Every row plays N sessions in which each measurement is the candidate of the largest
expected information gain, one step ahead. Information is bounded from both sides with
contrasts from each session's posterior (sACE), or exact where the task is a grid. A
step is everything between two measurements: candidates, choice, update of the belief;
its time is CPU time, the process is pinned to one core. The sum of the gains that were
expected of each choice is a second estimate, of little variance but no bound. See
docs/sequential.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import pathlib
import time
from collections.abc import Callable
from typing import Any

if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from benchmarks.sequential.bounds import sace
from benchmarks.tasks.ces import ces
from benchmarks.tasks.death import death_process
from benchmarks.tasks.hyperbolic import hyperbolic
from benchmarks.tasks.location import LocationFinding, location_finding
from benchmarks.tasks.prey import prey
from jaxcal.adaptive.episodes import Episodes
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.particles import ParticleTask
from jaxcal.adaptive.rules import Gain
from jaxcal.adaptive.session import Session, jit_by_class
from jaxcal.files import write_text


@struct.dataclass
class Anywhere(LocationFinding):
    """Location finding at points drawn from the prior: a check of the task itself."""

    def propose(
        self, unknowns: jax.Array, session: Session, key: jax.Array, count: int
    ) -> jax.Array:
        return jax.random.normal(key, (count, 2))


@dataclasses.dataclass(frozen=True)
class Row:
    """One task and what is published of it."""

    make: Callable[[], Any]
    published: str
    episodes: int  # as in docs/sequential.md


ROWS = {
    "location": Row(
        location_finding,
        "DAD 10.93, RL 11.73 (sPCE, capped at 13.1 to 13.8); ALINE 13.5 (cap)",
        256,
    ),
    "location-random": Row(
        lambda: ParticleTask.make(Anywhere(), 30, candidates=1),
        "random 8.30 (sPCE, capped)",
        64,
    ),
    "location-one": Row(
        lambda: location_finding(1, uniform=True),
        "DAD 7.33, RL 7.70, ALINE 8.91",
        128,
    ),
    "ces": Row(ces, "DAD 10.77, ALINE 13.5, RL 14.60 (cap 16.1)", 256),
    "ces-variance": Row(lambda: ces(log_u_sd=3.0**0.5), "none", 96),
    "ces-budget": Row(
        lambda: ces(budget=100.0),
        "none of this prior",
        192,
    ),
    "ces-budget-code": Row(
        lambda: ces(budget=100.0, squeezed=True),
        "VPCE 2.18, ALINE 4.46, RL 4.93, COPEx 7.03 +- .55 at 19.5 s a decision",
        192,
    ),
    "hyperbolic": Row(hyperbolic, "DAD 5.02", 1024),
    "hyperbolic-text": Row(lambda: hyperbolic(as_code=False), "none", 256),
    "death": Row(death_process, "DAD 2.113", 4096),
    "prey": Row(prey, "none", 512),
    "prey-code": Row(lambda: prey(as_code=True), "SMC 4.521, RL 4.456", 256),
}


@jit_by_class
def session(task: Any, key: jax.Array) -> tuple[Episodes, jax.Array, jax.Array]:
    """One session by expected gain; the seconds left; entropy lost, where exact."""
    key_truth, key_begin, key_steps = jax.random.split(key, 3)
    truth = task.draw(key_truth)
    prior, begun = task.begin(key_begin)

    def step(carry: Any, key: jax.Array) -> tuple[Any, Any]:
        belief, at = carry
        key_options, key_choice, key_gain, key_outcome, key_update = jax.random.split(
            key, 5
        )
        options = task.options(belief, at, key_options)
        index = Gain()(task, belief, at, options, key_choice)
        design = jax.tree.map(lambda leaf: leaf[index], options.designs)
        gain = belief.gain(task, design, key_gain)
        outcome = task.measure(truth, design, key_outcome)
        after = (
            belief.update(task, design, outcome, key_update),
            task.spend(at, design, outcome),
        )
        alive = ~task.over(at)
        carry = jax.tree.map(lambda old, new: jnp.where(alive, new, old), carry, after)
        return carry, (design, outcome, gain, alive)

    (belief, end), (designs, outcomes, gains, alive) = jax.lax.scan(
        step, (prior, begun), jax.random.split(key_steps, task.horizon)
    )
    information = prior.entropy() - belief.entropy()
    none: Any = None
    episode = Episodes(truth, none, designs, outcomes, gains, alive, none, none)
    return episode, end.seconds, information


def run(row: Row, episodes: int, seed: int) -> dict[str, Any]:
    """Play, time and bound one row."""
    task = row.make()
    keys = jax.random.split(jax.random.key(seed), episodes + 1)
    jax.block_until_ready(session(task, keys[-1]))
    found, taken = [], []
    for key in keys[:-1]:
        start = time.process_time()
        found.append(jax.block_until_ready(session(task, key)))
        taken.append(time.process_time() - start)
    played, left, information = jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)
    gained = np.asarray(played.gain, np.float64)
    result = {
        "gains": [gained.mean(), gained.std(ddof=1) / np.sqrt(episodes)],
        "measurements": task.horizon,
        "episodes": episodes,
        "ms_a_step": 1e3 * float(np.median(taken)) / task.horizon,
        "least_left": float(np.min(left)),
        "published": row.published,
    }
    if isinstance(task, GridTask):
        exact = np.asarray(information, np.float64)
        mean, error = exact.mean(), exact.std(ddof=1) / np.sqrt(episodes)
        return result | {"nats": [mean, mean], "errors": [error, error], "exact": True}
    bounds = sace(task, played, jax.random.key(seed + 1))
    return result | {"nats": bounds.mean, "errors": bounds.error, "exact": False}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=ROWS, default=list(ROWS))
    parser.add_argument("--episodes", type=int, help="in place of each row's number")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=pathlib.Path)
    arguments = parser.parse_args()
    results = {}
    print("| task | T | nats | sum of gains | ms a step | published |")
    print("|---|---|---|---|---|---|")
    for name in arguments.only:
        row = ROWS[name]
        found = run(row, arguments.episodes or row.episodes, arguments.seed)
        results[name] = found
        (low, high), (error, _) = found["nats"], found["errors"]
        span = "(exact)" if found["exact"] else f"to {high:.3f}"
        print(
            f"| {name} | {found['measurements']} | {low:.3f} {span} +- {error:.3f} | "
            f"{found['gains'][0]:.3f} +- {found['gains'][1]:.3f} | "
            f"{found['ms_a_step']:.2f} | {row.published} |",
            flush=True,
        )
    if arguments.json:
        write_text(arguments.json, json.dumps(results, indent=2) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
