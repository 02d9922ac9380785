"""What each part of the policy is worth, against the proven optimum.

    python benchmarks/policy_ablation.py [--episodes 1000] [--train 60000]
        [--train-k 4] [--parts unlearned shipped tasks time trained] [--json FILE]

Five parts:

unlearned  no network: at every step the candidate whose look-ahead feature is largest,
           after 1 choice (gain), 2 (best pair), 3 (greedy triple) or to the end.
shipped    the shipped policy on the same sets: one pass, and the best of 8 and of 16
           likeliest first picks.
tasks      the shipped policy on other sizes, shapes, masks, numbers of inputs and
           partial selections, beside greedy, Fedorov exchange from 16 random starts
           and the look-ahead to the end on the same sets; processor milliseconds a set
           of policy and exchange, in batches, compiled code warm.
time       milliseconds of a whole jaxcal.select call for one set, compiled code warm.
trained    short trainings from scratch at an equal budget: the ways to train, and one
           feature left out or one size changed at a time (--train 0 skips them).

ratio is the mean of det S / det S*, a hit a selection whose log det(Z.T Z) is within
1e-9 of the optimum's. The share behind counts the sets where the trained policy is
worse than the look-ahead to the end, the share ahead those where it is better.
"""

from __future__ import annotations

import argparse
import json
import pathlib
import sys
import tempfile
import time
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcal.commands.train_configuration import teacher
from jaxcal.extras import versions
from jaxcal.files import require_writable_folder, write_text
from jaxcal.information.regression import log_det_information
from jaxcal.learning.config import NetworkConfig
from jaxcal.learning.environments import selection
from jaxcal.learning.environments.selection import SelectionConfig
from jaxcal.learning.policies import scorer
from jaxcal.learning.policies.compact import CompactNetwork
from jaxcal.learning.policies.features import CandidateFeatures, DecisionFeatures
from jaxcal.learning.runtime import processes
from jaxcal.learning.training import postures as training
from jaxcal.learning.training import presets
from jaxcal.selection import exact_batch, exchange_batch, greedy_batch, select
from jaxcal.selection.policy import select_batch

HIT = 1e-9
PARTS = ("unlearned", "shipped", "tasks", "time", "trained")
AHEAD = ("gain", "best pair", "greedy triple", "greedy to the end")  # the look-ahead's
CHUNK = 250  # sets a compiled call of a rule without learning
CELLS = 2_000_000  # pairs of candidates scored at once
STARTS = 16  # of exchange
FEW = 200  # sets, at most, where M is 200 or more


class Unlearned(CompactNetwork):
    """The compact network's view of a set, and the argmax of one feature of it."""

    column: int = 3

    @property
    def num_unlearned(self) -> int:
        """Every choice."""
        return sys.maxsize

    def setup(self) -> None:
        """No parameters."""

    def encode(self, features: CandidateFeatures) -> jax.Array:
        return features.vectors.columns[..., :1]

    def lookahead_logits(
        self, decision: DecisionFeatures
    ) -> tuple[jax.Array, jax.Array]:
        score = decision.vectors.ahead[..., self.column]
        return jnp.where(decision.vectors.active, score, -1e9), score.max(-1)


