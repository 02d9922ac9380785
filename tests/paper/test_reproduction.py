"""The report from end to end: its numbers again from its CSV files, by other means."""

from __future__ import annotations

import csv
import itertools
import json
import pathlib
import re
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import stats
from scipy.spatial.transform import Rotation

from benchmarks.paper.datasets import BIAS_DEG, SCALE, make_dataset, write_datasets
from benchmarks.paper.reproduce import main

ROOT = pathlib.Path(__file__).parents[2]

pytestmark = pytest.mark.slow  # one report for all; its parts are tested quickly too


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "benchmarks.paper", *map(str, arguments)],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    folder = tmp_path_factory.mktemp("report")
    empty = folder / "no_studies"
    empty.mkdir()
    done = run("--quick", "--quiet", "--studies", empty, "--out", folder / "report")
    assert done.returncode == 0, done.stderr
    assert done.stderr == "" and "saved:" in done.stdout
    return folder / "report"


@pytest.fixture(scope="module")
def document(report: pathlib.Path) -> dict[str, Any]:
    return json.loads((report / "reproduction.json").read_text())


def table(report: pathlib.Path, name: str) -> dict[str, np.ndarray]:
    return columns_of(report / "data" / f"{name}.csv")


def columns_of(path: pathlib.Path) -> dict[str, np.ndarray]:
    with path.open(newline="") as file:
        header, *rows = csv.reader(file)
    columns: dict[str, np.ndarray] = {}
    for name_of, cells in zip(header, zip(*rows, strict=True), strict=True):
        try:
            columns[name_of] = np.array([float(c) if c else np.nan for c in cells])
        except ValueError:
            columns[name_of] = np.array(cells)
    return columns


def numbers(document: dict[str, Any], key: str) -> dict[str, Any]:
    return document["exhibits"][key]["numbers"]


def test_every_figure_of_the_paper_is_there(
    report: pathlib.Path, document: dict[str, Any]
) -> None:
    keys = set(document["exhibits"])
    assert {f"figure_{i}" for i in range(1, 11)} <= keys
    assert {"table_1", "table_2", "table_3", "gap_to_optimum"} <= keys
    assert {"number_of_postures", "euler_orders", "four_or_fifty"} <= keys
    figures = [f for e in document["exhibits"].values() for f in e["figures"]]
    assert len(figures) == len(set(figures)) >= 20
    on_disk = {path.name for path in (report / "figures").iterdir()}
    expected = {f"{f}.{kind}" for f in figures for kind in ("png", "svg")}
    assert on_disk == expected
    tables = {name for e in document["exhibits"].values() for name in e["data"]}
    assert tables == {path.name for path in (report / "data").iterdir()}


def test_every_exhibit_says_which_policy_it_shows_and_how_it_was_trained(
    report: pathlib.Path, document: dict[str, Any]
) -> None:
    told = {key: each["policy"] for key, each in document["exhibits"].items()}
    for key in (
        "figure_3",
        "figure_4",
        "figure_7",
        "figure_8",
        "figure_9",
        "figure_10",
    ):
        assert "paper.npz" in told[key] and "PPO alone" in told[key], key
    assert "imitation" in told["figure_3"] and told["robot"] == "Policy: none."
    chosen = table(report, "figure_3_log_det_s")  # two policies, not one twice
    assert (chosen["log_det_s_policy"] != chosen["log_det_s_default"]).any()


def test_the_page_is_one_file_that_opens_offline(
    report: pathlib.Path, document: dict[str, Any]
) -> None:
    page = (report / "index.html").read_text()
    figures = [f for e in document["exhibits"].values() for f in e["figures"]]
    assert page.count('src="data:image/svg+xml;base64,') == len(figures)
    assert page.count("src=") == len(figures) and "<script" not in page
    assert not re.search(r"(href|src)=['\"](https?:)?//", page)
    assert "@media print" in page
    for claim in document["claims"]:
        assert f">{claim['verdict']}</span>" in page
    for key in document["exhibits"]:
        assert f'id="{key}"' in page
    for link in re.findall(r'href="#([^"]+)"', page):
        assert f'id="{link}"' in page
    for link in re.findall(r'href="((?:data|figures)/[^"]+)"', page):
        assert (report / link).is_file()


