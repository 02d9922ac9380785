"""Figures 3 to 5, 7 to 9: what the policy chooses, against random and the optimum."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.evaluation import figures
from jaxcal.evaluation.parameters import parameter_names
from jaxcal.evaluation.results import HIT_TOLERANCE, Evaluation
from jaxcal.paper.exhibits.columns import Columns
from jaxcal.paper.exhibits.exhibit import Exhibit, Verdict
from jaxcal.paper.exhibits.figures.selection import gap_per_episode
from jaxcal.paper.exhibits.intervals import (
    Interval,
    bootstrap_interval,
    mean_interval,
    share_interval,
)
from jaxcal.paper.exhibits.material import Material
from jaxcal.paper.exhibits.settings import Settings
from jaxcal.plots import BLACK, COLOURS, GREY

__all__ = ["comparison", "exhibits", "variance_table"]

Array = NDArray[np.float64]

_STREAM = {"dataset2": 2, "dataset3": 3, "dataset4": 4}
_WHERE = {"dataset2": "simulation", "dataset3": "independent simulation"}


def exhibits(material: Material) -> list[Exhibit]:
    """Figures 3, 4, 5, 7, 8, 9 and the gap to the optimum."""
    return [
        _determinants(material, "dataset2", "figure_3", "Figure 3"),
        _gap(material, "dataset2"),
        _best(material, "dataset3", "figure_4", "Figure 4"),
        _variance(material, "dataset3", "figure_5", "Figure 5"),
        _determinants(material, "dataset4", "figure_7", "Figure 7"),
        _best(material, "dataset4", "figure_8", "Figure 8"),
        _variance(material, "dataset4", "figure_9", "Figure 9"),
    ]


def _words(material: Material, name: str, title: str) -> dict[str, Any]:
    """What the texts of the exhibits of one dataset cite."""
    count, draws = material.evaluation(name).random_log_det.shape
    where = _WHERE.get(name, material.settings.recorded)
    overlap = material.about_overlap(name)
    return {"title": title, "name": name, "where": where, "overlap": overlap} | {
        "count": count,
        "draws": draws,
    }


def _episodes(evaluation: Evaluation) -> NDArray[np.int64]:
    return np.arange(1, len(evaluation.reference) + 1)


# -- Figures 3 and 7 -------------------------------------------------------------------


def comparison(evaluation: Evaluation, settings: Settings) -> dict[str, Any]:
    """Policy, greedy and optimum against random: ratios, spreads, hits, intervals."""
    rng = settings.rng(_STREAM.get(evaluation.dataset.name, 9), 0)
    draws = evaluation.random_log_det
    random = np.exp(draws).mean(axis=1)
    out: dict[str, Any] = {}
    for result in evaluation.results:
        det = np.exp(result.log_det)
        behind = np.minimum(result.log_det - evaluation.reference[:, None], 0.0)
        entry: dict[str, Any] = {
            "mean_det_s": mean_interval(det.mean(axis=1)),
            "std_det_s": float(det.std()),
            "std_log_det_s": float(result.log_det.std()),
            "relative_std_det_s": float(det.std() / det.mean()),
            "ratio_to_exact": mean_interval(np.exp(behind).mean(axis=1), most=1.0),
        }
        if result.method != "random":
            hit = behind[:, 0] >= -HIT_TOLERANCE * evaluation.dataset.num_outputs
            entry["hit_rate"] = share_interval(hit)
            entry["times_random"] = bootstrap_interval(
                lambda a, b: a.mean() / b.mean(),
                (det[:, 0], random),
                rng,
                settings.resamples,
            )
            better = result.log_det[:, 0] > draws[:, 0]
            entry["beats_random"] = share_interval(better)
        out[result.method] = entry
    policy = next(r for r in evaluation.results if r.method == "policy").log_det[:, 0]
    for name, spread in (
        ("std_det_s", lambda log_det: np.exp(log_det).std()),
        ("std_log_det_s", np.std),
        ("relative_std_det_s", _relative_std),
    ):
        out[f"policy_over_random_{name}"] = bootstrap_interval(
            lambda a, b, of=spread: of(a) / of(b),
            (policy, draws),
            rng,
            max(settings.resamples // 5, 200),
        )
    return out


def _relative_std(log_det: Array) -> float:
    det = np.exp(log_det)
    return float(det.std() / det.mean())


def _determinant_columns(evaluation: Evaluation) -> dict[str, Columns]:
    """log det S of every selection, and each random draw in a table of its own."""
    columns: dict[str, Any] = {"episode": _episodes(evaluation)}
    for result in evaluation.results:
        if result.method != "random":
            columns[f"log_det_s_{result.method}"] = result.log_det[:, 0]
    columns["log_det_s_optimum"] = evaluation.reference
    draws = enumerate(evaluation.random_log_det.T, start=1)
    random = {f"draw_{number}": values for number, values in draws}
    return {"log_det_s": columns, "random_log_det_s": random}


def _determinants(material: Material, name: str, key: str, title: str) -> Exhibit:
    evaluation = material.evaluation(name)
    numbers = comparison(evaluation, material.settings)
    times: Interval = numbers["policy"]["times_random"]
    spread: Interval = numbers["policy_over_random_std_log_det_s"]
    absolute: Interval = numbers["policy_over_random_std_det_s"]
    verdict: Verdict = "agrees in part"
    if times.high < 100.0:
        verdict = "disagrees"
    elif spread.high < 1.0 and absolute.high < 1.0 and times.low > 100.0:
        verdict = "agrees"
    return Exhibit.from_texts(
        "determinants",
        _words(material, name, title),
        key=key,
        verdict=verdict,
        figures={
            f"{key}a_det_per_episode": figures.det_per_episode(evaluation),
            f"{key}b_det_means": figures.det_means(evaluation),
            f"{key}c_det_distributions": figures.det_distributions(evaluation),
        },
        data=_determinant_columns(evaluation),
        numbers=numbers,
    )


def _gap(material: Material, name: str) -> Exhibit:
    evaluation = material.evaluation(name)
    columns: dict[str, Any] = {"episode": _episodes(evaluation)}
    numbers: dict[str, Any] = {"proven_share": float(evaluation.proven.mean())}
    for method in ("policy", "greedy"):
        log_det = material.result(name, method).log_det[:, 0]
        ratio = np.exp(np.minimum(log_det - evaluation.reference, 0.0))
        columns[f"ratio_{method}"] = ratio
        numbers[method] = {"worst": ratio.min(), "mean": mean_interval(ratio, most=1.0)}
    proven = "proven" if evaluation.proven.all() else "proven or bounded"
    return Exhibit.from_texts(
        "gap_to_optimum",
        {"name": name, "count": len(evaluation.reference), "proven": proven},
        figures={
            "gap_per_episode": gap_per_episode(columns, name),
            "gap_distribution": figures.gap_to_optimum(evaluation),
        },
        data={"gap": columns},
        numbers=numbers,
    )


# -- Figures 4 and 8 -------------------------------------------------------------------


def _best(material: Material, name: str, key: str, title: str) -> Exhibit:
    evaluation = material.evaluation(name)
    best = {
        result.method: np.maximum.accumulate(result.log_det, axis=0)
        for result in evaluation.results
    }
    random = best.pop("random")
    columns: dict[str, Any] = {"episode": _episodes(evaluation)}
    columns |= {f"best_log_det_s_{m}": values[:, 0] for m, values in best.items()}
    for percent in (5, 50, 95):
        column = f"best_log_det_s_random_{percent}_percent"
        columns[column] = np.quantile(random, percent / 100, axis=1)
    first, most = best["policy"][0, 0], best["exact"][-1, 0]
    reached = int(np.argmax(best["policy"][:, 0] >= most - np.log(2.0))) + 1
    never = float((random[-1] < first).mean())
    return Exhibit.from_texts(
        "best",
        _words(material, name, title),
        key=key,
        verdict="agrees" if never > 0.95 else "agrees in part",
        figures={f"{key}_best_so_far": figures.best_so_far(evaluation)},
        data={"best_so_far": columns},
        numbers={
            "policy_first_episode_within_half_of_best": reached,
            "policy_first_over_random_best": float(
                np.exp(first - np.median(random[-1]))
            ),
            "random_draws_that_never_reach_policys_first": never,
            "final_log_det_s": {m: float(v[-1, 0]) for m, v in best.items()},
            "comparison": comparison(evaluation, material.settings),
        },
    )


# -- Figures 5 and 9 -------------------------------------------------------------------


def variance_table(
    parameters: dict[str, Array], rng: np.random.Generator, resamples: int
) -> dict[str, tuple[Array, Array, Array]]:
    """Variance over episodes of each parameter, with an interval.

    Of several draws per episode: the median variance, between 5 and 95 % of the draws.
    Else the variance and its bootstrap interval, the same episodes for every method.

    Args:
        parameters: (E, R, P) by method, the policy among them.
        rng: of the bootstrap.
        resamples: of it.

    Returns:
        By method: (P,) variance, lower and upper end; and under ``method/policy`` each
        method's variance over the policy's: paired, or, of several draws, between the
        5 % draw over the policy's upper end and the 95 % draw over its lower.
    """
    count = len(parameters["policy"])
    weight = rng.multinomial(count, np.full(count, 1.0 / count), resamples) / count
    out: dict[str, tuple[Array, Array, Array]] = {}
    again = {}  # (resamples, P) of the methods with one draw
    for method, sample in parameters.items():
        value = sample.var(axis=0)  # (R, P)
        if len(value) > 1:
            low, middle, high = np.quantile(value, [0.05, 0.5, 0.95], axis=0)
            out[method] = (middle, low, high)
            continue
        one = sample[:, 0] - sample[:, 0].mean(axis=0)
        again[method] = weight @ one**2 - (weight @ one) ** 2
        low, high = np.quantile(again[method], [0.025, 0.975], axis=0)
        out[method] = (value[0], low, high)
    policy, policy_low, policy_high = out["policy"]
    for method in parameters:
        if method == "policy":
            continue
        value, low, high = out[method]
        if method in again:
            ratio = again[method] / again["policy"]
            low, high = np.quantile(ratio, [0.025, 0.975], axis=0)
        else:
            low, high = low / policy_high, high / policy_low
        out[f"{method}/policy"] = (value / policy, low, high)
    return out


def _variance(material: Material, name: str, key: str, title: str) -> Exhibit:
    evaluation, settings = material.evaluation(name), material.settings
    parameters = {
        result.method: result.parameters
        for result in evaluation.results
        if result.parameters is not None
    }
    parameters["all 50"] = material.all_parameters(name)[:, None]
    table = variance_table(
        parameters, settings.rng(_STREAM[name], 1), settings.resamples
    )
    names = parameter_names(3, 3)
    columns: dict[str, Any] = {"parameter": list(names)}
    for method, (value, low, high) in table.items():
        plain = method.replace(" ", "_").replace("/", "_over_")
        columns |= {plain: value, f"{plain}_low": low, f"{plain}_high": high}
    styles = {
        "random": ("random", GREY, "x"),
        "greedy": ("greedy", COLOURS[1], "s"),
        "policy": ("policy", COLOURS[0], "o"),
        "exact": ("exact", BLACK, "*"),
        "all 50": ("all 50 postures", COLOURS[2], "^"),
    }
    rows = [
        (label, table[m][0], table[m][1:], {"color": colour, "marker": marker})
        for m, (label, colour, marker) in styles.items()
    ]
    figure = figures.variances(rows, names, "A: no unit, b: deg²")
    figure.axes[0].set_title(
        f"Cross-episode variance of the identified parameters: {name}", fontsize=10
    )
    against, fifty = table["random/policy"], table["all 50/policy"]
    lower = int((against[1] > 1.0).sum())
    verdict: Verdict = "disagrees"
    if lower:
        verdict = "agrees" if (fifty[1] > 1.0).all() else "agrees in part"
    ratio = against[0]
    words = {"middle": np.median(ratio), "least": ratio.min(), "most": ratio.max()}
    words |= {"lower": lower, "fifty": np.median(fifty[0])}
    return Exhibit.from_texts(
        "variance",
        _words(material, name, title) | words,
        key=key,
        verdict=verdict,
        figures={f"{key}_parameter_variance": figure},
        data={
            "variance": columns,
            "parameters": _parameter_columns(parameters, names),
        },
        numbers={
            method: {"value": value, "low": low, "high": high}
            for method, (value, low, high) in table.items()
        },
    )


def _parameter_columns(
    parameters: dict[str, Array], names: tuple[str, ...]
) -> dict[str, Any]:
    """Every identified parameter, a row per episode and draw of each method."""
    places = [
        (method, episode + 1, draw + 1)
        for method, sample in parameters.items()
        for episode, draw in np.ndindex(sample.shape[:2])
    ]
    values = np.concatenate([p.reshape(-1, len(names)) for p in parameters.values()])
    heads = zip(("method", "episode", "draw"), zip(*places, strict=True), strict=True)
    return dict(heads) | dict(zip(names, values.T, strict=True))
