"""How much a trained policy depends on its seed: the compact preset, several times.

    python benchmarks/seeds.py [--seeds 0,1,2] [--episodes N] [--sets 1000] [--out DIR]

Trains once a seed (the preset's own budget when --episodes is not given), then measures
one greedy pass of each on the same unseen sets of 50 uniform candidates, K = 4: the
mean of det S / det S*, the share of sets where the proven optimum is hit (log det
within 1e-8), and the same for the best of the 8 likeliest first picks; last the mean
over the seeds, the range and the standard deviation (n - 1). A run that is already in
--out is measured again, not trained again.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import pathlib
import tempfile
import time

import numpy as np

from jaxcal.commands.train import main as train
from jaxcal.information.regression import log_det_information
from jaxcal.learning.runtime import processes
from jaxcal.learning.training import presets
from jaxcal.selection import exact_batch
from jaxcal.selection.policy import select_batch

HIT = 1e-8
NAMES = ("ratio", "hit_rate", "ratio of 8", "hits of 8")


def measure(folder: pathlib.Path, sets: np.ndarray, best: np.ndarray) -> list[float]:
    """The four figures of a run, in float64, against the proven optimum."""
    figures = []
    for options in ({}, {"decoding": "first", "num": 8}):
        picked = select_batch(sets, 4, checkpoint=folder, **options)
        chosen = np.take_along_axis(sets, picked[..., None], axis=1)
        behind = np.asarray(log_det_information(chosen)) - best
        figures += [float(np.exp(behind).mean()), float((behind > -HIT).mean())]
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", default="0,1,2", help="separated by commas")
    parser.add_argument("--episodes", type=int, help="training budget of each")
    parser.add_argument("--sets", type=int, default=1000, help="sets measured")
    parser.add_argument("--out", type=pathlib.Path, help="where to keep the runs")
    arguments = parser.parse_args()
    processes.keep_compiled_programs()
    seeds = [int(seed) for seed in arguments.seeds.split(",")]
    sets = np.random.default_rng(20261122).random((arguments.sets, 50, 3))
    optimum = exact_batch(sets, 4)
    assert optimum.proven.all()
    budget = arguments.episodes or presets.load("compact").ppo.num_episodes
    print(f"compact preset, {budget:,} episodes, {arguments.sets} sets")
    print(f"{'seed':>8}" + "".join(f"{name:>12}" for name in NAMES) + "   trained (s)")
    with tempfile.TemporaryDirectory() as scratch:
        root = arguments.out or pathlib.Path(scratch)
        rows = []
        for seed in seeds:
            folder = root / f"seed_{seed}"
            begun = time.perf_counter()
            if not (folder / "checkpoint").is_dir():
                flags = {"--seed": seed, "--episodes": budget, "--out": folder}
                given = [str(word) for flag in flags.items() for word in flag]
                with contextlib.redirect_stdout(io.StringIO()):
                    assert train(["--no-validation", *given]) == 0
            seconds = time.perf_counter() - begun
            rows.append(measure(folder, sets, optimum.log_det))
            print(f"{seed:8d}" + line(rows[-1]) + f"{seconds:14.0f}", flush=True)
    table = np.array(rows)
    summary = {"mean": table.mean(0), "least": table.min(0), "largest": table.max(0)}
    if len(rows) > 1:
        summary["s.d."] = table.std(0, ddof=1)
    for name, values in summary.items():
        print(f"{name:>8}" + line(values))


def line(values: np.ndarray | list[float]) -> str:
    """Numbers in the columns of the table."""
    return "".join(f"{value:12.4f}" for value in values)


if __name__ == "__main__":
    main()
