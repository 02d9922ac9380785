"""Training runs kept for the report: one preset over several seeds, or an existing run.

A run folder is large and not in version control. What a report needs of it is small and
goes to a folder of its own: ``metrics.csv`` (the trainer's columns, at most
``MAX_ROWS`` rows), ``last_rewards.npy`` (rewards of the last 1,000 episodes) and
``summary.json`` (configuration, episodes, wall time, and how good the policy is).
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib
import shutil
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.arguments import Parser
from jaxcal.evaluation.csv_rows import csv_text
from jaxcal.files import require_writable_folder, write_text
from jaxcal.paper import command

__all__ = ["FORMAT", "MAX_ROWS", "collect", "main", "thinned", "train_seed"]

Array = NDArray[np.float64]

FORMAT = "jaxcal-training-run"
MAX_ROWS = 1_000
_VALIDATE_EVERY_S = 5.0  # a curve of a few minutes has some dozens of points
_LAST_OF_BLOCK = ("update", "episodes", "seconds", "learning_rate")
_IF_MEASURED = ("ratio_to_exact", "hit_rate")

_DESCRIPTION = """\
Train one preset with several seeds, or collect an existing run, and keep what the
reproduction report draws of it: metrics.csv, last_rewards.npy and summary.json, in one
folder per run under --out.
"""
_EPILOG = """\
examples:
  python -m studies.paper.training_runs --preset compact --seeds 5 \\
      --out studies/paper/kept/compact_seeds
      trains seeds 0 to 4, a few minutes each, into seed_0 ... of that folder
  python -m studies.paper.training_runs --collect runs/paper \\
      --out studies/paper/kept/paper
      keeps a run of train.py, finished or still going

