"""The evaluation against numbers recomputed by hand, with a policy that is a stub."""

from __future__ import annotations

import itertools
import json
import pathlib
import re
import sys
import types
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from benchmarks.paper.exhibits.figures import (
    best_so_far,
    det_distributions,
    det_per_episode,
    training_panels,
)
from jaxcal.evaluation import figures
from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.figures import evaluation_figures, training_curves
from jaxcal.evaluation.methods import (
    POLICIES,
    PostureEvaluation,
    PostureResult,
    check_methods,
    estimate_parameters,
    evaluate,
)
from jaxcal.evaluation.report import (
    file_prefixes,
    json_document,
    text_table,
    write_report,
)
from jaxcal.information.regression import regression_matrix
from jaxcal.models import Affine
from jaxcal.paper.datasets import make_dataset
from jaxcal.reports.plots import as_bytes

BASELINES = ("random", "greedy", "exchange", "exact")


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """A policy that takes the last k available candidates, and what it was asked."""
    asked: list[dict[str, Any]] = []

    def select_batch(
        candidates: Any, k: int, *, available: Any = None, **options: Any
    ) -> Any:
        asked.append({"shape": candidates.shape, "k": k, **options})
        size = candidates.shape[:2]
        mask = np.ones(size, bool) if available is None else available
        order = np.argsort(np.where(mask, -np.arange(size[1]), 1e9), axis=1)
        return order[:, :k]

    stub = types.ModuleType("jaxcal.selection.policy")
    stub.select_batch = select_batch  # type: ignore[attr-defined]  # a module made here
    monkeypatch.setitem(sys.modules, "jaxcal.selection.policy", stub)
    return asked


def small(
    episodes: int = 6, size: int = 8, n: int = 3, m: int | None = None, seed: int = 0
) -> Dataset:
    rng = np.random.default_rng(seed)
    candidates = rng.uniform(size=(episodes, size, n))
    measured = None if m is None else rng.normal(size=(episodes, size, m))
    return Dataset("small", candidates, measured)


def full_log_det(commands: np.ndarray, m: int) -> float:
    a = regression_matrix(commands, m)
    return float(np.linalg.slogdet(a.T @ a)[1])


def brute_force(dataset: Dataset, k: int) -> np.ndarray:
    """(E,) the largest log det S over every subset."""
    best = []
    for e, candidates in enumerate(dataset.candidates):
        mask = None if dataset.available is None else dataset.available[e]
        usable = range(len(candidates)) if mask is None else np.flatnonzero(mask)
        best.append(
            max(
                full_log_det(candidates[list(subset)], dataset.num_outputs)
                for subset in itertools.combinations(usable, k)
            )
        )
    return np.array(best)


@pytest.mark.parametrize(
    ("n", "m", "k"), [(3, None, 4), (2, 3, 3), (2, 1, 5), (3, 2, 5), (1, 1, 2)]
)
def test_the_reference_is_the_best_of_every_subset(
    n: int, m: int | None, k: int
) -> None:
    dataset = small(3, 7, n, m)
    found = evaluate(dataset, k, BASELINES, random_draws=20)
    best = brute_force(dataset, k)
    np.testing.assert_allclose(found.reference, best, atol=1e-8)
    assert found.proven.all()
    exact = found.summary(found.results[3])
    assert exact["ratio_to_exact"] == 1.0 and exact["hit_rate"] == 1.0
    assert exact["d_efficiency"] == 1.0


def test_every_number_is_the_one_computed_by_hand() -> None:
    dataset = small(5, 9)
    found = evaluate(dataset, 4, BASELINES, random_draws=30)
    best = brute_force(dataset, 4)
    log_dets = {
        result.method: np.array(
            [
                [
                    full_log_det(dataset.candidates[e][list(draw)], 3)
                    for draw in result.indices[e]
                ]
                for e in range(5)
            ]
        )
        for result in found.results
    }
    random = np.exp(log_dets["random"]).mean()
    for result in found.results:
        row, log_det = found.summary(result), log_dets[result.method]
        det, ratio = np.exp(log_det), np.exp(log_det - best[:, None])
        expected = {
            "ratio_to_exact": ratio.mean(),
            "d_efficiency": (ratio ** (1 / 12)).mean(),
            "hit_rate": (ratio > 1 - 1e-8).mean(),
            "ratio_to_random": det.mean() / random,
        }
        for name, value in expected.items():
            assert row[name] == pytest.approx(value, rel=1e-8), (result.method, name)
        for name, values in (("det_s", det), ("log_det_s", log_det)):
            assert row[name]["mean"] == pytest.approx(values.mean(), rel=1e-8)
            assert row[name]["std"] == pytest.approx(values.std(), rel=1e-8)
            assert row[name]["median"] == pytest.approx(np.median(values), rel=1e-8)
        assert row["draws_per_episode"] == (30 if result.method == "random" else 1)
        assert row["seconds_per_selection"] > 0


