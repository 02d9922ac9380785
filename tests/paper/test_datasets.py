"""The paper's datasets by seed, recordings, and dataset files good and bad."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxcal
from benchmarks.paper.datasets import main, make_dataset, save_csv
from benchmarks.paper.recordings import RECORDED, SHIPPED, read_pool
from jaxcal.candidates import JointRanges
from jaxcal.evaluation.dataset import (
    Dataset,
    load_dataset,
    save_npz,
)
from jaxcal.paper.datasets import (
    BIAS_DEG,
    EPISODES,
    NAMES,
    NOISE_STD_DEG,
    RANGES,
    SCALE,
    streams,
)
from jaxcal.paper.datasets import make_dataset as drawn

# A loaded machine is no failure.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")


# -- generation ------------------------------------------------------------------------


def test_sizes_are_those_of_table_3() -> None:
    two, three = make_dataset("dataset2"), make_dataset("dataset3")
    assert list(EPISODES.values()) == [200, 200_000, 1_000, 100, 100, 1]
    assert two.candidates.shape == (1000, 50, 3) and two.measured is None
    assert three.candidates.shape == (100, 50, 3)
    assert three.measured is not None and three.measured.shape == (100, 50, 3)
    for name in RECORDED:
        data = make_dataset(name)
        assert data.candidates.shape == (EPISODES[name], 50, 3)
        assert data.measured is not None and data.measured.shape == (
            EPISODES[name],
            50,
            3,
        )
    first = drawn("dataset1", episodes=1000)
    assert first.candidates.shape == (1000, 50, 3) and first.measured is None


@pytest.mark.slow
def test_the_whole_of_dataset_1_is_uniform() -> None:
    points = drawn("dataset1").candidates
    assert len(points) == 200_000
    np.testing.assert_allclose(points.mean(axis=(0, 1)), 0.5, atol=1e-3)


@pytest.mark.parametrize("name", [n for n in NAMES if n != "dataset5"])
def test_candidates_are_uniform_in_the_unit_cube(name: str) -> None:
    points = make_dataset(
        name, episodes=40 if name == "dataset0" else 100
    ).candidates.reshape(-1, 3)
    assert points.min() >= 0.0 and points.max() < 1.0
    # The pool of dataset4 has 500 postures only, however often they are drawn.
    drawn = 500 if name == "dataset4" else len(points)
    np.testing.assert_allclose(points.mean(axis=0), 0.5, atol=4 * 0.2887 / drawn**0.5)
    np.testing.assert_allclose(points.var(axis=0), 1 / 12, atol=4 * 0.0745 / drawn**0.5)


@pytest.mark.parametrize("name", [n for n in NAMES if n != "dataset5"])
def test_the_seed_decides_and_fewer_are_the_first_of_more(name: str) -> None:
    whole = make_dataset(name, 5, 12)
    part = make_dataset(name, 5, 4)
    np.testing.assert_array_equal(part.candidates, whole.candidates[:4])
    assert not np.array_equal(make_dataset(name, 6, 4).candidates, part.candidates)
    if whole.measured is not None and part.measured is not None:
        np.testing.assert_array_equal(part.measured, whole.measured[:4])


def test_every_thousand_episodes_have_a_stream_of_their_own() -> None:
    whole = drawn("dataset1", 3, 2500).candidates
    assert len(whole) == 2500
    for block, count in enumerate((1000, 1000, 500)):
        draw, _ = streams("dataset1", 3, block)
        part = whole[1000 * block :][:count]
        np.testing.assert_array_equal(part, draw.random((count, 50, 3)))


def test_no_dataset_shares_a_candidate_with_another_or_with_itself() -> None:
    parts = [
        make_dataset("dataset1", episodes=3000).candidates,
        make_dataset("dataset1", seed=1, episodes=1000).candidates,
        make_dataset("dataset2").candidates,
        make_dataset("dataset3").candidates,
        make_dataset("dataset0", episodes=4).candidates,
    ]
    axis = np.concatenate([part[..., 0].ravel() for part in parts])
    assert len(np.unique(axis)) == len(axis)


def test_dataset_3_is_table_1_plus_noise() -> None:
    data = make_dataset("dataset3")
    assert data.measured is not None and data.ranges is not None
    degrees = RANGES.denormalise(data.candidates)
    noise = (data.measured - degrees * SCALE - BIAS_DEG).reshape(-1, 3)
    np.testing.assert_allclose(noise.mean(axis=0), 0, atol=4 * NOISE_STD_DEG / 70)
    np.testing.assert_allclose(noise.std(axis=0), NOISE_STD_DEG, rtol=0.05)
    assert np.abs(np.corrcoef(noise.T) - np.eye(3)).max() < 0.06
    np.testing.assert_allclose(SCALE, [0.43, 0.71, 0.87])
    np.testing.assert_allclose(BIAS_DEG, [3.1, -5.8, 2.41])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("dataset9",), "name must be one of dataset0, dataset1, dataset2, dataset3"),
        (("dataset5", 0, 2), r"episodes must be in \[1, 1\] for dataset5, got 2"),
        (("dataset2", -1), "seed must not be negative, got -1"),
        (("dataset2", 0, 0), r"episodes must be in \[1, 1000\] for dataset2, got 0"),
        (("dataset3", 0, 101), r"episodes must be in \[1, 100\] for dataset3, got 101"),
    ],
)
def test_bad_requests_are_named(arguments: tuple[object, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        drawn(*arguments)  # type: ignore[arg-type]  # bad on purpose


def test_bad_arrays_are_named() -> None:
    good = np.zeros((2, 5, 3))
    with pytest.raises(ValueError, match=r"candidates must have shape"):
        Dataset("x", good[0])
    with pytest.raises(ValueError, match=r"measured must have shape \(2, 5, m\)"):
        Dataset("x", good, good[:1])
    with pytest.raises(ValueError, match=r"available must have shape \(2, 5\)"):
        Dataset("x", good, available=np.ones((2, 4), bool))


# -- dataset0: the robot, driven ------------------------------------------------------


def identified(path: pathlib.Path) -> tuple[np.ndarray, np.ndarray]:
    """Estimates (12,) and standard errors of y = A u + b by normal equations alone."""
    with path.open(newline="") as file:
        rows = [
            {name: float(cell) for name, cell in row.items()}
            for row in csv.DictReader(file)
        ]
    ranges = json.loads(path.with_suffix(".json").read_text())["ranges_deg"]
    commands = np.array(
        [
            [
                low + row[f"u_{axis}"] * (high - low)
                for axis, (low, high) in zip("xyz", ranges.values(), strict=True)
            ]
            for row in rows
        ]
    )
    read = np.array([[row[f"y_{axis}"] for axis in "xyz"] for row in rows])
    z = np.column_stack([commands, np.ones(len(rows))])
    inverse = np.linalg.inv(z.T @ z)
    found = inverse @ z.T @ read  # (4, 3)
    noise = ((read - z @ found) ** 2).sum(axis=0) / (len(rows) - 4)
    errors = np.sqrt(np.outer(np.diag(inverse), noise))
    return found.T.ravel(), errors.T.ravel()


TRUTH = np.column_stack([np.diag(SCALE), BIAS_DEG]).ravel()


def test_dataset_0_gives_table_1_back(tmp_path: pathlib.Path) -> None:
    assert main(["dataset0", "--out", str(tmp_path), "--episodes", "40"]) == 0
    found, errors = identified(tmp_path / "dataset0.csv")
    assert ((found - TRUTH) ** 2 / errors**2).sum() < 32.9  # chi2(12), 99.9 %
    assert errors.max() < 0.005


@pytest.mark.slow
def test_the_whole_of_dataset_0_holds_table_1_in_every_interval(
    tmp_path: pathlib.Path,
) -> None:
    assert main(["dataset0", "--out", str(tmp_path)]) == 0
    found, errors = identified(tmp_path / "dataset0.csv")
    assert (np.abs(found - TRUTH) < 1.96 * errors).all()  # with the default seed
    data = load_dataset(tmp_path / "dataset0.npz")
    assert data.measured is not None and data.candidates.shape == (200, 50, 3)
    inside = []
    for commands, read in zip(data.candidates, data.measured, strict=True):
        fit = jaxcal.identify(RANGES.denormalise(commands), read)
        low, high = fit.confidence_intervals().T
        truth = np.concatenate([np.diag(SCALE).ravel(), BIAS_DEG])
        inside.append((low < truth) & (truth < high))
    assert abs(np.mean(inside) - 0.95) < 0.02  # of 2,400 intervals


# -- recordings ------------------------------------------------------------------------

POOL = "role,u_deg_pitch,u_deg_yaw,u_deg_roll,y_deg_pitch,y_deg_yaw,y_deg_roll,samples"
ROW = "\np,1,2,3,4,5,6,7"


def pool(folder: pathlib.Path, count: int, name: str = "dataset4") -> np.ndarray:
    """Write a recording whose numbers tell the posture; its (N, 6)."""
    rng = np.random.default_rng(count)
    values = rng.uniform(-20, 20, (count, 6)).round(4)
    lines = ["collect," + ",".join(map(repr, row)) + ",25" for row in values.tolist()]
    lines.append("reference,0,0,0,0,0,0,25")  # as a session ends: no posture of it
    (folder / f"{name}.csv").write_text("\n".join([POOL, *lines]) + "\n")
    return values


def rows_of(data: Dataset) -> np.ndarray:
    assert data.measured is not None and data.ranges is not None
    commands = data.ranges.denormalise(data.candidates)
    return np.concatenate([commands, data.measured], axis=-1)


def test_dataset_4_is_fifty_different_postures_of_the_pool(
    tmp_path: pathlib.Path,
) -> None:
    values = pool(tmp_path, 500)
    data = make_dataset("dataset4", seed=3, recordings=tmp_path)
    seen = np.zeros(500, int)
    for episode in rows_of(data):
        apart = np.abs(episode[:, None] - values[None]).max(axis=-1)
        numbers = apart.argmin(axis=1)
        assert apart.min(axis=1).max() < 1e-12
        assert len(set(numbers.tolist())) == 50
        seen[numbers] += 1
    assert seen.sum() == 5000
    assert seen.min() >= 1 and seen.max() <= 25  # 10 each on average, s.d. 3


def test_a_full_recording_is_taken_as_it_stands(tmp_path: pathlib.Path) -> None:
    values = pool(tmp_path, 5003)
    for seed in (0, 1):
        data = make_dataset("dataset4", seed=seed, recordings=tmp_path)
        np.testing.assert_allclose(
            rows_of(data).reshape(-1, 6), values[:5000], atol=1e-12
        )


def test_dataset_5_is_the_first_fifty_of_its_session(tmp_path: pathlib.Path) -> None:
    values = pool(tmp_path, 60, "dataset5")
    data = make_dataset("dataset5", seed=9, recordings=tmp_path)
    np.testing.assert_allclose(rows_of(data)[0], values[:50], atol=1e-12)


def test_a_data_card_can_name_other_ranges(tmp_path: pathlib.Path) -> None:
    values = pool(tmp_path, 50, "dataset5")
    card = {"ranges_deg": {"pitch": [-25, 25], "yaw": [-20, 30], "roll": [-40, 40]}}
    (tmp_path / "dataset5.json").write_text(json.dumps(card))
    data = make_dataset("dataset5", recordings=tmp_path)
    assert data.ranges is not None and data.ranges.high.tolist() == [25, 30, 40]
    np.testing.assert_allclose(rows_of(data)[0], values, atol=1e-12)


@pytest.mark.parametrize("name", RECORDED)
def test_what_ships_is_what_its_card_says(name: str) -> None:
    commands, measured, ranges, digest = read_pool(SHIPPED / f"{name}.csv")
    card = json.loads((SHIPPED / f"{name}.json").read_text())
    assert digest == card["sha256"]
    assert len(commands) == card["postures"] == {"dataset4": 500, "dataset5": 50}[name]
    assert "SIMULATED" in card["what"]
    assert ((commands >= ranges.low) & (commands <= ranges.high)).all()
    fit = jaxcal.identify(commands, measured)
    assert np.abs(np.diag(fit.matrix) - SCALE).max() < 0.02
    assert fit.noise_std.max() < 0.3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the table is empty"),
        (POOL, "no rows below the header"),
        (POOL.replace("u_deg_yaw", "yaw") + ROW, "there is no column 'u_deg_yaw'"),
        (POOL.replace("samples", "u_deg_yaw") + ROW, "'u_deg_yaw' comes twice"),
        (f"{POOL}\np,1,2,3,4,5,6", "line 2 has 7 cells, the first has 8"),
        (f"{POOL}\np,1,2,x,4,5,6,7", "line 2, column 'u_deg_roll' must .* got 'x'"),
        (f"{POOL}\np,1,2,3,4,5,nan,7", "line 2, column 'y_deg_roll' must hold a num"),
        (f"{POOL}\np,1,2,3,4,5,6,7", "needs 50 postures, the recording has 1"),
        (f"{POOL}\np,1,25,3,4,5,6,7", r"posture 1 is commanded \[1.0, 25.0, 3.0\] deg"),
    ],
)
def test_a_bad_recording_is_refused_by_line(
    tmp_path: pathlib.Path, text: str, message: str
) -> None:
    (tmp_path / "dataset4.csv").write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        make_dataset("dataset4", recordings=tmp_path)
    assert str(tmp_path / "dataset4.csv") in str(caught.value)


def test_a_missing_recording_or_a_bad_card_is_named(tmp_path: pathlib.Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"dataset4\.csv"):
        make_dataset("dataset4", recordings=tmp_path)
    pool(tmp_path, 50)
    for text in ("{", "[]", '{"ranges_deg": {"pitch": [0, 1]}}', '{"ranges_deg": 3}'):
        (tmp_path / "dataset4.json").write_text(text)
        with pytest.raises(ValueError, match=r'dataset4\.json: "ranges_deg" must give'):
            make_dataset("dataset4", recordings=tmp_path)


@pytest.mark.slow
def test_a_recording_is_made_through_the_rig(tmp_path: pathlib.Path) -> None:
    """By the commands of docs/datasets.md, for fewer postures."""
    card = json.loads((SHIPPED / "dataset5.json").read_text())
    rig = [sys.executable, "-m", "rig"]
    example = subprocess.run(
        [*rig, "example", "simulate"], stdout=subprocess.PIPE, text=True, check=True
    )
    (tmp_path / "rig.toml").write_text(f"{example.stdout}\n[session]\nseed = 5\n")
    program, *collect = card["command"].replace("--count 50", "--count 6").split()
    assert program == "jaxcal-rig"
    more = ["--config", str(tmp_path / "rig.toml"), "--out", str(tmp_path / "runs")]
    subprocess.run([*rig, *collect, *more], check=True)
    (pairs,) = (tmp_path / "runs").glob("*/pairs.csv")
    commands, *_ = read_pool(pairs)
    shipped = read_pool(SHIPPED / "dataset5.csv")[0]
    np.testing.assert_array_equal(commands, shipped[:6])


# -- the command -----------------------------------------------------------------------


def test_one_command_writes_all_six(tmp_path: pathlib.Path) -> None:
    assert main(["--out", str(tmp_path / "d"), "--seed", "2", "--episodes", "3"]) == 0
    expected = {f"{name}.{kind}" for name in NAMES for kind in ("npz", "csv", "json")}
    assert {path.name for path in (tmp_path / "d").iterdir()} == expected
    for name in NAMES:
        binary = load_dataset(tmp_path / "d" / f"{name}.npz")
        text = load_dataset(tmp_path / "d" / f"{name}.csv")
        again = make_dataset(name, 2, min(3, EPISODES[name]))
        np.testing.assert_array_equal(binary.candidates, again.candidates)
        np.testing.assert_array_equal(text.candidates, again.candidates)
        card = json.loads((tmp_path / "d" / f"{name}.json").read_text())
        for kind in ("npz", "csv"):
            data = (tmp_path / "d" / f"{name}.{kind}").read_bytes()
            assert card["files"][f"{name}.{kind}"] == hashlib.sha256(data).hexdigest()
        assert card["seed"] == 2
        assert card["arrays"]["candidates"]["shape"] == list(again.candidates.shape)
        assert ("measured" in card["arrays"]) == (again.measured is not None)
        if again.measured is not None:
            assert binary.measured is not None and text.measured is not None
            np.testing.assert_array_equal(binary.measured, again.measured)
            np.testing.assert_array_equal(text.measured, again.measured)
            assert card["arrays"]["measured"]["unit"] == "degrees"
        assert list(card["ranges_deg"]) == ["pitch", "yaw", "roll"]
        assert all(ends == [-20, 20] for ends in card["ranges_deg"].values())
    noise = json.loads((tmp_path / "d" / "dataset3.json").read_text())["noise"]
    assert noise["std_deg"] == NOISE_STD_DEG


def test_the_command_refuses_by_one_line(
    tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = str(tmp_path / "d")
    for arguments, message in (
        (
            [folder, "--episodes", "0"],
            "--episodes: must be a whole number of at least 1, got '0'",
        ),
        (
            [folder, "--seed", "-1", "dataset2"],
            "--seed: must be a whole number of at least 0, got '-1'",
        ),
    ):
        with pytest.raises(SystemExit) as caught:
            main(["--out", *arguments])
        assert caught.value.code == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
        assert not (tmp_path / "d").exists()
    assert main(["--out", folder, "dataset7"]) == 2
    assert "names must be of dataset0, dataset1" in capsys.readouterr().err
    assert main(["--out", folder, "--formats", "npz,xls"]) == 2
    assert "formats must be of npz, csv, got xls" in capsys.readouterr().err
    assert not (tmp_path / "d").exists()
    assert main(["--out", folder, "--recordings", folder, "dataset4"]) == 2
    assert "dataset4.csv: No such file" in capsys.readouterr().err
    (tmp_path / "file").touch()
    assert main(["--out", str(tmp_path / "file"), "dataset2"]) == 2
    assert "is not a folder" in capsys.readouterr().err


# -- files -----------------------------------------------------------------------------


def example(
    seed: int = 0, n: int = 3, m: int | None = 3, masked: bool = False
) -> Dataset:
    rng = np.random.default_rng(seed)
    return Dataset(
        "x",
        rng.normal(size=(4, 6, n)) * 10.0 ** rng.integers(-8, 8),
        None if m is None else rng.normal(size=(4, 6, m)),
        rng.random((4, 6)) < 0.7 if masked else None,
    )


@given(
    st.integers(0, 2**31),
    st.integers(1, 5),
    st.one_of(st.none(), st.integers(1, 4)),
    st.booleans(),
    st.sampled_from(["npz", "csv"]),
)
@settings(max_examples=40)
def test_files_keep_every_bit(
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    n: int,
    m: int | None,
    masked: bool,
    kind: str,
) -> None:
    path = tmp_path_factory.mktemp("files") / f"data.{kind}"
    data = example(seed, n, m, masked)
    (save_npz if kind == "npz" else save_csv)(data, path)
    back = load_dataset(path)
    np.testing.assert_array_equal(back.candidates, data.candidates)
    for name in ("measured", "available"):
        expected, value = getattr(data, name), getattr(back, name)
        assert (expected is None) == (value is None)
        if expected is not None:
            np.testing.assert_array_equal(value, expected)
    assert back.name == path.name and back.sha256 is not None
    assert (back.num_inputs, back.num_outputs) == (n, n if m is None else m)


def test_npz_keeps_the_ranges(tmp_path: pathlib.Path) -> None:
    save_npz(make_dataset("dataset3", episodes=2), tmp_path / "d.npz")
    back = load_dataset(tmp_path / "d.npz")
    assert back.ranges is not None
    np.testing.assert_array_equal(back.ranges.low, RANGES.low)
    np.testing.assert_array_equal(back.ranges.high, RANGES.high)


def test_csv_lines_may_come_in_any_order_and_bear_any_labels(
    tmp_path: pathlib.Path,
) -> None:
    path = tmp_path / "d.csv"
    path.write_text(
        "\ufeffcandidate,u_b, u_a ,episode\r\n7,1,2,20\r\n3,3,4,20\r\n\r\n"
        "0,7,8,-1\r\n1,5,6,-1\r\n",
        encoding="utf-8",
    )
    back = load_dataset(path)
    np.testing.assert_array_equal(back.candidates, [[[7, 8], [5, 6]], [[3, 4], [1, 2]]])


HEAD = "episode,candidate,u_x,u_y,u_z"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the table is empty"),
        ("\n", "the table is empty"),
        (HEAD, "no rows below the header"),
        ("0,0,1,2,3", "column 'episode' is missing"),
        ("episode,u_x\n0,1", "column 'candidate' is missing; columns: episode, u_x"),
        ("episode,candidate\n0,1", "no column of commands"),
        (f"{HEAD},speed\n0,0,1,2,3,4", "unknown column 'speed'"),
        (f"{HEAD},u_x\n0,0,1,2,3,4", "column 'u_x' comes twice"),
        (f"{HEAD}\n0,0,1,2,3\n0,1,1,x,3", "line 3, column 'u_y' must hold .* got 'x'"),
        (f"{HEAD}\n0,0,1,2,3\n0,1,1,,3", "line 3, column 'u_y' .* an empty cell"),
        (f"{HEAD}\n0,0,1,2,nan", "line 2, column 'u_z' must hold a number, got nan"),
        (f"{HEAD}\n0,0,1,2,1e999", "line 2, column 'u_z' must hold a number, got inf"),
        (f"{HEAD}\n0,0,1,2", "line 2 has 4 cells, the first has 5"),
        (f"{HEAD}\n0,0,1,2,3,4", "line 2 has 6 cells, the first has 5"),
        (f"{HEAD}\n0.5,0,1,2,3", "line 2, episode must be a whole number"),
        (f"{HEAD}\n0,9999999999999999999,1,2,3", "whole number of at most"),
        (
            f"{HEAD}\n0,0,1,2,3\n0,0,1,2,3",
            "line 3 repeats candidate 0 of episode 0 of line 2",
        ),
        (
            f"{HEAD}\n0,0,1,2,3\n0,1,1,2,3\n7,0,1,2,3",
            "episode 0 has 2, episode 7 has 1",
        ),
        (f"{HEAD},available\n0,0,1,2,3,yes", "line 2, column 'available' must hold a"),
        (f"{HEAD},available\n0,0,1,2,3,2", "line 2, available must be 1 or 0"),
        (f'{HEAD}\n0,0,1,2,"3\n0,1,1,2,3', "line 2"),
    ],
)
def test_a_malformed_csv_is_refused_by_line(
    tmp_path: pathlib.Path, text: str, message: str
) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        load_dataset(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_csv_that_is_no_text_is_refused_by_line(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "bad.csv"
    path.write_bytes(HEAD.encode() + b"\n0,0,1,2,\xff")
    with pytest.raises(ValueError, match="line 2 is not UTF-8"):
        load_dataset(path)
    path.write_bytes(os.urandom(4000))
    with pytest.raises(ValueError, match="line"):
        load_dataset(path)


GOOD = np.arange(30.0).reshape(2, 5, 3)
HOLED = GOOD.copy()
HOLED[1, 2, 0] = np.nan


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"postures": GOOD}, 'key "candidates" is missing, found postures'),
        ({}, 'key "candidates" is missing, found nothing'),
        ({"candidates": GOOD[0]}, r"candidates must have shape .* got \(5, 3\)"),
        ({"candidates": GOOD[:, :0]}, r"no axis of length 0, got \(2, 0, 3\)"),
        ({"candidates": HOLED}, r"must be finite, got nan at \(1, 2, 0\)"),
        ({"candidates": GOOD, "measured": HOLED}, "measured must be finite, got nan"),
        ({"candidates": GOOD, "measured": GOOD[:1]}, "measured must have shape"),
        ({"candidates": GOOD.astype(str)}, "must hold numbers, got dtype <U"),
        ({"candidates": GOOD + 1j}, "must hold numbers, got dtype complex128"),
        ({"candidates": GOOD, "available": GOOD[..., 0]}, "available must be 1 or 0"),
        (
            {"candidates": GOOD, "available": np.ones((2, 4))},
            "available must have shape",
        ),
        ({"candidates": GOOD, "low": [0, 0, 0]}, '"low" and "high" must come together'),
        ({"candidates": GOOD, "low": [0], "high": [1]}, "must hold 3 numbers, got 1"),
        ({"candidates": GOOD, "low": [1] * 3, "high": [0] * 3}, "low must be below"),
    ],
)
def test_a_malformed_npz_is_refused_by_key(
    tmp_path: pathlib.Path, arrays: dict[str, object], message: str
) -> None:
    path = tmp_path / "bad.npz"
    np.savez(path, **arrays)  # type: ignore[arg-type]  # arrays by name
    with pytest.raises(ValueError, match=message) as caught:
        load_dataset(path)
    assert str(path) in str(caught.value)


def test_objects_are_never_unpickled(tmp_path: pathlib.Path) -> None:
    ragged = np.empty(2, dtype=object)
    ragged[:] = [GOOD[0], GOOD[1, :3]]
    np.savez(tmp_path / "bad.npz", candidates=ragged)
    with pytest.raises(ValueError, match=r'"candidates" .*ragged episodes'):
        load_dataset(tmp_path / "bad.npz")


def test_a_truncated_npz_is_refused_at_every_length(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "d.npz"
    np.savez(path, candidates=GOOD)
    data = path.read_bytes()
    for length in range(len(data) - 1, -1, -37):
        path.write_bytes(data[:length])
        with pytest.raises(ValueError, match=r"truncated|empty|damaged|not a \.npz"):
            load_dataset(path)


def test_a_flipped_byte_is_refused_or_harmless(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "d.npz"
    np.savez_compressed(path, candidates=GOOD)
    data = bytearray(path.read_bytes())
    for place in range(len(data)):
        damaged = data.copy()
        damaged[place] ^= 0xFF
        path.write_bytes(damaged)
        try:
            back = load_dataset(path)
        except ValueError as error:
            assert str(path) in str(error)
        else:
            np.testing.assert_array_equal(back.candidates, GOOD)


def test_other_files_are_refused(tmp_path: pathlib.Path) -> None:
    np.save(tmp_path / "single.npy", GOOD)
    (tmp_path / "single.npy").rename(tmp_path / "single.npz")
    with pytest.raises(ValueError, match="a single array"):
        load_dataset(tmp_path / "single.npz")
    (tmp_path / "d.txt").write_text("x")
    with pytest.raises(ValueError, match=r"must be a \.npz or \.csv file"):
        load_dataset(tmp_path / "d.txt")
    with pytest.raises(FileNotFoundError):
        load_dataset(tmp_path / "none.npz")
    with pytest.raises(IsADirectoryError):
        load_dataset(tmp_path)


def test_a_failed_save_leaves_the_old_file(
    tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "d.npz"
    save_npz(example(), path)
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    for save, name in ((save_npz, "d.npz"), (save_csv, "d.csv")):
        with pytest.raises(OSError, match="No space left"):
            save(example(1), tmp_path / name)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["d.npz"]


def test_a_dataset_in_pulses_can_carry_its_ranges(tmp_path: pathlib.Path) -> None:
    data = Dataset("x", GOOD, ranges=JointRanges([0] * 3, [30] * 3))
    save_npz(data, tmp_path / "d.npz")
    back = load_dataset(tmp_path / "d.npz")
    assert back.ranges is not None and back.ranges.high.tolist() == [30, 30, 30]
