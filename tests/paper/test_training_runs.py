"""Kept training runs: thinning, and the command from end to end."""

from __future__ import annotations

import json
import pathlib

import numpy as np
import pytest

from benchmarks.paper import training_runs
from benchmarks.paper.training_runs import main, thinned
from jaxcal.commands.train import main as train
from jaxcal.evaluation.figures import read_metrics
from jaxcal.learning.training import checkpoint


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


def test_a_folder_that_is_no_run_is_named(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert f"{tmp_path} holds no metrics.csv" in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_run_of_train_is_kept(
    tmp_path: pathlib.Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run, kept = tmp_path / "seed_3", tmp_path / "kept" / "seed_3"
    given = ["--seed", "3", "--episodes", "4096", "--out", str(run)]
    assert train([*given, "--with", "close_up=false"]) == 0  # as the kept runs are made
    assert main([str(run), "--out", str(kept.parent)]) == 0
    assert "4,096 episodes" in capsys.readouterr().out
    summary = json.loads((kept / "summary.json").read_text())
    assert summary["seed"] == 3
    assert summary["episodes"] == summary["planned_episodes"] == 4096
    assert summary["parameters"] == 42946
    assert 0.0 < summary["dataset2"]["ratio_to_exact"] <= 1.0
    metrics, whole = (read_metrics(f / "metrics.csv") for f in (kept, run))
    np.testing.assert_allclose(metrics["reward_mean"], whole["reward_mean"], rtol=1e-5)
    assert np.load(kept / "last_rewards.npy").shape == (1000,)
    own = checkpoint.load(run).weights.arrays
    again = checkpoint.load(kept / "policy.npz").weights.arrays
    assert own.keys() == again.keys()
    assert all(np.array_equal(own[name], again[name]) for name in own)
    monkeypatch.setattr(training_runs, "HALVED", 1)
    assert main([str(run), "--out", str(tmp_path / "halved")]) == 0
    halved = tmp_path / "halved" / "seed_3" / "policy.npz"
    assert halved.stat().st_size < 0.6 * (kept / "policy.npz").stat().st_size
    half = checkpoint.load(halved).weights.arrays
    assert {array.dtype for array in half.values()} == {np.dtype(np.float32)}
    for name in own:
        np.testing.assert_allclose(half[name], own[name], rtol=1e-3, atol=1e-4)
