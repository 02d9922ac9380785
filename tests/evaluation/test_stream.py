"""Streams: tallies that add up, resumption, sharing, and the plain evaluation."""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from jaxcal.evaluation import stream
from jaxcal.evaluation.methods import evaluate
from jaxcal.evaluation.report import json_document, text_table
from jaxcal.evaluation.results import Summary
from jaxcal.evaluation.stream import Plan, evaluate_stream, open_folder
from jaxcal.information.regression import log_det_information
from jaxcal.paper.datasets.datasets import drawn, make_dataset

PLAN = Plan("dataset2", drawn, methods=("random", "greedy", "exact"), draws=3)


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
    assert found["log_det_s"]["median"] == pytest.approx(
        whole["log_det_s"]["median"],
        abs=0.1,  # 20,000 draws of sd 3
    )
    assert found["draws_per_episode"] == 5 and found["label"] == "x"


def test_what_one_part_lacks_the_total_lacks(rng: np.random.Generator) -> None:
    log_det = rng.normal(size=(20, 1))
    part = numbers_of(log_det, log_det[:, 0])
    nothing = {"mean": None, "std": None, "median": 0.5}
    found = stream.total([20, 10], [part, part | {"log_det_s": nothing}])
    assert found["log_det_s"]["mean"] is None and found["log_det_s"]["std"] is None
    assert found["det_s"]["std"] == pytest.approx(part["det_s"]["std"], rel=1e-12)  # type: ignore[index]  # a row


def run(
    folder: pathlib.Path, episodes: int, plan: Plan = PLAN, **options: object
) -> Summary:
    open_folder(plan, folder)
    return evaluate_stream(plan, episodes, folder, **{"workers": 1} | options)  # type: ignore[arg-type]  # a test's shorthand


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
        make_dataset("dataset2", episodes=300), 4, PLAN.methods, random_draws=3
    )
    for one, other in zip(streamed.rows, plain.summarise().rows, strict=True):
        row, expected = one.numbers, other.numbers
        assert row["label"] == expected["label"]
        assert row["hit_rate"] == expected["hit_rate"]
        for name in ("ratio_to_exact", "d_efficiency", "ratio_to_random"):
            assert row[name] == pytest.approx(expected[name], rel=1e-13)
        for name in ("det_s", "log_det_s"):
            assert row[name] == pytest.approx(expected[name], rel=1e-12)
    assert streamed.num_proven == 300
    text = text_table(streamed)
    assert "300 episodes" in text and "means of those of parts" in text
    entry = json.loads(json_document([streamed], command=["x"]))["results"][0]
    assert entry["dataset"]["episodes"] == 300 and entry["proven"] == 1.0


def quickly(plan: Plan, begin: int, end: int) -> dict[str, object]:
    """In place of the solvers: the first four and the next four postures."""
    candidates = drawn(plan.dataset, plan.seed, begin, end).candidates
    first, next_four = (
        log_det_information(candidates[:, cut, :], 3)[:, None]
        for cut in (slice(0, 4), slice(4, 8))
    )
    best = np.maximum(first, next_four)[:, 0]
    rows = {
        "random": numbers_of(np.hstack([first, next_four]), best),
        "greedy": numbers_of(first, best),
        "exact": numbers_of(best[:, None], best),
    }
    return {"proven": int((candidates[:, 8, 0] < 0.9).sum()), "rows": rows}


def test_stopping_and_sharing_do_not_change_a_digit(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stream, "_solved", quickly)
    large = exact_numbers(run(tmp_path / "large", 7_300))
    monkeypatch.setattr(stream, "PART", 1_000)
    whole = exact_numbers(run(tmp_path / "whole", 7_300))
    # Of other parts the means are the same to the last digits.
    for row, other in zip(whole, large, strict=True):
        assert row["hit_rate"] == pytest.approx(other["hit_rate"], rel=1e-13)
        assert row["det_s"]["mean"] == pytest.approx(other["det_s"]["mean"], rel=1e-13)  # type: ignore[index]  # a row

    def stop(task: str, done: int, total: int) -> None:
        if done == 2_000:
            raise KeyboardInterrupt

    stopped = tmp_path / "stopped"
    with pytest.raises(KeyboardInterrupt):
        run(stopped, 7_300, progress=stop)
    stamps = {path.name: path.stat().st_mtime_ns for path in stopped.glob("part-*")}
    assert len(stamps) == 2
    assert exact_numbers(run(stopped, 7_300)) == whole
    for name, stamp in stamps.items():
        assert (stopped / name).stat().st_mtime_ns == stamp

    # Three processes: each evaluates what the others have not.
    def shared(number: int) -> Summary:
        place = tmp_path / "shared"
        return run(place, 7_300, process=(number, 3))

    with ThreadPoolExecutor(3) as threads:
        for found in threads.map(shared, range(3)):
            assert exact_numbers(found) == whole

    # Of three, two died before their first part: the third waits for nobody.
    assert exact_numbers(run(tmp_path / "left", 7_300, process=(1, 3))) == whole

    # More episodes later go on from the whole parts that are there.
    grown = tmp_path / "grown"
    run(grown, 3_300)
    assert exact_numbers(run(grown, 7_300)) == whole