def test_no_figure_is_cut_off_at_its_edges(
    report: pathlib.Path, document: dict[str, Any]
) -> None:
    for exhibit in document["exhibits"].values():
        for name in exhibit["figures"]:
            with Image.open(report / "figures" / f"{name}.png") as image:
                drawn = np.asarray(image.convert("L")) < 250
            edges = (drawn[0], drawn[-1], drawn[:, 0], drawn[:, -1])
            assert not any(edge.any() for edge in edges), name


def test_mujoco_and_the_closed_form_agree(document: dict[str, Any]) -> None:
    assert numbers(document, "robot")["largest_difference_deg"] < 1e-6


def test_the_ratios_of_figure_3_are_those_of_its_data(
    report: pathlib.Path, document: dict[str, Any]
) -> None:
    chosen = table(report, "figure_3_log_det_s")
    random = np.stack(list(table(report, "figure_3_random_log_det_s").values()), 1)
    assert random.shape == (200, 30)
    found = numbers(document, "figure_3")
    for method in ("policy", "greedy", "exact"):
        det = np.exp(chosen[f"log_det_s_{method}"])
        times = found[method]["times_random"]
        assert times["value"] == pytest.approx(det.mean() / np.exp(random).mean())
        assert times["low"] < times["value"] < times["high"] and times["n"] == 200
        ratio = np.exp(chosen[f"log_det_s_{method}"] - chosen["log_det_s_optimum"])
        mean = found[method]["ratio_to_exact"]
        assert mean["value"] == pytest.approx(ratio.mean(), rel=1e-8)
        half = stats.t.ppf(0.975, 199) * stats.sem(ratio)
        assert mean["low"] == pytest.approx(ratio.mean() - half, rel=1e-8)
        share = (ratio > 1 - 1e-8).mean()
        assert found[method]["hit_rate"]["value"] == pytest.approx(share)
    spread = found["policy_over_random_std_log_det_s"]["value"]
    expected = chosen["log_det_s_policy"].std() / random.std()
    assert spread == pytest.approx(expected)


def test_the_optimum_is_that_of_all_230300_subsets(report: pathlib.Path) -> None:
    chosen = table(report, "figure_3_log_det_s")
    candidates = make_dataset("dataset2", 0, 2).candidates
    subsets = np.array(list(itertools.combinations(range(50), 4)))
    for episode in range(2):
        z = np.concatenate([candidates[episode], np.ones((50, 1))], axis=1)
        best = 6.0 * np.log(np.abs(np.linalg.det(z[subsets])).max())
        assert chosen["log_det_s_exact"][episode] == pytest.approx(best, abs=1e-9)


def test_the_parameters_of_all_fifty_are_those_of_lstsq(report: pathlib.Path) -> None:
    kept = table(report, "figure_5_parameters")
    rows = kept["method"] == "all 50"
    found = np.stack([kept[name] for name in list(kept)[3:]], axis=1)[rows]
    data = make_dataset("dataset3")
    assert data.measured is not None
    for episode in range(0, 100, 17):
        u = data.candidates[episode] * 40.0 - 20.0
        z = np.concatenate([u, np.ones((50, 1))], axis=1)
        fit = np.linalg.lstsq(z, data.measured[episode], rcond=None)[0]
        expected = np.concatenate([fit[:3].T.ravel(), fit[3]])
        np.testing.assert_allclose(found[episode], expected, rtol=1e-8, atol=1e-9)


def test_variances_and_their_ratios_are_those_of_the_parameters(
    report: pathlib.Path, document: dict[str, Any]
) -> None:
    for key in ("figure_5", "figure_9"):
        kept = table(report, f"{key}_parameters")
        names = list(kept)[3:]
        values = np.stack([kept[name] for name in names], axis=1)

        def of(method: str, kept: Any = kept, values: Any = values) -> np.ndarray:
            rows = values[kept["method"] == method]
            draws = int(kept["draw"][kept["method"] == method].max())
            return np.median(rows.reshape(100, draws, 12).var(axis=0), axis=0)

        found = numbers(document, key)
        for method in ("policy", "random", "all 50"):
            np.testing.assert_allclose(
                found[method]["value"], of(method), rtol=1e-6, err_msg=method
            )
        ratio = of("random") / of("policy")
        np.testing.assert_allclose(found["random/policy"]["value"], ratio, rtol=1e-6)


