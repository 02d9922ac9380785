"""Kept training runs: thinning, what is refused, and the command from end to end."""

from __future__ import annotations

import json
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from jaxcal.evaluation.training_figure import read_metrics
from studies.paper.training_runs import main, thinned

ROOT = pathlib.Path(__file__).parents[2]


def test_thinning_keeps_moments_and_last_values(rng: np.random.Generator) -> None:
    rewards = rng.normal(size=(7 * 30, 16)) + rng.normal(size=(7 * 30, 1))
    ratio = np.full(len(rewards), np.nan)
    ratio[[0, 40, 95]] = 0.1, 0.4, 0.9
    metrics = {
        "episodes": 16.0 * np.arange(1, len(rewards) + 1),
        "reward_mean": rewards.mean(1),
        "reward_std": rewards.std(1),
        "ratio_to_exact": ratio,
    }
    thin = thinned(metrics, 7)
    blocks = rewards.reshape(7, -1)  # the episodes of 30 updates each
    np.testing.assert_allclose(thin["reward_mean"], blocks.mean(1))
    np.testing.assert_allclose(thin["reward_std"], blocks.std(1))
    np.testing.assert_array_equal(thin["episodes"], 480.0 * np.arange(1, 8))
    nothing = np.nan
    np.testing.assert_array_equal(
        thin["ratio_to_exact"],
        [0.1, 0.4, nothing, 0.9, nothing, nothing, nothing],
    )
    assert thinned(metrics, len(rewards)) is metrics


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give one of --preset and --collect"),
        (["--preset", "best"], "--preset must be one of compact, general, paper"),
        (["--preset", "compact", "--seeds", "x"], "a number of seeds or a list"),
        (["--preset", "compact", "--seeds", "1,-2"], "a number of seeds or a list"),
        (
            ["--preset", "compact", "--episodes", "0"],
            "--episodes: must be a whole number of at least 1, got '0'",
        ),
        (["--collect", "{tmp}", "--seeds", "3"], "go with --preset"),
        (["--collect", "{tmp}"], "holds no metrics.csv"),
    ],
)
def test_bad_arguments(
    arguments: list[str],
    message: str,
    tmp_path: pathlib.Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    given = [word.replace("{tmp}", str(tmp_path)) for word in arguments]
    try:
        code = main([*given, "--out", str(tmp_path / "out")])
    except SystemExit as stop:
        assert isinstance(stop.code, int)
        code = stop.code
    error = capsys.readouterr().err
    assert code == 2 and message in error and error.count("\n") == 1


def test_a_kept_run_of_another_budget_is_not_overwritten(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    held = tmp_path / "seed_0" / "summary.json"
    held.parent.mkdir()
    text = json.dumps(
        {"preset": "compact", "planned_episodes": 16, "seed": 0, "finished": True}
    )
    held.write_text(text)
    given = ["--preset", "compact", "--seeds", "1", "--out", str(tmp_path)]
    assert main([*given, "--runs", str(tmp_path / "runs")]) == 2
    assert "16 episodes" in capsys.readouterr().err
    assert held.read_text() == text


@pytest.mark.slow
def test_the_command_trains_keeps_and_does_not_train_again(
    tmp_path: pathlib.Path,
) -> None:
    command = [sys.executable, "-m", "studies.paper.training_runs"]
    folders = ["--out", str(tmp_path / "kept"), "--runs", str(tmp_path / "runs")]
    given = [*command, "--preset", "compact", "--seeds", "3,3", "--episodes", "4096"]
    done = subprocess.run([*given, *folders], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    kept = tmp_path / "kept" / "seed_3"
    summary = json.loads((kept / "summary.json").read_text())
    assert summary["seed"] == 3 and summary["finished"]
    assert summary["episodes"] == summary["planned_episodes"] == 4096
    assert summary["parameters"] == 42946
    assert 0.0 < summary["dataset2"]["ratio_to_exact"] <= 1.0
    metrics = read_metrics(kept / "metrics.csv")
    run = read_metrics(tmp_path / "runs" / "seed_3" / "metrics.csv")
    np.testing.assert_allclose(metrics["reward_mean"], run["reward_mean"], rtol=1e-5)
    rewards = np.load(kept / "last_rewards.npy")
    assert rewards.shape == (1000,)
    again = subprocess.run([*given, *folders], capture_output=True, text=True, cwd=ROOT)
    assert again.returncode == 0 and "already finished" in again.stdout