@pytest.mark.slow
def test_workers_do_not_change_a_digit(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    methods = ("random", "greedy", "exchange", "exact")
    plan = Plan("dataset2", drawn, methods=methods, draws=3)
    monkeypatch.setattr(stream, "PART", 1_000)
    here = run(tmp_path / "here", 2_200, plan)
    there = run(tmp_path / "there", 2_200, plan, workers=2)
    assert exact_numbers(here) == exact_numbers(there)


@pytest.mark.skipif(not pathlib.Path("/proc/self/task").exists(), reason="no /proc")
def test_a_killed_stream_leaves_no_worker_and_loses_no_part(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = pathlib.Path(__file__).resolve().parents[2]
    code = (
        "import pathlib, sys; from jaxcal.evaluation import stream as s\n"
        "from jaxcal.paper.datasets.datasets import drawn\n"
        "if __name__ == '__main__':\n"
        "    s.PART = 1_000\n"
        f"    plan = s.Plan('dataset2', drawn, methods={PLAN.methods!r}, draws=3)\n"
        "    folder = pathlib.Path(sys.argv[1]); s.open_folder(plan, folder)\n"
        "    s.evaluate_stream(plan, 10**7, folder, workers=2)\n"
    )
    script = tmp_path / "stream.py"
    script.write_text(code)
    folder = tmp_path / "parts"
    environment = {**os.environ, "PYTHONPATH": str(root)}
    with subprocess.Popen(
        [sys.executable, str(script), str(folder)], env=environment
    ) as process:
        try:
            wait_for(lambda: len(list(folder.glob("part-*"))) >= 2)
            children = children_of(process.pid)
        finally:
            process.kill()
    assert len(children) >= 2
    wait_for(lambda: not any(running(pid) for pid in children))
    assert not [path for path in folder.iterdir() if path.suffix != ".json"]
    monkeypatch.setattr(stream, "PART", 1_000)
    done, whole = run(folder, 2_000), run(tmp_path / "whole", 2_000)
    assert exact_numbers(done) == exact_numbers(whole)


def wait_for(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen in time"
        time.sleep(0.05)


def children_of(pid: int) -> list[int]:
    found = pathlib.Path(f"/proc/{pid}/task/{pid}/children").read_text()
    return [int(child) for child in found.split()]


def running(pid: int) -> bool:
    """Neither gone nor a corpse that nobody has fetched."""
    try:
        return "\nState:\tZ" not in pathlib.Path(f"/proc/{pid}/status").read_text()
    except FileNotFoundError:
        return False


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
    monkeypatch.setattr(stream, "_solved", quickly)
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
        ({"methods": ("exact",)}, "its methods is"),
        ({"draws": 4}, "its draws is 3, not 4"),
    ],
)
def test_another_plan_is_refused(
    tmp_path: pathlib.Path, change: dict[str, object], says: str
) -> None:
    open_folder(PLAN, tmp_path)
    open_folder(PLAN, tmp_path)
    other = dataclasses.replace(PLAN, **change)  # type: ignore[arg-type]  # a test's shorthand
    with pytest.raises(ValueError, match=says):
        open_folder(other, tmp_path)


def test_damage_is_named(tmp_path: pathlib.Path) -> None:
    plan = Plan("dataset2", drawn, methods=("greedy",), draws=1)
    run(tmp_path, 20, plan)
    part = next(tmp_path.glob("part-*"))
    part.write_text(part.read_text()[:100])
    with pytest.raises(ValueError, match=r"part-.* is damaged .* delete it"):
        run(tmp_path, 20, plan)
    (tmp_path / "stream.json").write_text("[1")
    with pytest.raises(ValueError, match=r"stream\.json is damaged"):
        open_folder(plan, tmp_path)


def test_a_folder_of_another_version_is_refused(tmp_path: pathlib.Path) -> None:
    open_folder(PLAN, tmp_path)
    path = tmp_path / "stream.json"
    held = json.loads(path.read_text())
    path.write_text(json.dumps(held | {"version": 2, "seed": 5}))
    with pytest.raises(ValueError, match=r"its version is 2, not 3; name another"):
        open_folder(PLAN, tmp_path)


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"dataset": "dataset4"}, "streamed dataset must be one of .* got 'dataset4'"),
        ({"methods": ("auto",)}, "streamed method must be one of .* got 'auto'"),
        ({"k": 3}, r"k must be in \[4, 50\), got 3"),
    ],
)
def test_bad_plans_are_named(values: dict[str, object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        dataclasses.replace(PLAN, **values)  # type: ignore[arg-type]  # bad on purpose


def test_bad_workers_are_named(tmp_path: pathlib.Path) -> None:
    with pytest.raises(ValueError, match="workers must be at least 1, got 0"):
        run(tmp_path, 10, workers=0)