def test_best_so_far_never_falls_and_ends_at_the_maximum(report: pathlib.Path) -> None:
    best = table(report, "figure_8_best_so_far")
    every = table(report, "figure_7_log_det_s")
    for method in ("policy", "greedy", "exact"):
        curve = best[f"best_log_det_s_{method}"]
        assert (np.diff(curve) >= 0).all()
        assert curve[-1] == pytest.approx(every[f"log_det_s_{method}"].max())


def test_four_against_fifty_from_the_devices_one_by_one(
    report: pathlib.Path, document: dict[str, Any]
) -> None:
    kept = table(report, "four_or_fifty_four_or_fifty")
    found = numbers(document, "four_or_fifty")
    main = (("white noise", 0.1), ("drift", 0.05), ("outliers", 0.05))
    for scenario, strength in main:
        keep = (kept["scenario"] == scenario) & (kept["strength"] == strength)
        four, fifty = kept["rms_four_deg"][keep], kept["rms_fifty_deg"][keep]
        entry = found[scenario]
        ratio = entry["ratio_of_means"]["value"]
        assert ratio == pytest.approx(four.mean() / fifty.mean())
        share = (four < fifty).mean()
        assert entry["four_better"]["value"] == pytest.approx(share)
        exact = stats.binomtest(int((four < fifty).sum()), len(four))
        interval = exact.proportion_ci(method="wilson")
        assert entry["four_better"]["low"] == pytest.approx(interval.low, abs=1e-9)
        assert entry["four_better"]["high"] == pytest.approx(interval.high, abs=1e-9)
    # The leverages of a fit sum to the number of regressors, whatever the postures.
    variance = found["mean_prediction_variance"]
    assert variance["fifty"]["value"] == pytest.approx(4 / 50, rel=1e-9)


def test_white_noise_agrees_with_theory_at_every_number_of_postures(
    report: pathlib.Path,
) -> None:
    kept = table(report, "number_of_postures_number_of_postures")
    white = kept["scenario"] == "white noise"
    # Of 100 devices x 3 axes x at least 4 degrees of freedom: 6 standard errors.
    ratio = kept["root_mean_square_deg"][white] / kept["theory_deg"][white]
    optimal = kept["choice"][white] == "D-optimal"
    assert (np.abs(ratio[optimal] - 1.0) < 6.0 / np.sqrt(2 * 100 * 12)).all()
    at_50 = kept["theory_deg"][white & (kept["K"] == 50)]
    np.testing.assert_allclose(at_50, 0.1 * np.sqrt(4 / 50), rtol=1e-9)


@pytest.fixture(scope="module")
def groups(tmp_path_factory: pytest.TempPathFactory) -> tuple[np.ndarray, np.ndarray]:
    """Commands and measured angles of dataset0, (40, 50, 3) degrees, from its CSV."""
    folder = tmp_path_factory.mktemp("datasets")
    write_datasets(folder, ["dataset0"], episodes=40, formats=("csv",))
    held = columns_of(folder / "dataset0.csv")
    u, y = (
        np.stack([held[f"{what}_{axis}"] for axis in "xyz"], axis=1).reshape(40, 50, 3)
        for what in "uy"
    )
    return u * 40.0 - 20.0, y


