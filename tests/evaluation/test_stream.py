"""Streams: tallies that add up, resumption, sharing, and the plain evaluation."""

from __future__ import annotations

import functools
import json
import pathlib
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from jaxcal.evaluation import methods as stream
from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.methods import evaluate, evaluate_stream
from jaxcal.evaluation.postures import summary_of
from jaxcal.evaluation.report import MethodNumbers, Summary, json_document, text_table
from jaxcal.information.regression import log_det_information
from jaxcal.paper.datasets import drawn, make_dataset

PLAN: dict[str, Any] = {
    **{"dataset": "dataset2", "seed": 0, "k": 4, "checkpoints": [None]},
    **{"methods": ["random", "greedy", "exact"], "num": 16, "random_draws": 3},
}


def numbers_of(log_det: np.ndarray, best: np.ndarray) -> dict[str, object]:
    """A row as ``Evaluation.summary`` has it, by numpy."""
    det, gap = np.exp(log_det), log_det - best[:, None]
    return {
        "label": "x",
        "det_s": moments(det),
        "log_det_s": moments(log_det),
        "ratio_to_exact": float(np.exp(gap).mean()),
        "hit_rate": float((gap > -1e-12).mean()),
        "d_efficiency": float(np.exp(gap / 12).mean()),
        "ratio_to_random": 1.0,
        "seconds_per_selection": 0.1,
        "draws_per_episode": log_det.shape[1],
    }


def moments(values: np.ndarray) -> dict[str, float]:
    return {
        name: float(getattr(np, name)(values)) for name in ("mean", "std", "median")
    }


def test_a_total_has_the_moments_of_all_parts(rng: np.random.Generator) -> None:
    log_det = rng.normal(-2.0, 3.0, size=(4_000, 5))
    best = log_det.max(axis=1) + rng.choice([0.0, 0.1], size=4_000)
    cuts = [slice(0, 1_500), slice(1_500, 3_000), slice(3_000, 4_000)]
    parts = [numbers_of(log_det[cut], best[cut]) for cut in cuts]
    found = stream.total([1_500, 1_500, 1_000], parts)
    whole = numbers_of(log_det, best)
    for name in ("ratio_to_exact", "hit_rate", "d_efficiency"):
        assert found[name] == pytest.approx(whole[name], rel=1e-13)
    for name in ("det_s", "log_det_s"):
        for moment in ("mean", "std"):
            assert found[name][moment] == pytest.approx(whole[name][moment], rel=1e-12)
    assert found["draws_per_episode"] == 5 and found["label"] == "x"


def test_what_one_part_lacks_the_total_lacks(rng: np.random.Generator) -> None:
    log_det = rng.normal(size=(20, 1))
    part = numbers_of(log_det, log_det[:, 0])
    nothing = {"mean": None, "std": None, "median": 0.5}
    found = stream.total([20, 10], [part, part | {"log_det_s": nothing}])
    assert found["log_det_s"]["mean"] is None and found["log_det_s"]["std"] is None
    assert found["det_s"]["std"] == pytest.approx(part["det_s"]["std"], rel=1e-12)  # type: ignore[index]  # a row


def run(
    folder: pathlib.Path, episodes: int, plan: dict[str, Any] = PLAN, **options: Any
) -> Summary:
    draw = functools.partial(drawn, plan["dataset"], plan["seed"])
    return evaluate_stream(draw, episodes, folder, plan, **options)


def exact_numbers(found: Summary) -> list[dict[str, object]]:
    """All but the measured seconds."""
    rows = [dict(row.numbers) for row in found.rows]
    assert all(row.pop("seconds_per_selection") > 0 for row in rows)
    return rows


def test_the_first_block_has_the_numbers_of_a_plain_evaluation(
    tmp_path: pathlib.Path,
) -> None:
    streamed = run(tmp_path, 300)
    plain = evaluate(
        make_dataset("dataset2", episodes=300), 4, PLAN["methods"], random_draws=3
    )
    for one, other in zip(streamed.rows, plain.summarise().rows, strict=True):
        row, expected = one.numbers, other.numbers
        assert row["label"] == expected["label"]
        assert row["hit_rate"] == expected["hit_rate"]
        for name in ("ratio_to_exact", "d_efficiency", "ratio_to_random"):
            assert row[name] == pytest.approx(expected[name], rel=1e-13)
        for name in ("det_s", "log_det_s"):
            assert row[name]["median"] is None
            for moment in ("mean", "std"):
                wanted = pytest.approx(expected[name][moment], rel=1e-12)
                assert row[name][moment] == wanted
    text = text_table(streamed)
    assert "300 episodes" in text
    entry = json.loads(json_document([streamed], command=["x"]))["results"][0]
    assert entry["dataset"]["episodes"] == 300 and entry["proven"] == 1.0


