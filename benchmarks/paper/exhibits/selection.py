"""Figures 3, 4, 7, 8: det S of what PPO's policy chooses, random and the optimum."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.paper.exhibits import figures
from benchmarks.paper.exhibits.exhibit import Columns, Exhibit, judge
from benchmarks.paper.exhibits.intervals import (
    bootstrap_interval,
    mean_interval,
    share_interval,
)
from benchmarks.paper.exhibits.study import Settings, Study
from jaxcal.evaluation.figures import det_means, gap_to_optimum
from jaxcal.evaluation.methods import HIT_TOLERANCE, PostureEvaluation
from jaxcal.reports.plots import BLACK, COLOURS, legend_right, panels

Array = NDArray[np.float64]

STREAM = {"dataset2": 2, "dataset3": 3, "dataset4": 4}
_WHERE = {"dataset2": "simulation", "dataset3": "independent simulation"}


def exhibits(study: Study) -> list[Exhibit]:
    """Figures 3, 4, 7, 8 and the gap to the optimum."""
    return [
        _determinants(study, "dataset2", "figure_3", "Figure 3"),
        _gap(study, "dataset2"),
        _best(study, "dataset3", "figure_4", "Figure 4"),
        _determinants(study, "dataset4", "figure_7", "Figure 7"),
        _best(study, "dataset4", "figure_8", "Figure 8"),
    ]


def words_of(study: Study, name: str, title: str) -> dict[str, Any]:
    """What the texts of the exhibits of one dataset cite."""
    count, draws = study.evaluation(name).random_log_det.shape
    where = _WHERE.get(name, study.settings.recorded)
    overlap = study.about_overlap(name)
    words = {"title": title, "name": name, "where": where, "overlap": overlap}
    return words | {"count": count, "draws": draws}


def _by_episode(evaluation: PostureEvaluation) -> dict[str, Any]:
    return {"episode": np.arange(1, len(evaluation.reference) + 1)}


def _comparison(evaluation: PostureEvaluation, settings: Settings) -> dict[str, Any]:
    """Policy, greedy and optimum against random: ratios, spreads, hits, intervals."""
    rng = settings.rng(STREAM.get(evaluation.dataset.name, 9), 0)
    resamples = settings.size("resamples")
    draws = evaluation.random_log_det
    random = np.exp(draws).mean(axis=1)
    out: dict[str, Any] = {}
    for result in evaluation.results:
        det = np.exp(result.log_det)
        behind = np.minimum(result.log_det - evaluation.reference[:, None], 0.0)
        entry: dict[str, Any] = {
            "mean_det_s": mean_interval(det.mean(axis=1)),
            **{name: of(result.log_det) for name, of in _SPREADS.items()},
            "ratio_to_exact": mean_interval(
                np.exp(behind).mean(axis=1), upper_limit=1.0
            ),
        }
        if result.method != "random":
            hit = behind[:, 0] >= -HIT_TOLERANCE * evaluation.dataset.num_outputs
            entry["hit_rate"] = share_interval(hit)
            entry["times_random"] = bootstrap_interval(
                lambda a, b: a.mean() / b.mean(), (det[:, 0], random), rng, resamples
            )
            better = result.log_det[:, 0] > draws[:, 0]
            entry["beats_random"] = share_interval(better)
        out[result.method] = entry
    policy = next(r for r in evaluation.results if r.method == "policy").log_det[:, 0]
    for name, spread in _SPREADS.items():
        out[f"policy_over_random_{name}"] = bootstrap_interval(
            lambda a, b, of=spread: of(a) / of(b),
            (policy, draws),
            rng,
            max(resamples // 5, 200),
        )
    return out


def _relative_std(log_det: Array) -> float:
    det = np.exp(log_det)
    return float(det.std() / det.mean())


_SPREADS: dict[str, Any] = {  # of log det S
    "std_det_s": lambda log_det: float(np.exp(log_det).std()),
    "std_log_det_s": lambda log_det: float(np.std(log_det)),
    "relative_std_det_s": _relative_std,
}


def _determinants(study: Study, name: str, key: str, title: str) -> Exhibit:
    evaluation = study.evaluation(name)
    numbers = _comparison(evaluation, study.settings)
    times = numbers["policy"]["times_random"]
    narrower = all(
        numbers[f"policy_over_random_std_{what}"].high < 1.0
        for what in ("log_det_s", "det_s")
    )
    columns = _by_episode(evaluation)
    for result in evaluation.results:
        if result.method != "random":
            columns[f"log_det_s_{result.method}"] = result.log_det[:, 0]
    columns["log_det_s_optimum"] = evaluation.reference
    draws = enumerate(evaluation.random_log_det.T, start=1)
    data: dict[str, Columns] = {
        "log_det_s": columns,
        "random_log_det_s": {f"draw_{number}": values for number, values in draws},
    }
    return Exhibit.from_texts(
        "determinants",
        words_of(study, name, title),
        key=key,
        verdict=judge(times.low > 100.0 and narrower, times.high >= 100.0),
        figures={
            f"{key}a_det_per_episode": figures.det_per_episode(evaluation),
            f"{key}b_det_means": det_means(evaluation),
            f"{key}c_det_distributions": figures.det_distributions(evaluation),
        },
        data=data,
        numbers=numbers,
    )


def _gap(study: Study, name: str) -> Exhibit:
    evaluation = study.evaluation(name)
    columns = _by_episode(evaluation)
    numbers: dict[str, Any] = {"proven_share": float(evaluation.proven.mean())}
    for method in ("policy", "default", "greedy"):
        log_det = study.result(name, method).log_det[:, 0]
        ratio = np.exp(np.minimum(log_det - evaluation.reference, 0.0))
        columns[f"ratio_{method}"] = ratio
        numbers[method] = {
            "worst": ratio.min(),
            "mean": mean_interval(ratio, upper_limit=1.0),
        }
    proven = "proven" if evaluation.proven.all() else "proven or bounded"
    return Exhibit.from_texts(
        "gap_to_optimum",
        {"name": name, "count": len(evaluation.reference), "proven": proven},
        figures={
            "gap_per_episode": _gap_per_episode(columns, name),
            "gap_distribution": gap_to_optimum(evaluation),
        },
        data={"gap": columns},
        numbers=numbers,
    )


def _gap_per_episode(columns: dict[str, Array], name: str) -> Figure:
    """det S / det S* of PPO's policy and greedy in each episode."""
    title = f"Gap to the proven optimum, episode by episode: {name}, 4 of 50"
    figure, axes = panels((8.0, 3.6), title)
    axes.axhline(1.0, color=BLACK, linewidth=0.8, label="proven optimum")
    shown = slice(figures.SHOWN_EPISODES)
    for method, colour, marker, size, fill in (
        ("policy", COLOURS[0], "o", 3.0, COLOURS[0]),
        ("greedy", COLOURS[1], "s", 6.0, "none"),  # a dot in it where both are optimal
    ):
        look: dict[str, Any] = {"marker": marker, "markersize": size, "color": colour}
        look |= {"linestyle": "none", "markerfacecolor": fill, "markeredgewidth": 0.8}
        values = columns["episode"][shown], columns[f"ratio_{method}"][shown]
        axes.plot(*values, label={"policy": "PPO"}.get(method, method), **look)
    total = len(columns["episode"])
    part = "" if total <= shown.stop else f", first {shown.stop} of {total:,}"
    axes.set(xlabel=f"episode{part}", ylabel="det S / det S*", ylim=(0.0, 1.05))
    legend_right(axes)
    return figure