def test_a_hit_is_told_by_value_not_by_index() -> None:
    dataset = small(1, 6)
    twins = np.concatenate([dataset.candidates, dataset.candidates], axis=1)
    doubled = Dataset("twins", twins)
    found = evaluate(doubled, 4, ["exact"])
    best = found.results[0].indices[0, 0]
    other = PostureResult(
        method="greedy",
        label="greedy",
        checkpoint=None,
        indices=((best + 6) % 12)[None, None],
        values=found.results[0].values,
        seconds=1.0,
        parameters=None,
    )
    assert found.summary(other)["hit_rate"] == 1.0
    behind = np.array([[-1e-6]])
    miss = PostureResult(**{**vars(other), "values": other.values + behind})
    assert found.summary(miss)["hit_rate"] == 0.0


def test_unit_changes_nothing_but_det_s() -> None:
    dataset = small(5, 9)
    scaled = Dataset("scaled", dataset.candidates * [40, 10, 3] + [5, -7, 100])
    first = evaluate(dataset, 4, ("greedy", "exact"))
    second = evaluate(scaled, 4, ("greedy", "exact"))
    for one, two in zip(first.results, second.results, strict=True):
        a, b = first.summary(one), second.summary(two)
        for name in ("ratio_to_exact", "hit_rate", "d_efficiency", "ratio_to_random"):
            assert a[name] == pytest.approx(b[name], rel=1e-7)
        gain = b["log_det_s"]["mean"] - a["log_det_s"]["mean"]
        assert gain == pytest.approx(6 * np.log(40 * 10 * 3))


@pytest.mark.slow
def test_det_s_too_large_for_a_float_is_no_error() -> None:
    dataset = small(3, 6, 4)
    huge = Dataset("huge", dataset.candidates * 1e12)
    found = evaluate(huge, 5, BASELINES, random_draws=5)
    row = found.summary(found.results[-1])
    assert row["det_s"]["mean"] is None and row["ratio_to_exact"] == 1.0
    assert np.isfinite(row["ratio_to_random"])
    json.loads(json_document([found.summarise()], command=["x"]))
    assert "-" in text_table(found.summarise())
    for figure in evaluation_figures(found).values():
        as_bytes(figure, "svg")


def test_masked_candidates_are_never_chosen(calls: list[dict[str, Any]]) -> None:
    plain = small(6, 10)
    mask = np.random.default_rng(1).permuted(np.tile(np.arange(10) < 6, (6, 1)), axis=1)
    dataset = Dataset("masked", plain.candidates, available=mask)
    found = evaluate(dataset, 4, ("policy", *BASELINES), random_draws=40)
    for result in found.results:
        for e in range(6):
            assert mask[e][result.indices[e].ravel()].all(), result.method
    np.testing.assert_allclose(found.reference, brute_force(dataset, 4), atol=1e-8)


def test_random_draws_are_distinct_uniform_and_never_singular() -> None:
    dataset = small(2, 6)
    found = evaluate(dataset, 4, ["random"], random_draws=6000)
    indices = found.results[0].indices
    ordered = np.sort(indices, axis=2)
    assert (ordered[..., 1:] > ordered[..., :-1]).all()
    _, counts = np.unique(ordered.reshape(-1, 4), axis=0, return_counts=True)
    assert len(counts) == 15
    np.testing.assert_allclose(counts / 12_000, 1 / 15, rtol=0.15)
    grid = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(1, 8, 3) * 1.0
    corners = evaluate(Dataset("grid", grid), 4, ["random"], random_draws=500)
    assert np.isfinite(corners.random_log_det).all()
    needle = np.zeros((1, 30, 3))
    needle[0, 1:4] = np.eye(3)
    rare = evaluate(Dataset("rare", needle), 4, ["random"], random_draws=3)
    np.testing.assert_allclose(rare.random_log_det, 0.0, atol=1e-12)