The same command again continues where it was stopped: finished seeds are skipped, an
interrupted seed resumes from its last checkpoint, which is under --runs.
"""


def train_seed(
    config: Any, folder: pathlib.Path, *, validate: bool = True, report: Any = None
) -> None:
    """Train one run, or the rest of it where ``folder`` holds a part.

    Args:
        config: a ``TrainConfig``.
        folder: of the run.
        validate: measure it on fixed sets while it trains.
        report: called with a ``training.Report`` every few seconds.

    Raises:
        ValueError: the folder holds a run of another configuration.
    """
    from jaxcal.learning.training import checkpoint
    from jaxcal.learning.training import postures as training
    from jaxcal.learning.training.config import TrainConfig
    from jaxcal.selection.teacher import fixed_validation

    require_writable_folder(folder)
    resume = any(path.name.isdigit() for path in folder.glob("checkpoint/*"))
    if resume:
        held = TrainConfig.from_meta(checkpoint.load(folder).meta)
        if held.as_meta() != config.as_meta():
            raise ValueError(
                f"{folder} holds a run of another configuration: name another --runs"
            )
    validation = fixed_validation(config) if validate else None
    report = report or (lambda _: None)
    training.train(config, folder, resume=resume, validation=validation, report=report)


def collect(run: pathlib.Path, out: pathlib.Path) -> dict[str, Any]:
    """Keep in ``out`` what a report needs of a run, finished or not; its summary.

    Raises:
        OSError: the run holds no metrics.csv, or ``out`` cannot be written.
        ValueError: a file of the run cannot be understood.
    """
    from jaxcal.evaluation.training_figure import read_metrics

    metrics = read_metrics(run / "metrics.csv")
    summary = _summary(run, len(metrics["episodes"]))
    out.mkdir(parents=True, exist_ok=True)
    rewards = run / "last_rewards.npy"
    if rewards.is_file():
        shutil.copyfile(rewards, out / "last_rewards.npy")
    write_text(out / "metrics.csv", csv_text(thinned(metrics), digits=7))
    write_text(out / "summary.json", json.dumps(summary, indent=1) + "\n")
    return summary


def thinned(metrics: dict[str, Array], most: int = MAX_ROWS) -> dict[str, Array]:
    """The same run in at most ``most`` rows, each the mean of a block of updates.

    ``reward_std`` stays that of single episodes: within and between the updates of a
    block. Counts and times are those at the end of the block; what is measured
    occasionally is the block's last value.
    """
    count = len(metrics["episodes"])
    if count <= most:
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

    blocks = np.array_split(np.arange(count), most)
    return {
        name: np.array([row(name, values, block) for block in blocks])
        for name, values in metrics.items()
    }


def _summary(run: pathlib.Path, rows: int) -> dict[str, Any]:
    """What the run was and how good its policy is, measured on dataset2."""
    import jax

    from jaxcal.evaluation.methods import evaluate
    from jaxcal.learning.training import checkpoint
    from jaxcal.paper.datasets import make_dataset

    policy = checkpoint.load(run)
    data = make_dataset("dataset2")
    measured = evaluate(data, 4, ("policy",), (str(run),), random_draws=1)
    row = measured.summary(measured.results[0])
    meta, progress = policy.meta, policy.meta["progress"]
    planned = meta["ppo"]["num_episodes"]
    return {
        "format": FORMAT,
        "version": 1,
        "preset": meta["preset"],
        "network": meta["network"]["kind"],
        "parameters": sum(leaf.size for leaf in jax.tree.leaves(policy.params)),
        "seed": meta["seed"],
        "episodes": progress["episodes"],
        "planned_episodes": planned,
        "episodes_per_update": meta["ppo"]["episodes_per_update"],
        "finished": progress["episodes"] >= planned,
        "seconds": float(progress["seconds"]),
        "device": progress["device"],
        "versions": meta["versions"],
        "rows": [rows, min(rows, MAX_ROWS)],
        "dataset2": {
            "episodes": data.num_episodes,
            "ratio_to_exact": row["ratio_to_exact"],
            "hit_rate": row["hit_rate"],
            "log_det_s_mean": row["log_det_s"]["mean"],
        },
    }


# -- command ---------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> int:
    """Train or collect; the exit code."""
    options = _parse(arguments)

    def keep() -> None:
        if options.collect is None:
            _train_all(options)
            return
        if not (options.collect / "metrics.csv").is_file():
            raise ValueError(f"--collect {options.collect} holds no metrics.csv")
        require_writable_folder(options.out)
        _collect(options.collect, options.out)

    return command.run(keep, "training_runs", "the same command continues from here")


def _train_all(options: argparse.Namespace) -> None:
    from jaxcal.learning.runtime import cache
    from jaxcal.learning.training import presets

    cache.keep_compiled_programs()
    runs = options.runs or pathlib.Path("runs") / options.out.resolve().name
    for folder in (options.out, runs):
        require_writable_folder(folder)
    for number, seed in enumerate(options.seeds, start=1):
        values = {"seed": seed}
        if options.episodes is not None:
            values["num_episodes"] = options.episodes
        config = presets.with_values(presets.load(options.preset), values)
        config = dataclasses.replace(config, validate_every=_VALIDATE_EVERY_S)
        run, target = (folder / f"seed_{seed}" for folder in (runs, options.out))
        if _is_finished(target / "summary.json", config):
            print(f"{target}: already finished", flush=True)
            continue
        name = f"seed {seed} ({number} of {len(options.seeds)})"

        def report(now: Any, name: str = name, config: Any = config) -> None:
            text = (
                f"{name}: {now.played:,} of {config.ppo.num_episodes:,} episodes, "
                f"{now.per_second:,.0f}/s, {now.eta / 60:.1f} min left, "
                f"reward {now.metrics['reward_mean']:.4f}"
            )
            print(text, file=sys.stderr, flush=True)

        train_seed(config, run, report=report)
        _collect(run, target)


def _is_finished(path: pathlib.Path, config: Any) -> bool:
    """Whether this seed is done; ValueError where it is one of another training."""
    if not path.is_file():
        return False
    wanted = (config.preset, config.ppo.num_episodes, config.seed)
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
        same = (held["preset"], held["planned_episodes"], held["seed"])
        finished = bool(held["finished"])
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path} is not the summary of a training run") from None
    if same != wanted:
        own, other = (
            "preset {}, {} episodes, seed {}".format(*t) for t in (same, wanted)
        )
        raise ValueError(f"{path} is of {own}, not {other}: name another --out")
    return finished


def _collect(run: pathlib.Path, out: pathlib.Path) -> None:
    summary = collect(run, out)
    good = summary["dataset2"]
    print(
        f"{out}: {summary['episodes']:,} of {summary['planned_episodes']:,} episodes, "
        f"{summary['seconds'] / 60:.1f} min, det S/det S* "
        f"{good['ratio_to_exact']:.4f}, hit rate {good['hit_rate']:.3f} on dataset2",
        flush=True,
    )


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        prog="python -m studies.paper.training_runs",
        description=_DESCRIPTION,
        epilog=_EPILOG,
    )
    add = parser.add_argument
    number: dict[str, Any] = {"type": command.positive, "metavar": "N"}
    folder: dict[str, Any] = {"type": pathlib.Path, "metavar": "DIR"}
    add("--preset", metavar="NAME", help="compact, general or paper")
    add("--seeds", type=_seeds, metavar="N", help="0 to N-1, or a list 3,5,8; 5")
    add("--episodes", help="budget of each; the preset's", **number)
    add("--collect", help="keep this run; no training", **folder)
    add("--out", required=True, help="kept files", **folder)
    add("--runs", help="run folders; runs/(--out)", **folder)
    options = parser.parse_args(arguments)
    if (options.preset is None) == (options.collect is None):
        parser.error("give one of --preset and --collect")
    if options.preset is None:
        if options.seeds or options.episodes or options.runs:
            parser.error("--seeds, --episodes and --runs go with --preset")
        return options
    from jaxcal.learning.training import presets

    if options.preset not in presets.names():
        known = ", ".join(presets.names())
        parser.error(f"--preset must be one of {known}, got {options.preset!r}")
    options.seeds = options.seeds or list(range(5))
    return options


def _seeds(text: str) -> list[int]:
    parts = text.split(",")
    if all(part.isdecimal() for part in parts):
        if len(parts) > 1:
            return list(dict.fromkeys(map(int, parts)))
        if int(text) > 0:
            return list(range(int(text)))
    raise argparse.ArgumentTypeError(
        f"must be a number of seeds or a list like 3,5,8, got {text!r}"
    )


if __name__ == "__main__":
    sys.exit(main())
