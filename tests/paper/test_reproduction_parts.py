"""Intervals, the training section and verdicts, on cases whose answer is known."""

from __future__ import annotations

import json
import pathlib

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray
from scipy import stats

from benchmarks.paper.csv_text import csv_text
from benchmarks.paper.exhibits.devices import Device
from benchmarks.paper.exhibits.intervals import (
    bootstrap_interval,
    mean_interval,
    median_interval,
    ratio_interval,
    share_interval,
)
from benchmarks.paper.exhibits.study import Settings, Study, predict
from benchmarks.paper.exhibits.training import exhibits, kept_runs, plateau
from benchmarks.paper.exhibits.variance import variance_table
from jaxcal.calibration.identify import identify
from jaxcal.evaluation.methods import least_squares
from jaxcal.reports.plots import as_bytes

Array = NDArray[np.float64]


def test_mean_interval_is_students(rng: np.random.Generator) -> None:
    sample = rng.normal(3.0, 2.0, 17)
    low, high = stats.t.interval(0.95, 16, loc=sample.mean(), scale=stats.sem(sample))
    found = mean_interval(sample)
    assert (found.low, found.high) == pytest.approx((low, high))
    assert found.n == 17 and mean_interval(sample, upper_limit=3.1).high <= 3.1


@pytest.mark.parametrize(("hits", "count"), [(0, 20), (7, 20), (20, 20)])
def test_share_interval_is_wilsons(hits: int, count: int) -> None:
    expected = stats.binomtest(hits, count).proportion_ci(method="wilson")
    found = share_interval(np.arange(count) < hits)
    assert found.value == hits / count
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high))


@pytest.mark.parametrize("count", [6, 7, 25, 100, 501])
def test_median_interval_is_the_narrowest_that_covers(
    count: int, rng: np.random.Generator
) -> None:
    found = median_interval(rng.permutation(count))
    below = int(found.low)  # values outside it, on either side
    assert found.value == (count - 1) / 2 and found.high == count - 1 - below
    # It misses the median where so few of the values lie on one side of it.
    assert 2 * stats.binom.cdf(below, count, 0.5) <= 0.05
    assert 2 * stats.binom.cdf(below + 1, count, 0.5) > 0.05


def test_median_interval_covers(rng: np.random.Generator) -> None:
    samples = rng.standard_cauchy((400, 25))
    found = [median_interval(sample) for sample in samples]
    share = np.mean([interval.low <= 0.0 <= interval.high for interval in found])
    # Order statistics cover at least 95 %, and not much more.
    assert 0.95 - 4 * np.sqrt(0.05 * 0.95 / 400) < share < 0.99


def test_bootstrap_of_a_mean_is_near_the_normal_one(rng: np.random.Generator) -> None:
    sample = rng.normal(size=400)
    found = bootstrap_interval(np.mean, (sample,), rng, 4_000)
    assert found.value == sample.mean()
    width = 2 * 1.96 * sample.std() / np.sqrt(400)
    assert found.high - found.low == pytest.approx(width, rel=0.1)


def test_pairing_uses_the_same_episodes(rng: np.random.Generator) -> None:
    b = np.exp(rng.normal(0.0, 2.0, 200))
    for of in (np.mean, np.median):
        ratio = ratio_interval(of, 0.5 * b, b, rng, 200)
        assert (ratio.low, ratio.high) == pytest.approx((0.5, 0.5))
    with pytest.raises(ValueError, match="same episodes"):
        ratio_interval(np.mean, b, b[1:], rng)


def test_variance_table_against_plain_numpy(rng: np.random.Generator) -> None:
    parameters = {
        "policy": rng.normal(size=(300, 1, 12)),
        "all": 0.5 * rng.normal(size=(300, 1, 12)),
        "random": 3.0 * rng.normal(size=(300, 40, 12)),
    }
    found = variance_table(parameters, rng, 500)
    for method, sample in parameters.items():
        expected = np.median(sample.var(axis=0), axis=0)
        np.testing.assert_allclose(found[method][0], expected)
        low, high = found[method][1:]
        assert (low < expected).all() and (expected < high).all()
    # The variance of 300 normals has a relative standard error of sqrt(2 / 299).
    width = (found["policy"][2] - found["policy"][1]) / found["policy"][0]
    np.testing.assert_allclose(width, 2 * 1.96 * np.sqrt(2 / 299), rtol=0.35)
    low, high = found["all/policy"][1:]
    assert (low < 0.25).sum() >= 10 and (high > 0.25).sum() >= 10