def test_the_seed_decides_random() -> None:
    dataset = small()
    first, again, other = (
        evaluate(dataset, 4, ["random"], seed=seed).random_log_det for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_policies_have_a_row_for_each_decoding_and_checkpoint(
    calls: list[dict[str, Any]],
) -> None:
    methods = (*POLICIES, "exact")
    found = evaluate(small(), 4, methods, ["runs/a", None], num=8, seed=3)
    assert [(r.method, r.checkpoint) for r in found.results] == [
        (method, checkpoint)
        for method in (
            "policy",
            "policy:samples",
            "policy:first",
            "policy:exchange",
        )
        for checkpoint in ("runs/a", None)
    ] + [("exact", None)]
    assert found.results[2].label == "policy best of 8 samples"
    assert found.results[4].label == "policy best of 8 first picks"
    assert found.results[6].label == "policy + exchange"
    decodings = {(c["decoding"], c["checkpoint"]) for c in calls}
    assert len(decodings) == 8
    assert {"greedy", "samples", "first", "exchange"} == {d for d, _ in decodings}
    assert all(c["num"] == 8 and c["k"] == 4 for c in calls)
    np.testing.assert_array_equal(
        found.results[0].indices[:, 0], np.tile([7, 6, 5, 4], (6, 1))
    )


def test_policies_choose_in_pieces_with_seeds_of_their_own(
    calls: list[dict[str, Any]],
) -> None:
    found = evaluate(small(620, 6), 4, ["policy"], seed=7)
    warm, *pieces = [(c["shape"][0], c["seed"]) for c in calls]
    assert warm == (250, 7)  # a first call that may compile and is not timed
    assert pieces == [(250, 7), (250, 257), (120, 507)]
    assert found.results[0].indices.shape == (620, 1, 4)


@pytest.mark.parametrize(
    "chosen", [[0, 0, 1, 2], [0, 1, 2, 8], [-1, 0, 1, 2], [0, 1, 2]]
)
def test_a_policy_that_returns_nonsense_is_caught(
    monkeypatch: pytest.MonkeyPatch, chosen: list[int]
) -> None:
    stub = types.ModuleType("jaxcal.selection.policy")
    stub.select_batch = (  # type: ignore[attr-defined]  # a module made here
        lambda candidates, **_: np.tile(chosen, (len(candidates), 1))
    )
    monkeypatch.setitem(sys.modules, "jaxcal.selection.policy", stub)
    with pytest.raises(ValueError, match=r"policy must (choose 4 different|return)"):
        evaluate(small(), 4, ["policy"])


def test_what_cannot_be_proven_in_time_is_bounded() -> None:
    dataset = make_dataset("dataset2", episodes=6)
    found = evaluate(dataset, 12, ("greedy", "exact"), time_limit=1e-3)
    truth = evaluate(dataset, 12, ["exact"])
    assert (found.reference >= truth.reference - 1e-9).all()
    if not found.proven.all():
        assert "not proven" in text_table(found.summarise())
        for result in found.results:
            row = found.summary(result)
            assert row["hit_rate"] <= found.proven.mean()
            assert row["ratio_to_exact"] <= 1.0


@pytest.mark.parametrize(("n", "m", "k"), [(3, 3, 4), (3, 3, 7), (2, 4, 3), (1, 2, 3)])
def test_parameters_are_those_of_lstsq(n: int, m: int, k: int) -> None:
    dataset = small(3, 9, n, m)
    indices = np.stack(
        [
            np.random.default_rng(e).permuted(np.tile(np.arange(9), (2, 1)), axis=1)
            for e in range(3)
        ]
    )[..., :k]
    found = estimate_parameters(dataset, indices)
    assert found is not None and found.shape == (3, 2, m * (n + 1))
    assert len(Affine(n, m).names) == m * (n + 1)
    assert dataset.measured is not None
    for e, r in itertools.product(range(3), range(2)):
        rows = regression_matrix(dataset.candidates[e, indices[e, r]], m)
        expected = np.linalg.lstsq(
            rows, dataset.measured[e, indices[e, r]].ravel(), rcond=None
        )[0]
        np.testing.assert_allclose(found[e, r], expected, rtol=1e-6, atol=1e-7)


def test_dataset_3_gives_table_1_back_in_degrees() -> None:
    found = evaluate(make_dataset("dataset3"), 4, ("random", "exact"))
    random, exact = found.results
    assert exact.parameters is not None
    mean = exact.parameters[:, 0].mean(axis=0)
    np.testing.assert_allclose(mean[[0, 4, 8]], [0.43, 0.71, 0.87], atol=2e-3)
    np.testing.assert_allclose(mean[9:], [3.1, -5.8, 2.41], atol=0.03)
    one, other = (
        np.array(found.summary(result)["parameter_variance"])
        for result in (exact, random)
    )
    np.testing.assert_allclose(one, exact.parameters[:, 0].var(axis=0), rtol=1e-12)
    assert (other > 20 * one).all()


def test_methods_are_checked() -> None:
    assert check_methods(["exact", "policy", "exact"]) == ("exact", "policy")
    with pytest.raises(ValueError, match=r"one of policy, .* got 'best'"):
        check_methods(["best"])
    with pytest.raises(ValueError, match="at least one method"):
        check_methods([])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"k": 3}, "small: k must be at least 4"),
        ({"k": 9}, "small: in set 0: k must not exceed .* available"),
        ({"num": 0}, "num must be at least 1, got 0"),
        ({"random_draws": 0}, "random_draws must be at least 1, got 0"),
    ],
)
def test_bad_arguments_are_named(change: dict[str, int], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        evaluate(small(), **change)  # type: ignore[arg-type]  # bad on purpose


def test_a_flat_episode_is_named() -> None:
    dataset = small()
    dataset.candidates[4, :, 1] = 0.5
    with pytest.raises(ValueError, match=r"small: in set 4: .* lie in one plane"):
        evaluate(dataset, 4, ["greedy"])


# -- what is shown ---------------------------------------------------------------------


@pytest.fixture
def shown(calls: list[dict[str, Any]]) -> PostureEvaluation:
    dataset = make_dataset("dataset3", episodes=12)
    return evaluate(dataset, 4, ("policy", *BASELINES), ["runs/a", "runs/b"])


def test_the_table_has_a_row_for_each_method(shown: PostureEvaluation) -> None:
    text = text_table(shown.summarise())
    assert "policy (runs/a)" in text and "policy (runs/b)" in text
    for method in BASELINES:
        assert f"\n  {method}" in text
    assert "12 parameters with as many equations" in text
    line = next(line for line in text.splitlines() if line.startswith("  exact"))
    assert line.split()[3:6] == ["1.0000", "1.0000", "1.0000"]


def test_the_json_has_an_entry_for_each_checkpoint(shown: PostureEvaluation) -> None:
    document = json.loads(json_document([shown.summarise(indices=True)], command=["x"]))
    assert document["format"] == "jaxcal-evaluation" and document["version"] == 1
    assert {"python", "numpy", "jaxcal"} <= set(document["versions"])
    assert [entry["checkpoint"] for entry in document["results"]] == [
        "runs/a",
        "runs/b",
    ]
    for entry in document["results"]:
        assert set(entry["methods"]) == {"policy", *BASELINES}
        assert entry["dataset"]["episodes"] == 12 and entry["k"] == 4
        assert len(entry["parameter_names"]) == 12
        assert np.shape(entry["methods"]["exact"]["indices"]) == (12, 4)


@pytest.mark.slow
def test_figures_have_axes_units_and_legends(shown: PostureEvaluation) -> None:
    drawn = evaluation_figures(shown)
    assert set(drawn) == {"det_means", "gap_to_optimum"}
    for draw in (det_per_episode, det_distributions, best_so_far):
        drawn[draw.__name__] = draw(shown)
    for name, figure in drawn.items():
        axes = figure.axes[0]
        assert axes.get_title() or figure.get_suptitle(), name
        assert axes.get_xlabel(), name
        named = axes.get_legend() is not None or figure.legends
        has_names = named or len(axes.get_yticklabels()) > 2
        assert has_names, name
        assert texts_outside(figure) == [], name
    assert as_bytes(figure, "png").startswith(b"\x89PNG")
    assert b"<svg" in as_bytes(figure, "svg")


def test_the_page_holds_everything_in_itself(
    shown: PostureEvaluation, tmp_path: pathlib.Path
) -> None:
    metrics(tmp_path)
    one = {"det_means": figures.det_means(shown)}  # the command's test draws all
    out = tmp_path / "deep" / "report"
    curves = {"training_curves": training_curves({"run": tmp_path})}
    number = write_report(out, [shown], lambda _: one, curves, command=["a", "<b>"])
    page = (out / "index.html").read_text()
    images = sorted(path.name for path in out.glob("*.svg"))
    assert page.count("data:image/svg+xml;base64,") == len(images) == number == 2
    assert "&lt;b&gt;" in page and "policy (runs/a)" in page
    assert not re.search(r"(href|src)=['\"]?(https?:)?//", page)


def test_two_files_of_one_name_keep_their_figures_apart() -> None:
    assert file_prefixes(["a/d.csv", "x", "b/d.npz"]) == ["d-1", "x", "d-3"]


def texts_outside(figure: Figure) -> list[str]:
    """Texts that the PNG cuts off, in the layout it is drawn in."""
    as_bytes(figure, "png")
    figure.set_layout_engine("none")  # keep that layout
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    ticks = {
        id(label)
        for axes in figure.axes
        for axis, (low, high) in (
            (axes.xaxis, sorted(axes.get_xlim())),
            (axes.yaxis, sorted(axes.get_ylim())),
        )
        for tick in axis.get_major_ticks()
        if not low <= tick.get_loc() <= high  # not drawn
        for label in (tick.label1, tick.label2)
    }
    found = []
    for text in figure.findobj(Text):
        if text.get_visible() and text.get_text().strip() and id(text) not in ticks:
            box = text.get_window_extent(canvas.get_renderer())
            least, most = figure.bbox.extents[:2], figure.bbox.extents[2:]
            if (box.min < least).any() or (box.max > most).any():
                found.append(text.get_text())
    return found


def metrics(folder: pathlib.Path, updates: int = 30) -> None:
    lines = ["update,episodes,seconds,reward_mean,reward_std,ratio_to_exact"]
    for u in range(1, updates + 1):
        ratio = "" if u % 3 else f"{1 - 1 / u}"
        lines.append(f"{u},{u * 16},{u * 0.1},{-1 / u},{0.1},{ratio}")
    (folder / "metrics.csv").write_text("\n".join(lines) + "\n")


@pytest.mark.slow
@pytest.mark.parametrize("updates", [1, 2, 30])
def test_training_panels_are_the_papers_three_panels(
    tmp_path: pathlib.Path, updates: int
) -> None:
    metrics(tmp_path, updates)
    figure = training_panels({"run": tmp_path})
    titles = [axes.get_title() for axes in figure.axes]
    assert titles[0].startswith("(a)") and titles[2].startswith("(c)")
    assert "updates" in titles[1]
    rewards = np.random.default_rng(0).normal(size=1500).astype(np.float32)
    np.save(tmp_path / "last_rewards.npy", rewards)
    figure = training_panels({"run": tmp_path})
    assert "last 1,000 episodes" in figure.axes[1].get_title()
    figure.suptitle("Training of the paper's network", fontsize=10)
    assert texts_outside(figure) == []


def test_labels_of_a_long_run_are_not_cut_off(tmp_path: pathlib.Path) -> None:
    # Its ticks change when the first layout gives the axes their size.
    u = np.arange(1, 400)
    rng = np.random.default_rng(0)
    reward = -3.0 * np.exp(-u / 5) - 0.25 + 0.1 * rng.normal(size=len(u))
    lines = ["episodes,reward_mean,reward_std,ratio_to_exact"]
    lines += [f"{500 * i},{r},0.3,0.5" for i, r in zip(u, reward, strict=True)]
    (tmp_path / "metrics.csv").write_text("\n".join(lines) + "\n")
    np.save(tmp_path / "last_rewards.npy", rng.normal(-0.25, 0.26, size=1000))
    for draw in (training_panels, training_curves):
        figure = draw({"run": tmp_path})
        figure.suptitle("Training of the paper's network", fontsize=10)
        assert texts_outside(figure) == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the table is empty"),
        ("episodes,reward_mean\n", "no rows below the header"),
        ("episodes,reward\n1,2\n", "there is no column 'reward_mean'"),
        ("episodes,reward_mean\n1,2\n3\n", "line 3 has 1 cells, the first has 2"),
        ("episodes,reward_mean\n1,x\n", "line 2, column 'reward_mean' .* got 'x'"),
    ],
)
def test_bad_metrics_are_named(tmp_path: pathlib.Path, text: str, message: str) -> None:
    (tmp_path / "metrics.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        training_curves({"run": tmp_path})
