"""Figure 2: training curves of the compact preset over seeds, and of a ``paper`` run.

Nothing is trained here: the runs are kept in ``studies/`` by
``jaxcal.paper.training_runs`` and read from there; what is not there is said to be
missing.
"""

from __future__ import annotations

import dataclasses
import json
import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.evaluation.training_figure import (
    last_rewards,
    read_metrics,
    training_curves,
)
from jaxcal.paper.exhibits.exhibit import Exhibit, Verdict
from jaxcal.paper.exhibits.figures.training import curves_over_seeds
from jaxcal.paper.exhibits.intervals import mean_interval
from jaxcal.paper.exhibits.material import Material

__all__ = ["Run", "exhibits", "kept_runs", "plateau"]

Array = NDArray[np.float64]

SEEDS_FOLDER = "compact_seeds"
PAPER_FOLDER = "paper"
CLAIMED = 200_000  # episodes within which the paper's training converges
_GRID = 100


@dataclasses.dataclass(frozen=True)
class Run:
    """A kept training run."""

    folder: pathlib.Path
    metrics: dict[str, Array]
    summary: dict[str, Any]
    rewards: Array  # of the last episodes
    rewards_are: str  # in words


def exhibits(material: Material) -> list[Exhibit]:
    """The seeds of the compact preset, and the paper's network."""
    studies = material.settings.studies
    seeds = kept_runs(studies / SEEDS_FOLDER)
    paper = kept_runs(studies, PAPER_FOLDER)
    return [_seeds(seeds, paper[0] if paper else None), _paper(paper)]


def kept_runs(folder: pathlib.Path, pattern: str = "seed_*") -> list[Run]:
    """Runs in the folders that match, in the order of their seeds.

    Raises:
        ValueError: a file of one cannot be understood.
    """
    found = []
    for place in sorted(folder.glob(pattern)):
        if not (place / "metrics.csv").is_file():
            continue
        metrics = read_metrics(place / "metrics.csv")
        rewards, what = last_rewards(place, metrics)
        found.append(Run(place, metrics, _summary(place, metrics), rewards, what))
    return sorted(found, key=lambda run: run.summary["seed"])


def _summary(folder: pathlib.Path, metrics: dict[str, Array]) -> dict[str, Any]:
    """The summary of a run; what metrics.csv tells where there is none."""
    path = folder / "summary.json"
    known: dict[str, Any] = {
        "seed": 0,
        "episodes": int(metrics["episodes"][-1]),
        "planned_episodes": None,
        "finished": None,
        "seconds": float(metrics["seconds"][-1]) if "seconds" in metrics else None,
        "parameters": None,
        "dataset2": None,
    }
    if path.is_file():
        try:
            held = json.loads(path.read_text(encoding="utf-8"))
            known |= {name: held[name] for name in known}
        except (ValueError, KeyError, TypeError):
            raise ValueError(f"{path} is not the summary of a training run") from None
    return known


