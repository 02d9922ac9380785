"""Training runs kept for the report.

A run folder is large and not in version control. What a report needs of it is small and
goes to a folder of its own: ``metrics.csv`` (the trainer's columns, at most
``MAX_ROWS`` rows), ``last_rewards.npy`` (rewards of the last 1,000 episodes),
``summary.json`` (preset, configuration, versions, episodes, wall time, and how good the
policy is) and ``policy.npz`` (the weights; of over ``HALVED`` in half precision).
"""

from __future__ import annotations

import dataclasses
import json
import pathlib
import shutil
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.csv_text import csv_text
from jaxcal.arguments import Parser, exit_code, values_of
from jaxcal.files import require_writable_folder, write_text
from jaxcal.learning.runtime import weights

Array = NDArray[np.float64]

MAX_ROWS = 1_000
HALVED = 1_000_000  # weights
_LAST_OF_BLOCK = ("update", "episodes", "seconds", "learning_rate")
_IF_MEASURED = ("ratio_to_exact", "hit_rate")

_DESCRIPTION = """\
Keep what the reproduction report draws of training runs, finished or still going:
metrics.csv, last_rewards.npy, summary.json and the weights, in a folder under --out
for each.

  python train.py --seed 3 --episodes 200000 --with close_up=false \\
      --out runs/compact_seeds/seed_3
  python -m benchmarks.paper.training_runs runs/compact_seeds/* \\
      --out benchmarks/paper/kept/compact_seeds
"""


def collect(run: pathlib.Path, out: pathlib.Path) -> dict[str, Any]:
    """Keep in ``out`` what a report needs of a run, finished or not; its summary.

    Raises:
        OSError: the run holds no metrics.csv, or ``out`` cannot be written.
        ValueError: a file of the run cannot be understood.
    """
    from jaxcal.evaluation.figures import read_metrics
    from jaxcal.learning.training import checkpoint

    metrics = read_metrics(run / "metrics.csv")
    policy = checkpoint.load(run)
    summary = _summary(run, policy)
    out.mkdir(parents=True, exist_ok=True)
    held = policy.weights
    if summary["parameters"] > HALVED:
        half = {name: array.astype(np.float16) for name, array in held.arrays.items()}
        held = dataclasses.replace(held, arrays=half)
    weights.write(out / "policy.npz", held)
    rewards = run / "last_rewards.npy"
    if rewards.is_file():
        shutil.copyfile(rewards, out / "last_rewards.npy")
    write_text(out / "metrics.csv", csv_text(thinned(metrics), digits=7))
    write_text(out / "summary.json", json.dumps(summary, indent=1) + "\n")
    return summary


def thinned(metrics: dict[str, Array], max_rows: int = MAX_ROWS) -> dict[str, Array]:
    """Metrics in at most ``max_rows`` rows, each the mean of a block of updates.

    ``reward_std`` stays that of single episodes: within and between the updates of a
    block. Counts and times are those at the end of the block; what is measured
    occasionally is the block's last value.
    """
    count = len(metrics["episodes"])
    if count <= max_rows:
        return metrics

    def row(name: str, values: Array, block: NDArray[np.int64]) -> float:
        own = values[block]
        if name in _LAST_OF_BLOCK:
            return own[-1]
        if name in _IF_MEASURED:
            known = own[np.isfinite(own)]
            return known[-1] if known.size else np.nan
        if name == "reward_std":
            return np.sqrt((own**2).mean() + metrics["reward_mean"][block].var())
        return own.mean()

    blocks = np.array_split(np.arange(count), max_rows)
    return {
        name: np.array([row(name, values, block) for block in blocks])
        for name, values in metrics.items()
    }


def _summary(run: pathlib.Path, policy: Any) -> dict[str, Any]:
    """What the run was and how good its policy is, measured on dataset2."""
    from jaxcal.evaluation.methods import evaluate
    from jaxcal.paper.datasets import make_dataset

    data = make_dataset("dataset2")
    measured = evaluate(data, 4, ("policy",), (str(run),), random_draws=1)
    row = measured.summary(measured.results[0])
    progress = policy.meta["progress"]
    return {
        **{name: policy.meta[name] for name in ("preset", "seed", "versions")},
        "configuration": {name: policy.meta[name] for name in ("ppo", "network")},
        "parameters": sum(a.size for a in policy.weights.arrays.values()),
        "episodes": progress["episodes"],
        "planned_episodes": policy.meta["ppo"]["num_episodes"],
        "seconds": float(progress["seconds"]),
        "device": progress["device"],
        "dataset2": {
            "episodes": data.num_episodes,
            "ratio_to_exact": row["ratio_to_exact"],
            "hit_rate": row["hit_rate"],
        },
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Keep the runs; the exit code."""
    name = "python -m benchmarks.paper.training_runs"
    given = Parser(prog=name, description=_DESCRIPTION).of(_keep).parse_args(arguments)
    kept = "runs already named are kept"
    return exit_code(lambda: _keep(**values_of(given)), "training_runs", kept)


def _keep(
    runs: Annotated[tuple[pathlib.Path, ...], "folders of training runs", "DIR"],
    *,
    out: Annotated[pathlib.Path, "of the kept folders", "DIR"],
) -> None:
    if not runs:
        raise ValueError("DIR must name at least one folder of a training run")
    for run in runs:
        if not (run / "metrics.csv").is_file():
            raise ValueError(f"{run} holds no metrics.csv")
    require_writable_folder(out)
    for run in runs:
        folder = out / run.resolve().name
        summary = collect(run, folder)
        print(f"saved: {folder}, {summary['episodes']:,} episodes", flush=True)


if __name__ == "__main__":
    sys.exit(main())