class Quickly:
    """In place of the solvers: the first four and the next four postures."""

    def __init__(self, dataset: Dataset, **options: Any) -> None:
        self.dataset = dataset

    def summarise(self) -> Summary:
        candidates = self.dataset.candidates
        first, next_four = (
            log_det_information(candidates[:, cut, :], 3)[:, None]
            for cut in (slice(0, 4), slice(4, 8))
        )
        best = np.maximum(first, next_four)[:, 0]
        rows = (
            MethodNumbers(
                "random", None, numbers_of(np.hstack([first, next_four]), best)
            ),
            MethodNumbers("greedy", None, numbers_of(first, best)),
            MethodNumbers("exact", None, numbers_of(best[:, None], best)),
        )
        proven = int((candidates[:, 8, 0] < 0.9).sum())
        facts = {"dataset": self.dataset.facts(), "k": 4, "seed": 0, "criterion": "D"}
        return summary_of(facts, rows, proven)


def test_stopping_and_sharing_do_not_change_a_digit(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "evaluate", Quickly)
    large = exact_numbers(run(tmp_path / "large", 7_300))
    monkeypatch.setattr(stream, "PART", 1_000)
    whole = exact_numbers(run(tmp_path / "whole", 7_300))
    # Of other parts the means are the same to the last digits.
    for row, other in zip(whole, large, strict=True):
        assert row["hit_rate"] == pytest.approx(other["hit_rate"], rel=1e-13)
        assert row["det_s"]["mean"] == pytest.approx(other["det_s"]["mean"], rel=1e-13)  # type: ignore[index]  # a row

    def stop(task: str, done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    stopped = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        run(stopped, 7_300, progress=stop)
    stamps = {path.name: path.stat().st_mtime_ns for path in stopped.glob("part-*")}
    assert len(stamps) == 2
    assert exact_numbers(run(stopped, 7_300)) == whole
    for name, stamp in stamps.items():
        assert (stopped / name).stat().st_mtime_ns == stamp

    # Three at once: each evaluates what the others have not.
    with ThreadPoolExecutor(3) as threads:
        for found in threads.map(lambda _: run(tmp_path / "shared", 7_300), range(3)):
            assert exact_numbers(found) == whole

    # More episodes later go on from the whole parts that are there.
    grown = tmp_path / "grown"
    run(grown, 3_300)
    assert exact_numbers(run(grown, 7_300)) == whole


def test_a_stream_goes_on_where_the_dataset_ends() -> None:
    whole = make_dataset("dataset1", 5, 2_500)
    np.testing.assert_array_equal(
        drawn("dataset1", 5, 1_000, 2_500).candidates, whole.candidates[1_000:]
    )
    far = drawn("dataset2", 0, 9_999_000, 10_000_000).candidates
    assert far.shape == (1_000, 50, 3) and far.min() >= 0.0 and far.max() <= 1.0
    assert not np.isin(far[:, 0, 0], make_dataset("dataset2").candidates[..., 0]).any()


def test_memory_does_not_grow_with_the_episodes(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "evaluate", Quickly)
    monkeypatch.setattr(stream, "PART", 2_000)
    peaks = []
    for number, episodes in enumerate((2_000, 2_000, 12_000)):
        tracemalloc.start()
        run(tmp_path / str(number), episodes)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    one_block = 1_000 * 50 * 3 * 8
    assert peaks[2] - peaks[1] < one_block


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"k": 5}, "its k is 4, not 5"),
        ({"seed": 1}, "its seed is 0, not 1"),
        ({"methods": ["exact"]}, "its methods is"),
        ({"random_draws": 4}, "its random_draws is 3, not 4"),
    ],
)
def test_another_plan_is_refused(
    tmp_path: pathlib.Path, change: dict[str, object], says: str
) -> None:
    run(tmp_path, 2)
    run(tmp_path, 3)
    with pytest.raises(ValueError, match=says):
        run(tmp_path, 2, PLAN | change)


def test_damage_and_other_versions_are_named(tmp_path: pathlib.Path) -> None:
    run(tmp_path, 20)
    part = next(tmp_path.glob("part-*"))
    part.write_text(part.read_text()[:100])
    with pytest.raises(ValueError, match=r"part-.* is damaged .* Delete it"):
        run(tmp_path, 20)
    path = tmp_path / "stream.json"
    held = json.loads(path.read_text())
    path.write_text(json.dumps(held | {"version": 2, "seed": 5}))
    with pytest.raises(ValueError, match=r"its version is 2, not 4; name another"):
        run(tmp_path, 20)
    path.write_text("[1")
    with pytest.raises(ValueError, match=r"stream\.json is damaged"):
        run(tmp_path, 20)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"dataset": "dataset4"}, "streamed dataset must be one of .* got 'dataset4'"),
        ({"methods": ["best"]}, "method must be one of .* got 'best'"),
        ({"k": 3}, "dataset2: k must be at least 4"),
    ],
)
def test_bad_plans_are_named_and_leave_nothing(
    tmp_path: pathlib.Path, values: dict[str, object], says: str
) -> None:
    with pytest.raises(ValueError, match=says):
        run(tmp_path / "new", 10, PLAN | values)
    assert not (tmp_path / "new").exists()
