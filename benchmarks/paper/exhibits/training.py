"""Figure 2: training curves of the compact preset over seeds, and of a ``paper`` run.

Nothing is trained here: the runs are kept in ``kept/`` by
``benchmarks.paper.training_runs`` and read from there; what is not there is said to be
missing.
"""

from __future__ import annotations

import dataclasses
import json
import pathlib
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.paper.exhibits.exhibit import Exhibit, Verdict, judge
from benchmarks.paper.exhibits.figures import last_rewards, training_panels
from benchmarks.paper.exhibits.intervals import band, mean_interval
from benchmarks.paper.exhibits.study import Study
from jaxcal.evaluation.figures import read_metrics
from jaxcal.reports.plots import COLOURS, GREY, boxes, panels

Array = NDArray[np.float64]

CLAIMED = 200_000  # episodes within which the paper's training converges
_SUMMARY = (  # what is read of a run's summary.json
    *("seed", "episodes", "planned_episodes", "seconds", "parameters"),
    *("versions", "dataset2"),
)


@dataclasses.dataclass(frozen=True)
class Run:
    """A kept training run."""

    folder: pathlib.Path
    metrics: dict[str, Array]
    summary: dict[str, Any]
    rewards: Array  # of the last episodes
    rewards_are: str  # in words

    @property
    def made(self) -> str:
        """What it was made with, in words."""
        held = self.summary["versions"]
        return f"Made with jaxcal {held['jaxcal']}, jax {held['jax']}."

    @property
    def finished(self) -> bool:
        """Whether it ran as many episodes as were planned."""
        return bool(self.summary["episodes"] >= self.summary["planned_episodes"])


def exhibits(study: Study) -> list[Exhibit]:
    """The seeds of the compact preset, and the paper's network."""
    studies = study.settings.studies
    seeds, paper = (
        kept_runs(studies / f"{kind}_seeds") for kind in ("compact", "paper")
    )
    return [_seeds(seeds, paper), _paper(paper)]


def kept_runs(folder: pathlib.Path) -> list[Run]:
    """Runs in the folders ``seed_*``, in the order of their seeds.

    Raises:
        OSError: one has no summary.
        ValueError: a file of one cannot be understood.
    """
    found = []
    for path in sorted(folder.glob("seed_*/metrics.csv")):
        metrics = read_metrics(path)
        rewards, what = last_rewards(path.parent, metrics)
        summary = _summary(path.with_name("summary.json"))
        found.append(Run(path.parent, metrics, summary, rewards, what))
    return sorted(found, key=lambda run: run.summary["seed"])


def _summary(path: pathlib.Path) -> dict[str, Any]:
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
        return {name: held[name] for name in _SUMMARY}
    except (ValueError, KeyError, TypeError):
        raise ValueError(f"{path} is not the summary of a training run") from None


