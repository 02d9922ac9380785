"""One policy on tasks it was not trained on, and with a belief that is wrong.

    python -m benchmarks.sequential.transfer [--checkpoint DIR] [--episodes 4096]
        [--seed 0] [--parts small table other wrong rollouts] [--small DIR]
        [--json FILE]

small   KNEE with 10 cells and no noise, whose optimum dynamic programming finds: the
        share of it that the rules reach, the policy, and with --small a policy that
        was trained on it (docs/adaptive.md has the command).
table   the optimum's table of nats by time and trips left as prices on KNEE itself,
        less the state rule: what is simple and not learned.

other   KNEE with another sigma, rho, slip, grid, number of joints or budget: the state
        rule with KNEE's constants, the state rule tuned on that task, and the policy.
wrong   the belief assumes KNEE's constants, the machine has others: what is quoted is
        the rise of the log posterior at the truth, which a wrong belief can make
        negative.

rollouts  simulations to the end under the state rule, by their number and margin, on
        KNEE and on its small version, beside the policy. Not among the parts run
        by default; --episodes 128 takes seven minutes of one core.

Differences are in pairs, on the same sessions, with standard errors.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import pathlib
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from benchmarks.sequential.deciders import Rollouts
from benchmarks.sequential.optimum import solve
from jaxcal.adaptive.episodes import compare
from jaxcal.adaptive.grid import GridBelief, GridTask
from jaxcal.adaptive.policy import training
from jaxcal.adaptive.rules import Gain, GainRate, best
from jaxcal.adaptive.tasks.knee import PRICED, STATE_RULE, knee
from jaxcal.adaptive.tuning import tune
from jaxcal.extras import versions
from jaxcal.files import require_writable_folder, write_text
from jaxcal.learning.runtime import processes

OTHER: dict[str, dict[str, Any]] = {
    "as trained": {},
    "sigma 0.005": {"sigma": 0.005},
    "sigma 0.06": {"sigma": 0.06},
    "slip 0.05": {"slip": 0.05},
    "rho 0": {"rho": 0.0},
    "rho 0.9": {"rho": 0.9},
    "16 cells": {"cells": 16},
    "48 cells": {"cells": 48},
    "1 joint": {"joints": 1},
    "3 joints of 12 cells": {"joints": 3, "cells": 12},
    "4 to 10 s": {"seconds": (4.0, 10.0)},
    "30 to 60 s": {"seconds": (30.0, 60.0)},
    "5 trips": {"trips": 5},
    "slow travel": {"travel_s": 6.0, "change_s": 6.0},
    "reset 5 s": {"reset_s": 5.0},
}
WRONG: dict[str, dict[str, Any]] = {
    "none": {},
    "rho is 0": {"rho": 0.0},
    "rho is 0.9": {"rho": 0.9},
    "sigma is 0.04": {"sigma": 0.04},
    "slip is 0.03": {"slip": 0.03},
}


@struct.dataclass
class Misled:
    """A machine of one task, played with the belief of another of the same designs."""

    believed: GridTask
    real: GridTask

    def __getattr__(self, name: str) -> Any:
        return getattr(self.believed, name)

    def draw(self, key: jax.Array) -> jax.Array:
        return self.real.draw(key)

    def measure(self, truth: jax.Array, design: jax.Array, key: jax.Array) -> jax.Array:
        return self.real.measure(truth, design, key)


def tuned_on(task: GridTask, seed: int) -> Any:
    """The state rule, its constants tuned on another task."""
    return tune(
        task, STATE_RULE, episodes=1024, generations=6, population=12, elite=4,
        seed=seed + 1,
    )  # fmt: skip


@struct.dataclass
class Table:
    """EIG, and what a table says of the time and trips that are left after it.

    The table is of whole sessions: what is left counts by the share of the prior's
    entropy that is still there, to a power.
    """

    values: jax.Array  # (ticks + 1, uses + 1) nats
    tick: Any  # seconds
    scale: Any
    power: Any

    def __call__(
        self, task: Any, belief: Any, session: Any, options: Any, key: jax.Array
    ) -> jax.Array:
        seconds = session.seconds - options.seconds[:, None] - task.extra
        uses = session.uses - task.uses
        last_tick, last_use = (length - 1 for length in self.values.shape)
        at = jnp.clip(seconds / self.tick, 0, last_tick)
        low = jnp.minimum(at.astype(jnp.int32), last_tick - 1)
        kept = jnp.clip(uses, 0, last_use)
        one, other = self.values[low, kept], self.values[low + 1, kept]
        value = jnp.where(
            (seconds > 0) & (uses > 0), one + (at - low) * (other - one), 0
        )
        share = belief.entropy() / GridBelief(task.prior).entropy()
        later = (belief.predictive(task) * value).sum(-1)
        scale = self.scale * jnp.maximum(share, 0.0) ** self.power
        return best(belief.gains(task, options) + scale * later, options)


def table(episodes: int, seed: int) -> list[dict[str, Any]]:
    """KNEE by the small version's table."""
    optimum = solve(knee(10, sigma=0.0, slip=0.0), 0.2)
    values = jnp.asarray(optimum.values)
    deciders: dict[str, Any] = {"state": STATE_RULE}
    for scale, power in itertools.product((0.5, 0.7, 0.9, 1.1), (0.5, 1.0)):
        name = f"scale {scale} power {power}"
        deciders[name] = Table(values, optimum.tick, scale, power)
    found = compare(arrays(knee()), arrays(deciders), episodes, seed)
    rows = []
    print(f"{'table':24}{'nats':>8}{'less state':>18}")
    for name in found.names[1:]:
        less = found.paired(name, "state")
        rows.append({"table": name, "nats": found.mean(name), "less_state": less})
        print(f"{name:24}{found.mean(name)[0]:8.3f}" + shown(less, 18), flush=True)
    return rows