def test_table_1_and_its_intervals_are_those_of_lstsq(
    report: pathlib.Path,
    document: dict[str, Any],
    groups: tuple[np.ndarray, np.ndarray],
) -> None:
    kept = table(report, "table_1_table_1")
    u, y = (values.reshape(-1, 3) for values in groups)
    z = np.concatenate([u, np.ones((len(u), 1))], axis=1)
    fit, square, _, _ = np.linalg.lstsq(z, y, rcond=None)
    expected = np.concatenate([fit[:3].T.ravel(), fit[3]])
    np.testing.assert_allclose(kept["identified"], expected, atol=1e-9)
    truth = np.concatenate([np.diag(SCALE).ravel(), BIAS_DEG])
    np.testing.assert_array_equal(kept["set"], truth)
    free = len(u) - 4
    error = np.sqrt(np.outer(square / free, np.diag(np.linalg.inv(z.T @ z))))
    half = stats.t.ppf(1.0 - 0.05 / 24, free) * np.append(error[:, :3], error[:, 3])
    np.testing.assert_allclose(kept["low"], expected - half, atol=1e-9)
    np.testing.assert_allclose(kept["high"], expected + half, atol=1e-9)
    inside = (kept["low"] <= truth) & (truth <= kept["high"])
    assert numbers(document, "table_1")["inside"] == inside.sum() == 12


def test_the_errors_of_figure_1_are_those_of_dataset0(
    report: pathlib.Path,
    document: dict[str, Any],
    groups: tuple[np.ndarray, np.ndarray],
) -> None:
    kept, found = table(report, "figure_1_errors"), numbers(document, "figure_1")
    u, y = groups
    z = np.concatenate([u, np.ones((40, 50, 1))], axis=2)
    fits = [np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(z, y, strict=True)]
    after = np.stack([y[g] - z[g] @ fits[g - 1] for g in range(40)])
    for axis, label in enumerate(("pitch", "yaw", "roll")):
        for when, errors in (("before", y - u), ("after", after)):
            expected = errors[..., axis].ravel()
            held = kept[f"{label}_{when}_deg"]
            np.testing.assert_allclose(held, expected, atol=1e-9)
            box = found[f"{label}_{when}"]
            assert box["median_deg"] == pytest.approx(np.median(expected), abs=1e-9)
            spread = stats.iqr(expected)
            assert box["interquartile_range_deg"] == pytest.approx(spread)


def test_errors_shrink_as_their_quartiles_say(
    report: pathlib.Path, document: dict[str, Any]
) -> None:
    for key in ("figure_1", "figure_6"):
        kept = table(report, f"{key}_errors")
        shrink = numbers(document, key)["interquartile_range_shrinks_by"]
        for axis in ("pitch", "yaw", "roll"):
            before = stats.iqr(kept[f"{axis}_before_deg"])
            after = stats.iqr(kept[f"{axis}_after_deg"])
            assert shrink[axis] == pytest.approx(before / after)
            assert before > 10.0 * after
            assert abs(np.median(kept[f"{axis}_after_deg"])) < 0.05


def test_euler_residuals_are_those_of_scipys_rotations(report: pathlib.Path) -> None:
    kept = table(report, "euler_orders_euler_orders")
    rng = np.random.default_rng(np.random.SeedSequence(0, spawn_key=(6,)))
    u = rng.random((2_000, 3)) * 40.0 - 20.0
    z = np.concatenate([u, np.ones((len(u), 1))], axis=1)
    turned = Rotation.from_euler("XYZ", u * SCALE + BIAS_DEG, degrees=True)
    for row, order in enumerate(kept["read_out_order"]):
        angles = turned.as_euler(order, degrees=True)
        read = np.stack([angles[:, order.index(a)] for a in "XYZ"], axis=1)
        left = read - z @ np.linalg.lstsq(z, read, rcond=None)[0]
        expected = np.sqrt((left**2).mean(axis=0))
        found = [kept[f"rms_{a}_deg"][row] for a in ("pitch", "yaw", "roll")]
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


def test_the_reward_is_bounded_by_the_cube(
    document: dict[str, Any], rng: np.random.Generator
) -> None:
    bound = numbers(document, "reward_range")["largest_log_det_s_in_unit_cube"]
    assert bound == pytest.approx(6 * np.log(2.0))
    # Corners, faces and inside: nothing exceeds it.
    points = np.clip(rng.uniform(-1.0, 2.0, (200_000, 4, 3)), 0.0, 1.0)
    z = np.concatenate([points, np.ones((*points.shape[:2], 1))], axis=-1)
    assert 6 * np.log(np.abs(np.linalg.det(z)).max()) <= bound + 1e-9