def test_least_squares_and_predict_are_identify(rng: np.random.Generator) -> None:
    u, y = rng.normal(size=(2, 5, 9, 3)), None
    y = rng.normal(size=(2, 5, 9, 2))
    found = least_squares(u, y)
    assert found.shape == (2, 5, 8)
    single = identify(u[1, 3], y[1, 3])
    np.testing.assert_allclose(found[1, 3], single.parameters, rtol=1e-9)
    np.testing.assert_allclose(
        predict(found, u)[1, 3], single.predict(u[1, 3]), rtol=1e-9
    )


def test_a_device_drifts_as_a_random_walk(rng: np.random.Generator) -> None:
    device = Device(noise_std_deg=0.0, drift_std_deg=0.1)
    commands = np.zeros((4_000, 9, 3))
    measured, off = device.record(commands, rng)
    still = measured - device.true_outputs(commands)
    np.testing.assert_allclose(still[:, -1], off, rtol=0.0, atol=1e-12)
    spread = still.std(axis=(0, 2))
    np.testing.assert_allclose(spread, 0.1 * np.sqrt(np.arange(1, 10)), rtol=0.04)
    clean, _ = Device(0.0).record(commands + 1.0, rng)
    expected = [0.43 + 3.1, 0.71 - 5.8, 0.87 + 2.41]
    np.testing.assert_allclose(clean[0, 0], expected, rtol=1e-12)


def test_csv_keeps_twelve_digits_and_refuses_ragged_columns() -> None:
    text = csv_text({"a": np.array([1 / 3, np.nan]), "b": ["x", 2]})
    assert text == "a,b\n0.333333333333,x\n,2\n"
    with pytest.raises(ValueError):
        csv_text({"a": [1.0], "b": [1.0, 2.0]})


def test_recordings_can_be_given(tmp_path: pathlib.Path) -> None:
    rng = np.random.default_rng(5)
    for name, count in (("dataset4", 5_000), ("dataset5", 60)):
        u = rng.uniform(-20.0, 20.0, (count, 3))
        y = u @ np.diag([0.5, 0.6, 0.7]) + [1.0, 2.0, 3.0]
        header = ",".join(
            f"{w}_deg_{a}" for w in "uy" for a in ("pitch", "yaw", "roll")
        )
        rows = [",".join(map(repr, row)) for row in np.hstack([u, y]).tolist()]
        (tmp_path / f"{name}.csv").write_text("\n".join([header, *rows]) + "\n")
    given = Study(Settings(data=tmp_path))
    found = given.parameters("dataset4", "all 50")[:, 0]
    assert found.shape == (100, 12)
    expected = [0.5, 0, 0, 0, 0.6, 0, 0, 0, 0.7, 1, 2, 3]
    np.testing.assert_allclose(found, np.tile(expected, (100, 1)), atol=1e-9)
    assert given.about_overlap("dataset4") == ""  # 5,000 are used as they stand
    assert str(tmp_path) in given.settings.about_recordings
    assert "500 postures" in Study(Settings()).about_overlap("dataset4")


# -- training --------------------------------------------------------------------------


def _keep(
    folder: pathlib.Path,
    seed: int,
    level: float,
    finished: bool = True,
    *,
    slowness: float = 10_000.0,
    every: int = 2_000,
) -> None:
    """A run of 100 updates that rises from -0.6 to ``level``, exponentially."""
    folder.mkdir(parents=True)
    episodes = np.arange(1, 101) * every
    total = int(episodes[-1])
    reward = level - (level + 0.6) * np.exp(-episodes / slowness)
    lines = ["episodes,seconds,reward_mean,reward_std,ratio_to_exact"]
    for count, value in zip(episodes, reward, strict=True):
        lines.append(f"{count},{count / 1000},{value},0.1,0.9")
    (folder / "metrics.csv").write_text("\n".join(lines) + "\n")
    np.save(folder / "last_rewards.npy", np.full(1_000, level) + seed / 100)
    summary = {
        "seed": seed,
        "episodes": total,
        "planned_episodes": total if finished else 2 * total,
        "seconds": 200.0,
        "parameters": 7,
        "versions": {"jaxcal": "0.2.0", "jax": "0.11.1"},
        "dataset2": {"episodes": 1000, "ratio_to_exact": 0.99, "hit_rate": 0.9},
    }
    (folder / "summary.json").write_text(json.dumps(summary))