def small(policies: dict[str, Any], episodes: int, seed: int) -> dict[str, Any]:
    """Shares of the optimum."""
    task = knee(10, sigma=0.0, slip=0.0)
    optimum = solve(task, 0.2)
    task = arrays(task)
    deciders = {
        "optimum": optimum.decider, "gain": Gain(), "rate": GainRate(),
        "priced": PRICED, "state": STATE_RULE, "tuned": tuned_on(task, seed),
    }  # fmt: skip
    found = compare(task, arrays(deciders | policies), episodes, seed)
    rows: dict[str, Any] = {"optimum": optimum.mean, "nats": {}, "share": {}}
    print(f"small: the optimum is {optimum.mean:.3f} nats")
    print(f"{'decider':12}{'nats':>16}{'% of the optimum':>20}")
    for name in found.names:
        rows["nats"][name] = found.mean(name)
        less, error = found.paired(name, "optimum")
        share = [100 * (1 + less / optimum.mean), 100 * error / optimum.mean]
        rows["share"][name] = share
        nats = "{:.3f} ± {:.3f}".format(*found.mean(name))
        print(f"{name:12}{nats:>16}" + "{:.2f} ± {:.2f}".format(*share).rjust(20))
    return rows


def rollouts(policy: Any, episodes: int, seed: int) -> dict[str, Any]:
    """Rollouts by number and margin less the state rule, and less the policy."""
    versions = {"KNEE": knee(), "small": knee(10, sigma=0.0, slip=0.0)}
    rows: dict[str, Any] = {}
    for version, task in versions.items():
        deciders = {"state": STATE_RULE, "policy": policy}
        for count, doubt in itertools.product((16, 64), (0.0, 1.0, 2.0, 3.0)):
            name = f"{count} rollouts, {doubt:g} errors"
            deciders[name] = Rollouts(STATE_RULE, rollouts=count, doubt=doubt)
        begun = time.process_time()
        found = compare(arrays(task), arrays(deciders), episodes, seed, batch=64)
        took = time.process_time() - begun
        rows[version] = {}
        print(f"{version}, {episodes} sessions, {took:.0f} s of processor time")
        print(f"{'decider':24}{'nats':>8}{'less state':>18}{'less policy':>18}")
        for name in found.names:
            less = [found.paired(name, other) for other in ("state", "policy")]
            rows[version][name] = {"nats": found.mean(name), "less": less}
            shares = "".join(shown(value, 18) for value in less)
            print(f"{name:24}{found.mean(name)[0]:8.3f}{shares}", flush=True)
    return rows