def test_recalibration_ratios_are_those_of_the_devices(
    report: pathlib.Path, document: dict[str, Any]
) -> None:
    kept = table(report, "figure_10_error_by_device")
    ratios = numbers(document, "figure_10")["error_of_second_over_first"]
    star = np.median(kept["det-maximal_session_11_rms_deg"])
    for name, first in (
        ("policy_x0_against_x_star", "policy_session_1_rms_deg"),
        ("random_x0_against_x_star", "random_session_1_rms_deg"),
    ):
        assert ratios[name]["value"] == pytest.approx(star / np.median(kept[first]))
    by_session = table(report, "figure_10_error_by_session")
    keep = (by_session["choice"] == "policy") & (by_session["calibrated_in"] == 1)
    curve = by_session["median_rms_deg"][keep]
    # A random walk: further off with every session, as the root of their number.
    assert curve[-1] > 2.0 * curve[1] > 2.0 * curve[0]
    recorded = table(report, "figure_10_recorded_error_by_episode")
    over = numbers(document, "figure_10_recorded")["x_star_over"]["x0_policy"]
    medians = [np.median(recorded[f"{n}_rms_deg"]) for n in ("x_star", "x0_policy")]
    assert over["value"] == pytest.approx(medians[0] / medians[1])


def test_missing_training_runs_are_said_to_be_missing(
    document: dict[str, Any],
) -> None:
    for key in ("figure_2", "figure_2_paper"):
        exhibit = document["exhibits"][key]
        assert exhibit["verdict"] == "not comparable"
        assert "Not here" in exhibit["ours"] and not exhibit["figures"]


def test_no_number_depends_on_when_it_was_made(document: dict[str, Any]) -> None:
    text = json.dumps(document)
    assert not re.search(r"20\d\d-\d\d-\d\d", text)
    assert document["settings"] == {"seed": 0, "quick": True, "data": None}


def test_help_teaches() -> None:
    done = run("--help")
    assert done.returncode == 0
    for word in ("examples:", "--quick", "--data", "index.html", "pairs.csv"):
        assert word in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--seed", "x"], "--seed: must be a whole number of at least 0, got 'x'"),
        (["--seed", "-1"], "--seed: must be a whole number of at least 0"),
        (["--data", "{tmp}/none"], "--data must be a folder"),
        (["--data", "{tmp}"], "dataset5.csv: No such file"),
        (["--data", "{tmp}/bad"], "there is no column 'u_deg_pitch'"),
        (["--out", "{tmp}/file"], "is not a folder"),
        (["--studies", "{tmp}/torn"], "there is no column 'reward_mean'"),
        (["--fast"], "unrecognized arguments: --fast"),
    ],
)
def test_bad_arguments_end_in_one_line(
    arguments: Sequence[str],
    message: str,
    tmp_path: pathlib.Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "dataset5.csv").write_text("a,b\n1,2\n")
    torn = tmp_path / "torn" / "compact_seeds" / "seed_0"
    torn.mkdir(parents=True)
    (torn / "metrics.csv").write_text("episodes,reward\n1,2\n")
    given = [word.replace("{tmp}", str(tmp_path)) for word in arguments]
    if "--out" not in given:
        given += ["--out", str(tmp_path / "report")]
    try:
        code = main(["--quick", *given])
    except SystemExit as stop:
        assert isinstance(stop.code, int)
        code = stop.code
    error = capsys.readouterr().err
    assert code == 2 and message in error and error.count("\n") == 1
    assert not (tmp_path / "report").exists()


@pytest.mark.slow
def test_the_same_command_gives_the_same_bytes(
    report: pathlib.Path, tmp_path: pathlib.Path
) -> None:
    again = tmp_path / "report"
    stale = again / "figures" / "old.png"
    stale.parent.mkdir(parents=True)
    stale.write_bytes(b"")
    done = run("--quick", "--studies", tmp_path / "none", "--out", again)
    assert done.returncode == 0, done.stderr
    names = sorted(p.relative_to(report) for p in report.rglob("*") if p.is_file())
    there = sorted(p.relative_to(again) for p in again.rglob("*") if p.is_file())
    assert names == there
    for name in names:
        assert (report / name).read_bytes() == (again / name).read_bytes(), name