def unlearned(
    sets: np.ndarray,
    k: int,
    column: int = 3,
    available: np.ndarray | None = None,
    required: np.ndarray | None = None,
    num: int = 1,
) -> np.ndarray:
    """(B, k) indices without learning; the best of ``num`` first picks."""
    batch, m, _ = sets.shape
    network = Unlearned(NetworkConfig(), column=column)
    free = np.ones((batch, m), bool) if available is None else available
    kept = np.zeros((batch, 0), np.int32) if required is None else required
    size = max(1, min(CHUNK, CELLS // (m * m * num)))
    out = []
    for begin in range(0, batch, size):
        rows = np.arange(begin, begin + size).clip(max=batch - 1)
        picked = scorer.choose(
            network,
            {},
            sets[rows].astype(np.float32),
            free[rows],
            kept[rows],
            k=k,
            decoding="first" if num > 1 else "greedy",
            num=num,
        )
        out.append(picked[: batch - begin])
    return np.concatenate(out)


@dataclass(frozen=True)
class Sets:
    """Candidate sets, what may be chosen from them, and the proven optimum."""

    candidates: np.ndarray  # (B, M, n)
    k: int
    available: np.ndarray | None  # (B, M) bool
    required: np.ndarray | None  # (B, r) int
    best: np.ndarray  # (B,) log det(Z.T Z)

    @staticmethod
    def make(
        candidates: np.ndarray,
        k: int,
        available: np.ndarray | None = None,
        required: np.ndarray | None = None,
    ) -> Sets:
        found = exact_batch(
            candidates, k, available=available, required=required, num_outputs=1
        )
        if not found.proven.all():
            raise RuntimeError("exact_batch left an optimum unproven")
        return Sets(candidates, k, available, required, found.log_det)

    def gap(self, indices: np.ndarray) -> np.ndarray:
        """(B,) log det(Z.T Z) behind the optimum, never negative."""
        chosen = np.take_along_axis(self.candidates, indices[..., None], axis=1)
        behind = self.best - np.asarray(log_det_information(chosen, 1))
        if behind.min() < -HIT:
            raise RuntimeError(f"a proven optimum was beaten by {-behind.min():g}")
        return behind.clip(min=0.0)

    def scores(self, indices: np.ndarray) -> dict[str, float]:
        return self.scores_of(self.gap(indices))

    def scores_of(self, gap: np.ndarray) -> dict[str, float]:
        num_outputs = self.candidates.shape[-1]
        return {
            "ratio_to_exact": float(np.exp(-num_outputs * gap).mean()),
            "hit_rate": float((gap <= HIT).mean()),
        }


def uniform_sets(num: int, m: int, k: int, n: int, seed: int) -> np.ndarray:
    return np.random.default_rng([seed, m, k, n]).random((num, m, n))


def shaped_sets(num: int, name: str, seed: int) -> np.ndarray:
    """(num, 50, 3) candidates of one shape of ``selection.mixture``."""
    draw = selection.mixture(SelectionConfig(), (name,))
    keys = jax.random.split(jax.random.key(seed), num)
    return np.asarray(jax.jit(jax.vmap(draw))(keys)[0], np.float64)


def compared(name: str, sets: Sets, checkpoint: str | None) -> dict[str, Any]:
    """One task: the policy, the look-ahead alone and greedy on the same sets."""
    given: dict[str, Any] = {"available": sets.available, "required": sets.required}
    few: dict[str, Any] = {
        key: None if part is None else part[:512] for key, part in given.items()
    }
    k, candidates = sets.k, sets.candidates
    select_batch(candidates[:512], k, checkpoint=checkpoint, **few)
    begun = time.process_time()
    picked = select_batch(candidates, k, checkpoint=checkpoint, **given)
    between = time.process_time()
    exchanged = exchange_batch(candidates, k, restarts=STARTS, **given).indices
    seconds = between - begun, time.process_time() - between
    ahead = unlearned(candidates, k, **given)
    gap_policy, gap_ahead = sets.gap(picked), sets.gap(ahead)
    change = gap_ahead - gap_policy
    return {
        "task": name,
        "sets": len(candidates),
        "policy": sets.scores_of(gap_policy),
        "look_ahead": sets.scores_of(gap_ahead),
        "exchange": sets.scores(exchanged),
        "greedy": sets.scores(greedy_batch(candidates, k, **given).indices),
        "policy_ahead": float((change > HIT).mean()),
        "policy_behind": float((change < -HIT).mean()),
        "ms_policy": 1e3 * seconds[0] / len(candidates),
        "ms_exchange": 1e3 * seconds[1] / len(candidates),
    }


def all_tasks(num: int, seed: int) -> list[tuple[str, Sets]]:
    """Names and sets of the task table; made one after the other, lazily used."""
    out = []
    for m in (20, 50, 100, 200, 500):
        few = min(num, FEW) if m >= 200 else num
        sets = uniform_sets(few, m, 4, 3, seed)
        out.append((f"M = {m}, K = 4", Sets.make(sets, 4)))
    for k in (5, 6, 8, 12):
        sets = uniform_sets(num, 50, k, 3, seed)
        out.append((f"M = 50, K = {k}", Sets.make(sets, k)))
    for name in selection.SHAPES[1:]:
        out.append((f"{name}, K = 4", Sets.make(shaped_sets(num, name, seed), 4)))
    rng = np.random.default_rng([seed, 30])
    rank = rng.permuted(np.tile(np.arange(50), (num, 1)), axis=1)
    for k in (4, 6):
        sets = uniform_sets(num, 50, k, 3, seed + 1)
        masked = Sets.make(sets, k, available=rank < 35)
        out.append((f"30 % masked, K = {k}", masked))
    for n in (2, 4, 5):
        sets = uniform_sets(num, 50, n + 1, n, seed)
        out.append((f"{n} inputs, K = {n + 1}", Sets.make(sets, n + 1)))
    for k, given in ((4, 1), (4, 2), (6, 2), (8, 3)):
        sets = uniform_sets(num, 50, k, 3, seed + 2)
        part = Sets.make(sets, k, required=rank[:, :given].astype(np.int64))
        out.append((f"K = {k}, {given} given", part))
    return out


FROM_RULE = {
    "close_up": True,
    "initial_trust": 4.0,
    "initial_actor": 0.05,
    "entropy_start": 0.002,
}
TRAININGS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("full (width 32, look-ahead to the end)", {}),
    ("imitation, then PPO, from nothing", {"imitation": 0.5}),
    ("PPO alone, from the look-ahead", FROM_RULE),
    ("imitation alone, from the look-ahead", FROM_RULE | {"imitation": 1.0}),
    ("imitation, then PPO, from the look-ahead", FROM_RULE | {"imitation": 0.5}),
    (
        "the same, no close-up",
        FROM_RULE | {"imitation": 0.5, "close_up": False},
    ),
    ("look-ahead 3", {"lookahead": 3}),
    ("look-ahead 2", {"lookahead": 2}),
    ("look-ahead 1", {"lookahead": 1}),
    ("width 16", {"width": 16}),
    ("width 48", {"width": 48}),
)


def trained(
    name: str, changes: dict[str, Any], sets: Sets, num: int, seed: int
) -> dict[str, Any]:
    """Train one variant from scratch and measure its one greedy pass."""
    values = {
        "close_up": False,
        **changes,
        "num_selected": sets.k,
        "reward_gain": sets.k > 4,
        "num_episodes": num,
        "seed": seed,
    }
    config = presets.with_values(presets.load("compact"), values)
    with tempfile.TemporaryDirectory() as folder:
        run = pathlib.Path(folder) / "run"
        begun = time.perf_counter()
        state = training.train(config, run, teacher=teacher)
        seconds = time.perf_counter() - begun
        picked = select_batch(sets.candidates, sets.k, checkpoint=run)
    leaves = jax.tree.leaves(state.params)
    return {
        "variant": name,
        "changes": changes,
        "parameters": int(sum(leaf.size for leaf in leaves)),
        "episodes": config.ppo.num_updates * config.ppo.episodes_per_update,
        "seconds": seconds,
        "trust": float(state.average["trust"]),
    } | sets.scores(picked)


def parser() -> argparse.ArgumentParser:
    out = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    out.add_argument("--episodes", type=int, default=1000, help="candidate sets a row")
    out.add_argument("--seed", type=int, default=7, help="of sets and trainings")
    out.add_argument("--k", type=int, nargs="+", default=[4, 5, 6, 8, 12])
    out.add_argument("--train", type=int, default=60_000, help="episodes a training")
    out.add_argument("--train-k", type=int, default=4, help="postures in trainings")
    out.add_argument("--variants", nargs="+", help="names of trainings; default: all")
    out.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    out.add_argument("--checkpoint", help="instead of the shipped policy")
    out.add_argument("--json", metavar="FILE", help="write every number there too")
    return out


def show(label: str, scores: dict[str, Any]) -> None:
    print(
        f"{label:44} {scores['ratio_to_exact']:8.4f} {scores['hit_rate']:8.1%}",
        flush=True,
    )


def same_sets(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Rules without learning and the shipped policy, on the same sets."""
    rows: list[dict[str, Any]] = []
    print(f"\nM = 50, uniform, {arguments.episodes} sets{'ratio':>22}     hits")
    for k in arguments.k:
        sets = Sets.make(uniform_sets(arguments.episodes, 50, k, 3, arguments.seed), k)

        def add(how: str, indices: np.ndarray, sets: Sets = sets, k: int = k) -> None:
            rows.append({"k": k, "how": how} | sets.scores(indices))
            show(f"K = {k:2d}  {how}", rows[-1])

        if "unlearned" in arguments.parts:
            for column, name in enumerate(AHEAD):
                add(f"argmax of {name}", unlearned(sets.candidates, k, column))
            add("end, best of 8 first picks", unlearned(sets.candidates, k, num=8))
        if "shipped" in arguments.parts:
            for how, num in (("greedy", 1), ("first", 8), ("first", 16)):
                picked = select_batch(
                    sets.candidates,
                    k,
                    decoding=how,
                    num=num,
                    checkpoint=arguments.checkpoint,
                )
                one = "policy, one pass"
                add(one if num == 1 else f"policy, best of {num} first picks", picked)
    return rows


def task_table(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """The shipped policy on other tasks."""
    print(
        "\ntask                     sets     policy         look-ahead"
        "      exchange             greedy        ahead  behind  ms: policy, exchange"
    )
    rows = []
    for name, sets in all_tasks(arguments.episodes, arguments.seed):
        row = compared(name, sets, arguments.checkpoint)
        rows.append(row)
        pairs = [
            f"{row[key]['ratio_to_exact']:.4f} {row[key]['hit_rate']:6.1%}"
            for key in ("policy", "look_ahead", "exchange", "greedy")
        ]
        print(
            f"{name:24} {row['sets']:4d} {'   '.join(pairs)} {row['policy_ahead']:7.1%}"
            f" {row['policy_behind']:7.1%} {row['ms_policy']:8.2f}"
            f" {row['ms_exchange']:8.2f}",
            flush=True,
        )
    ratios = [row["policy"]["ratio_to_exact"] for row in rows]
    good = sum(ratio >= 0.997 for ratio in ratios)
    print(f"policy: least {min(ratios):.4f}; {good} of {len(rows)} at least 0.997")
    level = sum(
        row["exchange"]["ratio_to_exact"] >= r
        for row, r in zip(rows, ratios, strict=True)
    )
    cheaper = sum(row["ms_exchange"] < row["ms_policy"] for row in rows)
    print(f"exchange as good or better in {level}, cheaper in {cheaper} of {len(rows)}")
    return rows


def time_table(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """One set at a time through the library's front door."""
    print("\nselect(method='policy'), one set   median ms   max ms")
    rows = []
    sizes = [(m, 4) for m in (20, 50, 100, 200, 500)] + [(50, k) for k in (6, 8, 12)]
    for m, k in sizes:
        sets = uniform_sets(31, m, k, 3, arguments.seed)
        times = []
        for candidates in sets:
            begun = time.perf_counter()
            select(candidates, k, "policy", checkpoint=arguments.checkpoint)
            times.append(1e3 * (time.perf_counter() - begun))
        warm = times[1:]  # the first compiles
        row = {"m": m, "k": k, "median_ms": float(np.median(warm)), "max_ms": max(warm)}
        rows.append(row)
        name = f"M = {m}, K = {k}"
        print(f"{name:33} {row['median_ms']:10.2f} {row['max_ms']:8.2f}", flush=True)
    return rows


def training_table(arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Short trainings at an equal budget."""
    k = arguments.train_k
    sets = Sets.make(uniform_sets(arguments.episodes, 50, k, 3, arguments.seed), k)
    print(
        f"\ntrained from scratch, K = {k}, seed {arguments.seed}"
        f"{'ratio':>22}     hits   parameters  seconds   trust"
    )
    rows = []
    for name, changes in TRAININGS:
        if arguments.variants and name not in arguments.variants:
            continue
        row = trained(name, changes, sets, arguments.train, arguments.seed)
        rows.append({"k": k} | row)
        print(
            f"{name:44} {row['ratio_to_exact']:8.4f} {row['hit_rate']:8.1%}"
            f" {row['parameters']:12,d} {row['seconds']:8.0f} {row['trust']:7.2f}",
            flush=True,
        )
    return rows


def main(argv: list[str] | None = None) -> int:
    arguments = parser().parse_args(argv)
    names = [name for name, _ in TRAININGS]
    unknown = [name for name in arguments.variants or [] if name not in names]
    if unknown:
        print(f"--variants must be of {names}, got {unknown[0]!r}", file=sys.stderr)
        return 2
    if arguments.json:
        require_writable_folder(pathlib.Path(arguments.json).resolve().parent)
    processes.keep_compiled_programs()
    result: dict[str, Any] = {
        "arguments": vars(arguments),
        "versions": versions(),
        "device": jax.devices()[0].device_kind,
    }
    if {"unlearned", "shipped"} & set(arguments.parts):
        result["same_sets"] = same_sets(arguments)
    if "tasks" in arguments.parts:
        result["tasks"] = task_table(arguments)
    if "time" in arguments.parts:
        result["time"] = time_table(arguments)
    if "trained" in arguments.parts and arguments.train > 0:
        result["trained"] = training_table(arguments)
    if arguments.json:
        write_text(arguments.json, json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
