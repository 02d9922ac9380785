"""Rules without tuning, and tuned rules, on twenty families of tasks.

    python benchmarks/families.py [--episodes 512] [--seed 0] [--families 0 1 ...]
        [--methods NAME ...] [--checkpoint DIR] [--keep DIR] [--json FILE]
    python benchmarks/families.py --tune

A family is a task drawn by ``jaxcal.adaptive.family`` from a held-out structure: the
constants of ``shares`` were found on other structures. Every method plays the same
sessions of it; ``priced`` and ``state`` are tuned on it first, 20 generations each, on
other sessions, and ``two_step`` and ``rollouts`` follow the tuned ``state``. Rollouts
play fewer sessions. ``policy`` is the one that was trained on KNEE, with the seconds of
a family scaled to those of KNEE: the medians of what measurements take are equal.
Differences are in pairs with standard errors. With --keep what was played lies in DIR
and is not played again. --tune finds the constants of ``shares`` on 128 tasks of the
structures that are not held out.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.adaptive_transfer import arrays, shown
from jaxcal.adaptive.episodes import compare, play
from jaxcal.adaptive.family.draws import draw
from jaxcal.adaptive.family.padded import batch
from jaxcal.adaptive.family.structures import HELD_OUT, Limits
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.lookahead import Rollouts, TwoStep
from jaxcal.adaptive.policy import run
from jaxcal.adaptive.rules import (
    SHARES,
    Gain,
    GainRate,
    Priced,
    Random,
    Shares,
    StateRule,
)
from jaxcal.adaptive.tasks.knee import knee
from jaxcal.adaptive.tuning import tune
from jaxcal.files import require_writable_folder, write_text
from jaxcal.learning.runtime import cache

METHODS = (
    "random", "gain", "rate", "shares", "priced", "state", "two_step", "rollouts16",
    "rollouts64", "policy",
)  # fmt: skip
TUNED = ("priced", "state")
BUDGETS = ("time+uses", "time", "uses", "time+uses+number", "uses+number", "time+uses",
           "time+number")  # fmt: skip
STATES = (256, 512, 1024)
FEWER = {"rollouts16": 128, "rollouts64": 64}  # sessions at most
BATCH = {"two_step": 64, "rollouts16": 16, "rollouts64": 16}
_FIRST = 10**7  # seed


def family(number: int) -> tuple[str, GridTask]:
    """One of the twenty, and what it is."""
    structure = list(HELD_OUT)[number % len(HELD_OUT)]
    budget = BUDGETS[number % len(BUDGETS)]
    limits = Limits(STATES[number % len(STATES)], 48, 4, measurements=32)
    task = draw(_FIRST + number, structure, budget, limits)
    return f"{structure}, {budget}", task


@jax.jit
def _nats_of_each(tasks: Any, rule: Any, keys: Any) -> Any:
    return jax.vmap(lambda task, keys: play(task, rule, keys).gain.mean())(tasks, keys)


def tuned_for_all(seed: int) -> Any:
    """``shares``, by nats of each task in units of the better of two rules."""
    tasks = arrays(batch(0))
    units: list[Any] = []

    def nats_of(tasks: Any, rule: Any, keys: Any) -> float:
        keys = keys.reshape(len(tasks.prior), -1)
        if not units:
            both = [_nats_of_each(tasks, r, keys) for r in (Gain(), GainRate())]
            units.append(jnp.maximum(jnp.maximum(*both), 0.05))
        return float((_nats_of_each(tasks, arrays(rule), keys) / units[0]).mean())

    def report(number: int, nats: float, rule: Any) -> None:
        print(f"{number:3} {nats:.4f}", *np.round(dataclasses.astuple(rule), 3),
              flush=True)  # fmt: skip

    return tune(
        tasks, Shares(1.0, 1.0), episodes=4 * len(tasks.prior), generations=10,
        population=12, elite=4, seed=seed, nats_of=nats_of, report=report,
    )  # fmt: skip


def in_seconds_of_knee(task: GridTask) -> GridTask:
    """The same task in another unit of time, which the trained policy counts in."""
    factor = jnp.median(knee().travel) / jnp.maximum(jnp.median(task.travel), 1e-9)
    return dataclasses.replace(
        task, travel=task.travel * factor, extra=task.extra * factor,
        seconds=task.seconds * factor,
    )  # fmt: skip


def decider_of(method: str, task: GridTask, seed: int, found: dict[str, Any]) -> Any:
    """``found`` holds the tuned rules, and takes them."""
    if method in TUNED and method not in found:
        each = float(jnp.median(task.travel))
        starts = {
            "priced": Priced(0.1, 1.0 / each, 1.0),
            "state": StateRule(0.1, 1.0 / each, 1.0, scale=10.0 * each),
        }
        found[method] = tune(
            task, starts[method], episodes=256, generations=20, seed=seed + 1
        )
    if method in ("two_step", "rollouts16", "rollouts64") and "state" not in found:
        decider_of("state", task, seed, found)
    return {
        "random": Random, "gain": Gain, "rate": GainRate, "shares": lambda: SHARES,
        "priced": lambda: found["priced"], "state": lambda: found["state"],
        "two_step": lambda: TwoStep(found["state"]),
        "rollouts16": lambda: Rollouts(found["state"], rollouts=16),
        "rollouts64": lambda: Rollouts(found["state"], rollouts=64),
        "policy": lambda: found["policy"],
    }[method]()  # fmt: skip


def played(
    number: int, methods: list[str], policy: Any, options: argparse.Namespace
) -> dict[str, Any]:
    """Nats of every session by method (B,), what is far, and constants."""
    name, task = family(number)
    task = arrays(task)
    found: dict[str, Any] = {"policy": policy}
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
            where = in_seconds_of_knee(task) if method == "policy" else task
            result = compare(where, {method: decider}, least, options.seed, batch)
            gains[method] = result.gain[0]
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
    parser.add_argument("--episodes", type=int, default=512)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--families", type=int, nargs="+", default=list(range(20)))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--tune", action="store_true")
    parser.add_argument("--checkpoint", help="the one that ships when not given")
    parser.add_argument("--keep", type=pathlib.Path)
    parser.add_argument("--json", type=pathlib.Path)
    options = parser.parse_args(argv)
    for folder in (options.keep, options.json and options.json.parent):
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            require_writable_folder(folder)
    cache.keep_compiled_programs()
    if options.tune:
        print(tuned_for_all(options.seed))
        return 0
    policy = None
    if "policy" in options.methods:
        policy = run.load(options.checkpoint).decider
    rows = []
    others = [m for m in options.methods if m != "shares"]
    print(f"{'family':40}" + "".join(f"{m:>11}" for m in options.methods)
          + f"{'shares less the best tuned':>28}")  # fmt: skip
    for number in options.families:
        row = played(number, options.methods, policy, options)
        gains = row.pop("gains")
        row["nats"] = {m: paired(g, 0.0 * g) for m, g in gains.items()}
        line = f"{row['name']:40}" + "".join(
            f"{row['nats'][m][0]:11.3f}" for m in options.methods
        )
        rivals = [m for m in TUNED if m in gains]
        if "shares" in gains:
            row["shares_less"] = {m: paired(gains["shares"], gains[m]) for m in others}
            if rivals:
                row["best"] = max(rivals, key=lambda m: row["nats"][m][0])
                line += shown(row["shares_less"][row["best"]], 28)
        rows.append(row)
        print(line, flush=True)
    if "shares" in options.methods:
        _summary(rows, others)
    if options.json is not None:
        document = {"episodes": options.episodes, "seed": options.seed, "rows": rows}
        write_text(options.json, json.dumps(document, indent=1) + "\n")
    return 0


def _summary(rows: list[dict[str, Any]], others: list[str]) -> None:
    """Means over the families, and in how many shares is clearly above or below."""
    if all("best" in row for row in rows):
        others = [*others, "best"]
        for row in rows:
            row["shares_less"]["best"] = row["shares_less"][row["best"]]
            row["nats"]["best"] = row["nats"][row["best"]]
    print(f"shares less, mean of {len(rows)} families:")
    for method in others:
        each = np.array([row["shares_less"][method] for row in rows])
        error = np.sqrt((each[:, 1] ** 2).sum()) / len(each)
        above = (each[:, 0] > 2 * each[:, 1]).sum()
        below = (each[:, 0] < -2 * each[:, 1]).sum()
        mean = float(each[:, 0].mean())
        share = 100 * mean / np.mean([row["nats"][method][0] for row in rows])
        print(f"  {method:12}{shown((mean, error), 18)}  {share:+.1f} %, above in "
              f"{above}, below in {below}")  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
