"""``ahead`` and other deciders on twenty families of tasks.

    python -m benchmarks.sequential.families [--episodes 4096] [--seed 0]
        [--families 0 1 ...] [--methods NAME ...] [--keep DIR] [--json FILE]
    python -m benchmarks.sequential.families --optimum
    python -m benchmarks.sequential.families --tune

A family is a task drawn by ``benchmarks.sequential.family`` from a held-out structure:
the constants of ``shares`` and how ``ahead`` is fitted were found on other structures.
Every method plays the same sessions of it; on other sessions ``priced`` and ``state``
are tuned on it first, 20 generations each, and ``ahead`` is fitted. ``two_step`` and
``rollouts`` follow ``shares`` and play fewer, as ``deep`` does: ``ahead`` not fitted,
of trees a hundred times as large. Differences are in pairs with standard errors; times
are of one core, a choice in a batch. With --keep what was played lies in DIR and is
not played again.
--optimum plays small tasks of the same structures, their answers made certain and
their costs whole, of which dynamic programming finds the optimum; any numbers of
--families, by the first ten of which the trees of ``ahead`` were shaped. --tune finds
the constants of ``shares`` on 128 tasks of the structures that are not held out.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import pathlib
import sys
import time
from typing import Any

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # see jaxcal.commands

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.sequential.deciders import Rollouts, TwoStep
from benchmarks.sequential.family.draws import draw
from benchmarks.sequential.family.padded import batch
from benchmarks.sequential.family.structures import HELD_OUT, Limits
from benchmarks.sequential.optimum import solve
from benchmarks.sequential.transfer import arrays, shown
from jaxcal.adaptive.episodes import compare, play
from jaxcal.adaptive.evaluation import seconds_a_choice
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.lookahead import AHEAD, Ahead, fit
from jaxcal.adaptive.rules import (
    SHARES,
    Gain,
    GainRate,
    Priced,
    Random,
    Shares,
    StateRule,
)
from jaxcal.adaptive.session import jit_by_class
from jaxcal.adaptive.tuning import search, tune
from jaxcal.files import require_writable_folder, write_text
from jaxcal.learning.runtime import processes

METHODS = (
    "random", "gain", "rate", "shares", "ahead", "priced", "state", "two_step",
    "rollouts16", "rollouts64", "deep",
)  # fmt: skip
TUNED = ("priced", "state")
RULES = ("gain", "rate", *TUNED)
BUDGETS = ("time+uses", "time", "uses", "time+uses+number", "uses+number", "time+uses",
           "time+number")  # fmt: skip
STATES = (256, 512, 1024)
# Sessions at most.
FEWER = {"two_step": 256, "rollouts16": 64, "rollouts64": 32, "deep": 256}
BATCH = {"two_step": 64, "rollouts16": 16, "rollouts64": 16}
_FIRST = 10**7  # seed


def family(number: int) -> tuple[str, GridTask]:
    """One of the twenty, and what it is."""
    structure = list(HELD_OUT)[number % len(HELD_OUT)]
    budget = BUDGETS[number % len(BUDGETS)]
    limits = Limits(STATES[number % len(STATES)], 48, 4, measurements=32)
    task = draw(_FIRST + number, structure, budget, limits)
    return f"{structure}, {budget}", task


def certain(number: int) -> tuple[str, GridTask, float]:
    """A small task of certain outcomes and whole costs, and its tick in seconds."""
    # The beliefs of pools are too many.
    structures = [name for name in HELD_OUT if name != "pools"]
    structure = structures[number % len(structures)]
    budget = ("time+uses", "time")[number // len(structures) % 2]
    limits = Limits(36, 16, 2, 3, 64)
    task = jax.device_get(draw(_FIRST + 100 + number, structure, budget, limits))
    tick = float(task.seconds[1]) / 60.0
    yes = task.likelihood[:, 1] > 0.5
    names = ("prior", "place_after", "groups", "uses", "num_uses")
    fields: dict[str, Any] = {name: getattr(task, name) for name in names}
    fields["travel"] = np.maximum(np.rint(task.travel / tick), 1.0) * tick
    fields["extra"] = np.rint(task.extra / tick) * tick
    fields["seconds"] = tuple(task.seconds.tolist())
    table = np.stack([~yes, yes], axis=1)
    made = GridTask.make(task.theta, task.designs, table, horizon=64, **fields)
    return f"{structure}, {budget}", made, tick


def optimum(methods: list[str], options: argparse.Namespace) -> None:
    """Shares of the optimum on small tasks."""
    every = []
    print(f"{'task':24}{'optimum':>9}" + "".join(f"{m:>12}" for m in methods))
    for number in options.families:
        name, task, tick = certain(number)
        best = solve(task, tick)
        task = arrays(task)
        found: dict[str, Any] = {}
        deciders = {m: decider_of(m, task, options.seed, found) for m in methods}
        deciders = arrays({"optimum": best.decider} | deciders)
        result = compare(task, deciders, options.episodes, options.seed)
        every.append(
            [1.0 + result.paired(m, "optimum")[0] / best.mean for m in methods]
        )
        print(f"{name:24}{best.mean:9.3f}" + "".join(f"{s:12.4f}" for s in every[-1]),
              flush=True)  # fmt: skip
    means = np.mean(every, axis=0)
    print(f"{'mean':33}" + "".join(f"{share:12.4f}" for share in means))


@jit_by_class
def _nats_of_each(tasks: Any, rule: Any, keys: Any) -> Any:
    return jax.vmap(lambda task, keys: play(task, rule, keys).gain.mean())(tasks, keys)


def tuned_for_all(seed: int) -> Any:
    """``shares``, by nats of each task in units of the better of two rules."""
    tasks = arrays(batch(0))
    units: list[Any] = []

    def nats_of(rule: Any, number: int) -> float:
        key = jax.random.fold_in(jax.random.key(seed), number)
        keys = jax.random.split(key, 4 * len(tasks.prior)).reshape(-1, 4)
        if not units:
            both = [_nats_of_each(tasks, r, keys) for r in (Gain(), GainRate())]
            units.append(jnp.maximum(jnp.maximum(*both), 0.05))
        return float((_nats_of_each(tasks, arrays(rule), keys) / units[0]).mean())

    def report(number: int, nats: float, rule: Any) -> None:
        print(f"{number:3} {nats:.4f}", *np.round(dataclasses.astuple(rule), 3),
              flush=True)  # fmt: skip

    start = Shares(1.0, 1.0)
    return search(start, 10, 12, 4, seed, nats_of=nats_of, report=report)


def decider_of(method: str, task: GridTask, seed: int, found: dict[str, Any]) -> Any:
    """``found`` holds the tuned rules, and takes them."""
    if method in TUNED and method not in found:
        each = float(jnp.median(task.travel))
        starts = {
            "priced": Priced(0.1, 1.0 / each, 1.0),
            "state": StateRule(0.1, 1.0 / each, 1.0, scale=10.0 * each),
        }
        found[method] = tune(
            task, starts[method], episodes=256, population=16, elite=5, seed=seed + 1
        )
    return {
        "random": Random, "gain": Gain, "rate": GainRate, "shares": lambda: SHARES,
        "ahead": lambda: fit(task, seed=seed + 1),
        "deep": lambda: Ahead(effort=100.0 * AHEAD.effort),
        "priced": lambda: found["priced"], "state": lambda: found["state"],
        "two_step": lambda: TwoStep(SHARES),
        "rollouts16": lambda: Rollouts(SHARES, rollouts=16),
        "rollouts64": lambda: Rollouts(SHARES, rollouts=64),
    }[method]()  # fmt: skip


def played(
    number: int, methods: list[str], options: argparse.Namespace
) -> dict[str, Any]:
    """Nats of every session by method (B,), and milliseconds a choice."""
    name, task = family(number)
    task = arrays(task)
    found: dict[str, Any] = {}
    gains: dict[str, Any] = {}
    kept = None
    if options.keep is not None:
        kept = options.keep / f"{number:02d}-seed{options.seed}.npz"
        if kept.is_file():
            with np.load(kept) as file:
                gains = {key: file[key] for key in file.files}
    for rule, kind in (("priced", Priced), ("state", StateRule)):
        if f"rule_{rule}" in gains:
            found[rule] = kind(*gains[f"rule_{rule}"])
    for method in methods:
        least = min(options.episodes, FEWER.get(method, options.episodes))
        if len(gains.get(method, ())) < least:
            begun = time.process_time()
            decider = arrays(decider_of(method, task, options.seed, found))
            batch = BATCH.get(method, 256)
            result = compare(task, {method: decider}, least, options.seed, batch)
            gains[method] = result.gain[0]
            gains[f"ms_{method}"] = 1e3 * seconds_a_choice(task, decider, 0)
            took = time.process_time() - begun
            print(f"  {number} {method} {took:.0f} s", file=sys.stderr, flush=True)
            for rule in TUNED:
                if rule in found:
                    gains[f"rule_{rule}"] = np.array(
                        [float(x) for x in dataclasses.astuple(found[rule])]
                    )
            if kept is not None:
                np.savez(kept, **gains)
        gains[method] = gains[method][:least]
    return {
        "name": name, "shape": task.likelihood.shape,
        "ms": {m: float(gains[f"ms_{m}"]) for m in methods},
        "gains": {m: np.asarray(gains[m]) for m in methods},
    }  # fmt: skip


def paired(a: Any, b: Any) -> tuple[float, float]:
    n = min(len(a), len(b))
    less = a[:n] - b[:n]
    return float(less.mean()), float(less.std(ddof=1) / np.sqrt(n))


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=4096)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--families", type=int, nargs="+", default=list(range(20)))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--optimum", action="store_true")
    parser.add_argument("--tune", action="store_true")
    parser.add_argument("--keep", type=pathlib.Path)
    parser.add_argument("--json", type=pathlib.Path)
    options = parser.parse_args(argv)
    for folder in (options.keep, options.json and options.json.parent):
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            require_writable_folder(folder)
    processes.keep_compiled_programs()
    if options.tune:
        print(tuned_for_all(options.seed))
        return 0
    if options.optimum:
        optimum([m for m in options.methods if m not in FEWER], options)
        return 0
    rows = []
    print(f"{'family':34}" + "".join(f"{m:>11}" for m in options.methods)
          + f"{'ahead less best':>19}")  # fmt: skip
    for number in options.families:
        row = played(number, options.methods, options)
        gains = row.pop("gains")
        row["nats"] = {m: paired(g, 0.0 * g) for m, g in gains.items()}
        line = f"{row['name']:34}" + "".join(
            f"{row['nats'][m][0]:11.3f}" for m in options.methods
        )
        rivals = [m for m in RULES if m in gains] or options.methods
        best = max(rivals, key=lambda m: row["nats"][m][0])
        gains["best"], row["nats"]["best"] = gains[best], row["nats"][best]
        if "ahead" in gains:
            mine = gains.pop("ahead")
            row["less"] = {m: paired(mine, other) for m, other in gains.items()}
            line += shown(row["less"]["best"], 19)
        rows.append(row)
        print(line, flush=True)
    if "ahead" in options.methods:
        _summary(rows)
    if options.json is not None:
        document = {"episodes": options.episodes, "seed": options.seed, "rows": rows}
        write_text(options.json, json.dumps(document, indent=1) + "\n")
    return 0


def _summary(rows: list[dict[str, Any]]) -> None:
    """Means over the families, and in how many ahead is clearly above or below."""
    print(f"ahead less, mean of {len(rows)} families; best: of the four rules")
    for method in rows[0]["less"]:
        each = np.array([row["less"][method] for row in rows])
        error = np.sqrt((each[:, 1] ** 2).sum()) / len(each)
        above = (each[:, 0] > 2 * each[:, 1]).sum()
        below = (each[:, 0] < -2 * each[:, 1]).sum()
        mean = float(each[:, 0].mean())
        share = 100 * mean / np.mean([row["nats"][method][0] for row in rows])
        times = [row["ms"][method] for row in rows if method in row["ms"]]
        took = f", {np.mean(times):.3g} ms" if times else ""
        print(f"  {method:12}{shown((mean, error), 18)}  {share:+.1f} %, above in "
              f"{above}, below in {below}{took}")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