def plateau(run: Run) -> dict[str, float]:
    """Where a reward curve became flat, and how much it still rises.

    ``episode``: from where on the moving average (5 % of the run) stays within 5 % of
    the whole rise from the final level. ``last_tenth``: rise from the tenth before the
    last to the last, as a share of the whole.
    """
    reward, episodes = run.metrics["reward_mean"], run.metrics["episodes"]
    count = len(reward)
    part, window = max(count // 10, 1), max(count // 20, 1)
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


def _converges(runs: list[Run], flat: list[dict[str, float]]) -> Verdict:
    """Whether every run rose and became flat within the paper's episodes."""
    if not all(run.finished and run.summary["episodes"] >= CLAIMED for run in runs):
        return "not comparable"
    rose = all(state["rise"] > 0 for state in flat)
    settled = all(abs(state["last_tenth"]) < 0.02 for state in flat)
    in_time = all(state["episode"] <= CLAIMED for state in flat)
    return judge(rose and settled and in_time, rose and not settled)


def _seeds(runs: list[Run], paper: list[Run]) -> Exhibit:
    if len(runs) < 2:
        return Exhibit.missing("figure_2", seeds=len(runs))
    grid = np.linspace(
        max(run.metrics["episodes"][0] for run in runs),
        min(run.metrics["episodes"][-1] for run in runs),
        100,
    )
    columns: dict[str, Any] = {"episodes": grid}
    for run in runs:
        curve = np.interp(grid, run.metrics["episodes"], run.metrics["reward_mean"])
        columns[f"reward_seed_{run.summary['seed']}"] = curve
    means = [mean_interval(row) for row in np.transpose(list(columns.values())[1:])]
    for name, field in (("mean", "value"), ("low", "low"), ("high", "high")):
        columns[f"reward_{name}"] = np.array([getattr(m, field) for m in means])
    flat = [plateau(run) for run in runs]
    lengths = [run.summary["episodes"] for run in runs]
    numbers: dict[str, Any] = {
        "seeds": len(runs),
        "episodes": lengths,
        "plateau_episode": mean_interval([f["episode"] for f in flat]),
        "last_tenth_of_rise": [f["last_tenth"] for f in flat],
        "last_1000_reward_mean": mean_interval([r.rewards.mean() for r in runs]),
        "last_1000_reward_std": mean_interval([r.rewards.std() for r in runs]),
        "seconds": [run.summary["seconds"] for run in runs],
    }
    for name in ("ratio_to_exact", "hit_rate"):
        reached = [run.summary["dataset2"][name] for run in runs]
        numbers[name] = mean_interval(reached, upper_limit=1.0)
    shown = {f"seed {run.summary['seed']}": run for run in runs}
    shown |= dict(zip(["paper's"], paper[:1], strict=False))
    ends = dict.fromkeys((min(lengths), max(lengths)))
    return Exhibit.from_texts(
        "figure_2",
        {
            "range": " to ".join(f"{end:,}" for end in ends),
            "caution": _caution(runs),
            "made": runs[0].made,
        },
        verdict=_converges(runs, flat),
        figures={"figure_2_seeds": _curves(shown, columns)},
        data={
            "reward": columns,
            "last_rewards": {
                "run": [name for name, run in shown.items() for _ in run.rewards],
                "reward": np.concatenate([run.rewards for run in shown.values()]),
            },
        },
        numbers=numbers,
    )


def _caution(runs: list[Run]) -> str:
    """Where the runs are shorter than the claim or cut off; else nothing."""
    parts = []
    short = [run for run in runs if run.summary["episodes"] < CLAIMED]
    if short:
        parts.append(f"{len(short)} of {len(runs)} runs are shorter than {CLAIMED:,}")
    cut = [run for run in runs if not run.finished]
    if cut:
        parts.append(f"{len(cut)} not finished")
    return ", ".join(parts) + ". " if parts else ""


def _curves(runs: dict[str, Run], columns: dict[str, Any]) -> Figure:
    """Reward with the band over seeds, last rewards, share of the optimum."""
    title = "Training of the compact preset over seeds, and of the paper's network"
    figure, (left, middle, right) = panels((12.0, 3.8), title, (1, 3))
    colours = [COLOURS[not name.startswith("seed")] for name in runs]
    for (name, run), colour in zip(runs.items(), colours, strict=True):
        x = run.metrics["episodes"] / 1e3
        ratio = run.metrics.get("ratio_to_exact", np.full(len(x), np.nan))
        known, label = np.isfinite(ratio), name
        if name.startswith("seed"):
            label = "one seed" if name == next(iter(runs)) else "_"  # not in legends
            thin = {"color": GREY, "linewidth": 0.6, "alpha": 0.7, "label": label}
            left.plot(x, run.metrics["reward_mean"], **thin)
        right.plot(x[known], ratio[known], color=colour, label=label, linewidth=1.0)
    ends = (columns[f"reward_{name}"] for name in ("mean", "low", "high"))
    text = "mean of the seeds; band: its 95 % interval"
    band(left, columns["episodes"] / 1e3, *ends, color=COLOURS[0], label=text)
    boxes(middle, [run.rewards for run in runs.values()], colours, (5, 95))
    middle.set_xticks(range(1, len(runs) + 1), [n.split()[-1] for n in runs])
    unit, x_label = "reward (log det S / 10)", "training episodes (thousands)"
    left.set(title="(a) reward", xlabel=x_label, ylabel=unit)
    seeds = "seed; box: quartiles, whiskers: 5 to 95 %"
    middle.set(title="(b) last 1,000 episodes", xlabel=seeds, ylabel=unit)
    right.set(title="(c) validation", xlabel=x_label, ylabel="mean det S / det S*")
    right.set_ylim(0.0, 1.02)
    for axes in (left, right):
        axes.legend(fontsize=8, frameon=False, loc="lower right")
    return figure


def _paper(runs: list[Run]) -> Exhibit:
    if not runs:
        return Exhibit.missing("figure_2_paper", present=False)
    run, flats = runs[0], [plateau(run) for run in runs]
    held, flat = run.summary, flats[0]
    took = "." if run.finished else ": not finished, so this is how far it went."
    ratios = [each.summary["dataset2"]["ratio_to_exact"] for each in runs]
    figure = training_panels({"paper's": run.folder})
    figure.suptitle("Training of the paper's network", fontsize=10)
    return Exhibit.from_texts(
        "figure_2_paper",
        {
            **{"took": took, "rewards_are": run.rewards_are, "made": run.made},
            **{"hours": held["seconds"] / 3600, "good": held["dataset2"]},
            "ratios": ", ".join(f"{ratio:.4f}" for ratio in ratios),
        },
        verdict=_converges(runs, flats),
        figures={"figure_2_paper": figure},
        data={"metrics": run.metrics, "last_rewards": {"reward": run.rewards}},
        numbers={
            "present": True,
            "seeds": len(runs),
            "ratio_to_exact": ratios,
            "finished": run.finished,
            **held,
            **flat,
            "last_reward_mean": float(run.rewards.mean()),
            "last_reward_std": float(run.rewards.std()),
        },
    )