def _shown(studies: pathlib.Path) -> dict[str, object]:
    found = exhibits(Study(Settings(studies=studies)))
    return {exhibit.key: exhibit for exhibit in found}


@pytest.mark.slow
def test_no_label_of_figure_2_is_cut_off() -> None:
    figures = [f for e in exhibits(Study(Settings())) for f in e.figures.items()]
    assert [name for name, _ in figures] == ["figure_2_seeds", "figure_2_paper"]
    for name, figure in figures:
        as_bytes(figure, "svg")  # the first drawing of a new figure, as in the report
        inside = figure.get_tightbbox(FigureCanvasAgg(figure).get_renderer())
        width, height = figure.get_size_inches()
        assert 0 <= inside.x0 and inside.x1 <= width, name
        assert 0 <= inside.y0 and inside.y1 <= height, name


def test_plateau_of_an_exponential(tmp_path: pathlib.Path) -> None:
    _keep(tmp_path / "seed_3", 3, -0.1)
    flat = plateau(kept_runs(tmp_path)[0])
    # 5 % is left after three time constants, a little later with the average of five.
    assert 28_000 <= flat["episode"] <= 38_000
    assert flat["final_reward"] == pytest.approx(-0.1, abs=1e-6)
    assert abs(flat["last_tenth"]) < 1e-6


def test_seeds_have_students_intervals(tmp_path: pathlib.Path) -> None:
    levels = {0: -0.10, 1: -0.12, 10: -0.14}
    for seed, level in levels.items():
        _keep(tmp_path / "compact_seeds" / f"seed_{seed}", seed, level)
    found = _shown(tmp_path)["figure_2"]
    assert found.verdict == "agrees" and set(found.figures) == {"figure_2_seeds"}
    assert "reward_seed_10" in found.data["reward"]
    means = [level + seed / 100 for seed, level in levels.items()]
    half = stats.t.ppf(0.975, 2) * stats.sem(means)
    reported = found.numbers["last_1000_reward_mean"]
    assert reported.value == pytest.approx(np.mean(means)) and reported.n == 3
    assert reported.low == pytest.approx(np.mean(means) - half)


def test_the_paper_run_says_how_far_it_went(tmp_path: pathlib.Path) -> None:
    _keep(tmp_path / "done" / "paper_seeds" / "seed_0", 0, -0.1)
    found = _shown(tmp_path / "done")["figure_2_paper"]
    assert found.verdict == "agrees" and "200,000 of 200,000" in found.ours
    _keep(tmp_path / "part" / "paper_seeds" / "seed_0", 0, -0.1, finished=False)
    found = _shown(tmp_path / "part")["figure_2_paper"]
    assert found.verdict == "not comparable" and "not finished" in found.ours


@pytest.mark.parametrize(
    ("run", "verdict"),
    [
        ({}, "agrees"),
        ({"finished": False}, "not comparable"),
        ({"every": 100, "slowness": 1_000.0}, "not comparable"),  # 10,000 episodes
        ({"every": 8_000, "slowness": 90_000.0}, "disagrees"),  # flat, but later
        ({"slowness": 80_000.0}, "agrees in part"),  # still rising at 200,000
        ({"level": -0.9}, "disagrees"),  # falls
    ],
)
def test_a_run_converges_within_the_paper_s_episodes_or_not(
    tmp_path: pathlib.Path, run: dict[str, float], verdict: str
) -> None:
    values = {"level": -0.1} | run
    for place in ("paper_seeds/seed_0", "compact_seeds/seed_0", "compact_seeds/seed_1"):
        _keep(tmp_path / place, int(place[-1] == "1"), **values)
    found = _shown(tmp_path)
    assert [found[key].verdict for key in ("figure_2", "figure_2_paper")] == [
        verdict,
        verdict,
    ]
    seeds = found["figure_2"].ours
    assert ("not finished" in seeds) == (not values.get("finished", True))
    assert ("shorter than 200,000" in seeds) == (values.get("every") == 100)


def test_a_torn_summary_is_named(tmp_path: pathlib.Path) -> None:
    run = tmp_path / "paper_seeds" / "seed_0"
    _keep(run, 0, -0.1)
    (run / "summary.json").write_text('{"seed": 0')
    with pytest.raises(ValueError, match=r"summary\.json is not the summary"):
        _shown(tmp_path)