def other(policy: Any, episodes: int, seed: int) -> dict[str, Any]:
    """Nats on tasks that differ from KNEE."""
    rows = {}
    print(f"{'task':24}{'priced':>8}{'state':>8}{'policy':>8}"
          f"{'less state':>18}{'less state tuned here':>24}")  # fmt: skip
    for name, options in OTHER.items():
        task = arrays(knee(**options))
        tuned = STATE_RULE
        if options:
            tuned = tuned_on(task, seed)
        deciders = {"priced": PRICED, "state": STATE_RULE, "tuned": tuned}
        deciders = arrays(deciders | {"policy": policy})
        found = compare(task, deciders, episodes, seed, batch=512)
        rows[name] = {
            "options": options,
            "nats": {decider: found.mean(decider) for decider in found.names},
            "policy_less_state": found.paired("policy", "state"),
            "policy_less_tuned": found.paired("policy", "tuned"),
        }
        line = [f"{found.mean(d)[0]:8.3f}" for d in ("priced", "state", "policy")]
        line += [
            shown(found.paired("policy", d), w)
            for d, w in zip(("state", "tuned"), (18, 24), strict=True)
        ]
        print(f"{name:24}" + "".join(line), flush=True)
    return rows


def wrong(policy: Any, episodes: int, seed: int) -> dict[str, Any]:
    """Log ratio at the truth where the belief's constants are not the machine's."""
    rows = {}
    print(
        f"{'what is wrong':24}{'priced':>8}{'state':>8}{'policy':>8}{'less state':>18}"
    )
    for name, options in WRONG.items():
        task = Misled(arrays(knee()), arrays(knee(**options)))
        deciders = arrays({"priced": PRICED, "state": STATE_RULE, "policy": policy})
        found = compare(task, deciders, episodes, seed, batch=512)
        # What is quoted is the rise at the truth, so that is the gain here.
        found = dataclasses.replace(found, gain=found.log_ratio)
        rows[name] = {
            "options": options,
            "nats": {decider: found.mean(decider) for decider in found.names},
            "policy_less_state": found.paired("policy", "state"),
        }
        line = [f"{found.mean(d)[0]:8.3f}" for d in found.names]
        print(f"{name:24}" + "".join(line) + shown(found.paired("policy", "state"), 18),
              flush=True)  # fmt: skip
    return rows


def shown(value: tuple[float, float], width: int) -> str:
    return f"{value[0]:+.3f} ± {value[1]:.3f}".rjust(width)


def arrays(tree: Any) -> Any:
    """Numbers as arrays; a dict of deciders keeps its order."""
    if isinstance(tree, dict):
        return {name: arrays(leaf) for name, leaf in tree.items()}
    return jax.tree.map(jnp.asarray, tree)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--checkpoint", help="the one that ships when not given")
    parser.add_argument("--episodes", type=int, default=4096)
    parser.add_argument("--seed", type=int, default=0)
    parts = ("small", "table", "other", "wrong")
    parser.add_argument(
        "--parts", nargs="+", choices=(*parts, "rollouts"), default=list(parts)
    )
    parser.add_argument("--small", help="a policy trained on the small version")
    parser.add_argument("--json", type=pathlib.Path)
    options = parser.parse_args(argv)
    if options.json is not None:
        require_writable_folder(options.json.parent)
    processes.keep_compiled_programs()
    trained = training.load(options.checkpoint)
    document: dict[str, Any] = {
        "versions": versions(), "policy": trained.meta, "seed": options.seed,
        "episodes": options.episodes,
    }  # fmt: skip
    policies = {"policy": trained.decider}
    if options.small is not None:
        policies["trained"] = training.load(options.small).decider
    for part in options.parts:
        if part == "small":
            document[part] = small(policies, options.episodes, options.seed)
            continue
        if part == "table":
            document[part] = table(options.episodes, options.seed)
            continue
        play = {"other": other, "wrong": wrong, "rollouts": rollouts}[part]
        document[part] = play(trained.decider, options.episodes, options.seed)
    if options.json is not None:
        write_text(options.json, json.dumps(document, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
