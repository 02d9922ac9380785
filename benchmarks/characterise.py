"""Measurements until play, dead zone and breakaway are known to 0.02 degrees.

    python benchmarks/characterise.py [--sessions N] [--seed S] [--sigma DEG]

The tasks are those of `jaxcal-rig characterise` on cells of 0.01 degrees: play with the
direction of approach (seven postures each way), dead zone by command, breakaway by
steps from rest in one direction. Every session has a truth drawn from the prior; it is
over when the 95 % interval is 0.02 degrees wide.

Deciders: a random measurement; the best fixed plan (each entry the measurement that
gains most on average over all sessions, whatever they answered; for the breakaway the
better of that and an exchange of all its entries); the largest expected gain (EIG); for
the breakaway also EIG under the limit that the rig keeps: a step exceeds the threshold
by 0.1 degrees with a probability of 5 % at most. Sessions of all deciders have the same
truths.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.sequential.sequence import optimise
from benchmarks.tasks.breakaway import Cautious, breakaway
from examples.tasks.backlash import backlash, dead_zone
from jaxcal.adaptive.grid import GridBelief, GridTask
from jaxcal.adaptive.loop import estimates
from jaxcal.adaptive.rules import Gain, Random

ENOUGH_DEG = 0.02
Chooser = Callable[[int, Any, Any, Any], Any]  # number, weights, gains, keys: designs


def tasks(sigma: float, measurements: int) -> dict[str, GridTask]:
    """By name; the first unknown is the one whose interval counts."""
    return {
        "play": backlash(
            1.5, 0.05, cells=150, offset_cells=5, postures=np.linspace(0.0, 2.25, 7),
            sigma=sigma, bin_width=0.01, measurements=measurements,
        ),
        "dead zone": dead_zone(
            0.8, 0.2, cells=80, offset_cells=16, reach=0.8, reference=0.8,
            num_postures=17, sigma=sigma, bin_width=0.01, measurements=measurements,
        ),
        "breakaway": breakaway(
            directions=1, sigma=2.0**0.5 * sigma, measurements=measurements
        ),
    }  # fmt: skip


@jax.jit
def weighed(task: GridTask, weights: jax.Array) -> jax.Array:
    """(N, A) gains of every design."""
    options = task.options(GridBelief(task.prior), task.session(np.inf, 1))
    return jax.vmap(lambda w: GridBelief(w).gains(task, options))(weights)


@jax.jit
def measured(
    task: GridTask, truth: jax.Array, weights: jax.Array, designs: Any, keys: Any
) -> jax.Array:
    """(N, S) weights after a measurement of each session."""

    def one(truth: Any, weights: Any, design: Any, key: Any) -> jax.Array:
        outcome = task.measure(truth, design, key)
        return GridBelief(weights).update(task, design, outcome).weights

    return jax.vmap(one)(truth, weights, designs, keys)


def each(task: GridTask, decider: Any) -> Chooser:
    """A decider that looks at its own session."""

    @jax.jit
    def choose(task: GridTask, weights: Any, keys: Any) -> jax.Array:
        session = task.session(np.inf, 1)

        def one(weights: Any, key: Any) -> jax.Array:
            belief = GridBelief(weights)
            options = task.options(belief, session)
            return decider(task, belief, session, options, key)

        return jax.vmap(one)(weights, keys)

    return lambda number, weights, gains, keys: choose(task, weights, keys)


def fixed(number: int, weights: Any, gains: Any, keys: Any) -> Any:
    """Index (B,) of what gains most on average, alike in every session."""
    return jnp.full(len(gains), gains.mean(axis=0).argmax())


def planned(task: GridTask, seed: int) -> Chooser:
    """A sequence whose entries were exchanged."""
    length = min(task.horizon, 24)  # nearly all sessions are over by then
    plan = optimise(task, length=length, episodes=256, sweeps=1, seed=seed).sequence
    return lambda number, weights, gains, keys: jnp.full(
        len(gains), plan[number % length]
    )


def sessions(
    task: GridTask, choose: Chooser, count: int, seed: int
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """(N,) measurements until the interval is narrow; (N,) largest step too far."""
    key_truth, key = jax.random.split(jax.random.key(seed))
    truth = jax.vmap(task.draw)(jax.random.split(key_truth, count))
    weights = jnp.tile(task.prior, (count, 1))
    needed, over = np.full(count, task.horizon + 1), np.zeros(count)
    unknown = np.asarray(task.theta)[np.asarray(truth), 0]
    for number in range(task.horizon):
        key, key_choice, key_outcome = jax.random.split(key, 3)
        designs = choose(
            number, weights, weighed(task, weights), jax.random.split(key_choice, count)
        )
        keys = jax.random.split(key_outcome, count)
        weights = measured(task, truth, weights, designs, keys)
        left = needed > task.horizon
        step = np.asarray(task.designs)[np.asarray(designs), 0]
        over = np.where(left, np.maximum(over, step - unknown), over)
        table = np.asarray(weights)
        for i in np.flatnonzero(left):
            found = estimates(task, GridBelief(table[i]))[task.theta_names[0]]
            if found.width <= ENOUGH_DEG:
                needed[i] = number + 1
        if (needed <= task.horizon).all():
            break
    return needed, over


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sessions", type=int, default=256)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--sigma", type=float, default=0.01, help="of a reading, degrees of commands"
    )
    parser.add_argument("--measurements", type=int, default=60, help="measurements")
    given = parser.parse_args()
    print(
        "| unknown | decider | median | 90 % within | mean | longest step past, deg |"
    )
    print("|---|---|---|---|---|---|")
    for name, task in tasks(given.sigma, given.measurements).items():
        choosers = {"random": [each(task, Random())], "fixed plan": [fixed]}
        if name == "breakaway":
            choosers["fixed plan"].append(planned(task, given.seed))
        choosers["EIG"] = [each(task, Gain())]
        if name == "breakaway":
            choosers["EIG, limited"] = [each(task, Cautious())]
        for decider, tried in choosers.items():
            found = [sessions(task, by, given.sessions, given.seed) for by in tried]
            needed, over = min(found, key=lambda pair: pair[0].mean())
            median, ninety = np.quantile(needed, [0.5, 0.9], method="higher")
            shown = [f"{n}" if n <= task.horizon else f"over {task.horizon}"
                     for n in (median, ninety)]  # fmt: skip
            mean = (
                f"{needed.mean():.1f} +- {needed.std(ddof=1) / len(needed) ** 0.5:.1f}"
            )
            if (needed > task.horizon).any():
                mean = f"at least {mean}"
            far = ""
            if name == "breakaway":
                low, high = np.quantile(over, [0.5, 0.95])
                far = f"median {low:.2f}, 95 % under {high:.2f}"
            print(f"| {name} | {decider} | {shown[0]} | {shown[1]} | {mean} | {far} |",
                  flush=True)  # fmt: skip
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