def _best(study: Study, name: str, key: str, title: str) -> Exhibit:
    evaluation = study.evaluation(name)
    best = {
        result.method: np.maximum.accumulate(result.log_det, axis=0)
        for result in evaluation.results
    }
    random = best.pop("random")
    columns = _by_episode(evaluation)
    columns |= {f"best_log_det_s_{m}": values[:, 0] for m, values in best.items()}
    for percent in (5, 50, 95):
        column = f"best_log_det_s_random_{percent}_percent"
        columns[column] = np.quantile(random, percent / 100, axis=1)
    first, most = best["policy"][0, 0], best["exact"][-1, 0]
    reached = int(np.argmax(best["policy"][:, 0] >= most - np.log(2.0))) + 1
    ahead = float(np.exp(first - np.median(random[-1])))
    never = float((random[-1] < first).mean())
    return Exhibit.from_texts(
        "best",
        words_of(study, name, title),
        key=key,
        verdict=judge(never > 0.95, True),
        figures={f"{key}_best_so_far": figures.best_so_far(evaluation)},
        data={"best_so_far": columns},
        numbers={
            "policy_first_episode_within_half_of_best": reached,
            "policy_first_over_random_best": ahead,
            "random_draws_that_never_reach_policys_first": never,
            "final_log_det_s": {m: float(v[-1, 0]) for m, v in best.items()},
            "comparison": _comparison(evaluation, study.settings),
        },
    )