def plateau(run: Run) -> dict[str, float]:
    """Where a reward curve became flat, and how much it still rises.

    ``episode``: from where on the moving average (5 % of the run) stays within 5 % of
    the whole rise from the final level. ``last_tenth``: rise from the tenth before the
    last to the last, as a share of the whole.
    """
    reward, episodes = run.metrics["reward_mean"], run.metrics["episodes"]
    count = len(reward)
    part = max(count // 10, 1)
    window = max(count // 20, 1)
    final = float(reward[-part:].mean())
    rise = final - float(reward[0])
    smooth = np.convolve(reward, np.ones(window) / window, mode="valid")
    outside = np.flatnonzero(np.abs(smooth - final) > 0.05 * abs(rise))
    first = min(int(outside[-1]) + 1 if outside.size else 0, len(smooth) - 1)
    before = float(reward[-2 * part : -part].mean()) if count > 2 * part else final
    return {
        "episode": float(episodes[first + window - 1]),
        "final_reward": final,
        "rise": rise,
        "last_tenth": (final - before) / rise if rise else 0.0,
    }


def _seeds(runs: list[Run], paper: Run | None) -> Exhibit:
    if len(runs) < 2:
        return Exhibit.missing("figure_2", seeds=len(runs))
    grid = np.linspace(
        max(run.metrics["episodes"][0] for run in runs),
        min(run.metrics["episodes"][-1] for run in runs),
        _GRID,
    )
    reward = np.array(
        [np.interp(grid, r.metrics["episodes"], r.metrics["reward_mean"]) for r in runs]
    )
    bands = [mean_interval(column) for column in reward.T]
    columns: dict[str, Any] = {"episodes": grid}
    for run, curve in zip(runs, reward, strict=True):
        columns[f"reward_seed_{run.summary['seed']}"] = curve
    columns["reward_mean"] = [b.value for b in bands]
    columns["reward_low"] = [b.low for b in bands]
    columns["reward_high"] = [b.high for b in bands]
    flat = [plateau(run) for run in runs]
    numbers: dict[str, Any] = {
        "seeds": len(runs),
        "episodes": [run.summary["episodes"] for run in runs],
        "plateau_episode": mean_interval([f["episode"] for f in flat]),
        "last_tenth_of_rise": [f["last_tenth"] for f in flat],
        "last_1000_reward_mean": mean_interval([r.rewards.mean() for r in runs]),
        "last_1000_reward_std": mean_interval([r.rewards.std() for r in runs]),
        "seconds": [run.summary["seconds"] for run in runs],
    }
    measured = [run.summary["dataset2"] for run in runs]
    text = ""
    if all(measured):
        for name in ("ratio_to_exact", "hit_rate"):
            numbers[name] = mean_interval([m[name] for m in measured], most=1.0)
        text = (
            f" On 1,000 unseen sets det S / det S* is {numbers['ratio_to_exact']:.4f} "
            f"and the optimum is hit in {numbers['hit_rate']:.3f}."
        )
    rewards = {f"seed {run.summary['seed']}": run.rewards for run in runs}
    rewards |= {"paper's network": paper.rewards} if paper else {}
    least, most = min(numbers["episodes"]), max(numbers["episodes"])
    length = f"{most:,}" if least == most else f"{least:,} to {most:,}"
    return Exhibit.from_texts(
        "figure_2",
        {"range": length, "caution": _caution(runs), "measured": text},
        verdict=_converges(runs, flat),
        figures={"figure_2_seeds": curves_over_seeds(runs, columns, rewards, paper)},
        data={
            "reward": columns,
            "last_rewards": {
                "run": [name for name, values in rewards.items() for _ in values],
                "reward": np.concatenate(list(rewards.values())),
            },
        },
        numbers=numbers,
    )


def _finished(run: Run) -> bool:
    return run.summary["episodes"] >= (run.summary["planned_episodes"] or CLAIMED)


def _converges(runs: list[Run], flat: list[dict[str, float]]) -> Verdict:
    """Whether every run rose and became flat within the paper's episodes."""
    if not all(_finished(r) and r.summary["episodes"] >= CLAIMED for r in runs):
        return "not comparable"
    if not all(state["rise"] > 0 for state in flat):
        return "disagrees"
    if all(abs(state["last_tenth"]) < 0.02 for state in flat):
        in_time = all(state["episode"] <= CLAIMED for state in flat)
        return "agrees" if in_time else "disagrees"
    return "agrees in part"


def _caution(runs: list[Run]) -> str:
    """Where the runs are shorter than the claim or cut off; else nothing."""
    parts = []
    short = [r for r in runs if r.summary["episodes"] < CLAIMED]
    if short:
        parts.append(f"{len(short)} of {len(runs)} runs are shorter than {CLAIMED:,}")
    cut = [r for r in runs if not _finished(r)]
    if cut:
        parts.append(f"{len(cut)} not finished")
    return ", ".join(parts) + ". " if parts else ""


def _paper(runs: list[Run]) -> Exhibit:
    if not runs:
        return Exhibit.missing("figure_2_paper", present=False)
    run = runs[0]
    held, flat, finished = run.summary, plateau(run), _finished(run)
    took = "" if held["seconds"] is None else f" in {held['seconds'] / 3600:.2f} h"
    took += "." if finished else ": not finished, so this is how far it went."
    good, measured = held["dataset2"], ""
    ratio = run.metrics.get("ratio_to_exact", np.array([np.nan]))
    known = ratio[np.isfinite(ratio)]
    if good is not None:
        measured = (
            f" det S / det S* {good['ratio_to_exact']:.4f}, optimum hit in "
            f"{good['hit_rate']:.3f} of {good['episodes']:,} unseen sets."
        )
    elif known.size:
        measured = f" det S / det S* {known[-1]:.4f} on the validation sets."
    size = held["parameters"]
    figure = training_curves(run.folder)
    figure.suptitle("Training of the paper's network", fontsize=10)
    return Exhibit.from_texts(
        "figure_2_paper",
        {
            "planned": held["planned_episodes"] or CLAIMED,
            "took": took,
            "measured": measured,
            "weights": "" if size is None else f", {size:,} weights",
            "rewards_are": run.rewards_are,
        },
        verdict=_converges([run], [flat]),
        figures={"figure_2_paper": figure},
        data={"metrics": run.metrics, "last_rewards": {"reward": run.rewards}},
        numbers={
            "present": True,
            "finished": finished,
            **held,
            **flat,
            "last_reward_mean": float(run.rewards.mean()),
            "last_reward_std": float(run.rewards.std()),
        },
    )
