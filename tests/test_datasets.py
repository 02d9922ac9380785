"""The paper's datasets by seed, and dataset files good and bad."""

from __future__ import annotations

import os
import pathlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.candidates import JointRanges
from jaxcal.study.dataset_files import load_dataset, save_csv, save_npz
from jaxcal.study.datasets import (
    BIAS_DEG,
    EPISODES,
    NAMES,
    NOISE_STD_DEG,
    RANGES,
    SCALE,
    Dataset,
    chunks,
    make_dataset,
)

# A loaded machine is no failure.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")


# -- generation ------------------------------------------------------------------------


def test_sizes_are_those_of_table_3() -> None:
    two, three = make_dataset("dataset2"), make_dataset("dataset3")
    assert EPISODES == {"dataset1": 200_000, "dataset2": 1_000, "dataset3": 100}
    assert two.candidates.shape == (1000, 50, 3) and two.measured is None
    assert three.candidates.shape == (100, 50, 3)
    assert three.measured is not None and three.measured.shape == (100, 50, 3)
    first = next(chunks("dataset1"))
    assert first.candidates.shape == (1000, 50, 3) and first.measured is None


@pytest.mark.slow
def test_the_whole_of_dataset_1_comes_in_chunks() -> None:
    total, mean = 0, np.zeros(3)
    for chunk in chunks("dataset1"):
        total += chunk.num_episodes
        mean += chunk.candidates.sum(axis=(0, 1))
    assert total == 200_000
    np.testing.assert_allclose(mean / total / 50, 0.5, atol=1e-3)


@pytest.mark.parametrize("name", NAMES)
def test_candidates_are_uniform_in_the_unit_cube(name: str) -> None:
    points = make_dataset(name, episodes=100).candidates.reshape(-1, 3)
    assert points.min() >= 0.0 and points.max() < 1.0
    np.testing.assert_allclose(points.mean(axis=0), 0.5, atol=0.02)
    np.testing.assert_allclose(points.var(axis=0), 1 / 12, atol=0.005)


@pytest.mark.parametrize("name", NAMES)
def test_the_seed_decides_and_fewer_are_the_first_of_more(name: str) -> None:
    whole = make_dataset(name, 5, 60)
    part = make_dataset(name, 5, 20)
    np.testing.assert_array_equal(part.candidates, whole.candidates[:20])
    assert not np.array_equal(make_dataset(name, 6, 20).candidates, part.candidates)
    if whole.measured is not None and part.measured is not None:
        np.testing.assert_array_equal(part.measured, whole.measured[:20])


def test_chunks_are_the_dataset() -> None:
    pieces = list(chunks("dataset1", 3, 2500))
    assert [piece.num_episodes for piece in pieces] == [1000, 1000, 500]
    np.testing.assert_array_equal(
        np.concatenate([piece.candidates for piece in pieces]),
        make_dataset("dataset1", 3, 2500).candidates,
    )


def test_no_dataset_shares_a_candidate_with_another_or_with_itself() -> None:
    parts = [
        make_dataset("dataset1", episodes=3000).candidates,
        make_dataset("dataset1", seed=1, episodes=1000).candidates,
        make_dataset("dataset2").candidates,
        make_dataset("dataset3").candidates,
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
        (("dataset9",), "name must be one of dataset1, dataset2, dataset3"),
        (("dataset2", -1), "seed must not be negative, got -1"),
        (("dataset2", 0, 0), r"episodes must be in \[1, 1000\] for dataset2, got 0"),
        (("dataset3", 0, 101), r"episodes must be in \[1, 100\] for dataset3, got 101"),
    ],
)
def test_bad_requests_are_named(arguments: tuple[object, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        chunks(*arguments)  # type: ignore[arg-type]  # bad on purpose


def test_bad_arrays_are_named() -> None:
    good = np.zeros((2, 5, 3))
    with pytest.raises(ValueError, match=r"candidates must have shape"):
        Dataset("x", good[0])
    with pytest.raises(ValueError, match=r"measured must have shape \(2, 5, 'm'\)"):
        Dataset("x", good, good[:1])
    with pytest.raises(ValueError, match=r"available must have shape \(2, 5\)"):
        Dataset("x", good, available=np.ones((2, 4), bool))
    with pytest.raises(ValueError, match=r"episodes must be in \[1, 2\] for x, got 3"):
        Dataset("x", good).first(3)


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
        ("", "the file is empty"),
        ("\n", 'line 1: column "episode" is missing'),
        (HEAD, "no candidates below the header"),
        ("episode,u_x\n0,1", 'line 1: column "candidate" is missing'),
        ("episode,candidate\n0,1", "line 1: no input column"),
        (f"{HEAD},speed\n0,0,1,2,3,4", 'line 1: unknown column "speed"'),
        (f"{HEAD},u_x\n0,0,1,2,3,4", 'line 1: column "u_x" comes twice'),
        (f"{HEAD}\n0,0,1,2,3\n0,1,1,x,3", "line 3: \"u_y\" must be a number, got 'x'"),
        (f"{HEAD}\n0,0,1,2,3\n0,1,1,,3", "line 3: \"u_y\" must be a number, got ''"),
        (f"{HEAD}\n0,0,1,2,nan", 'line 2: "u_z" must be finite'),
        (f"{HEAD}\n0,0,1,2,1e999", 'line 2: "u_z" must be finite'),
        (f"{HEAD}\n0,0,1,2", "line 2: 4 cells, 5 in the header"),
        (f"{HEAD}\n0,0,1,2,3,4", "line 2: 6 cells, 5 in the header"),
        (f"{HEAD}\n0.5,0,1,2,3", 'line 2: "episode" must be a whole number'),
        (f"{HEAD}\n0,9999999999999999999,1,2,3", "out of range"),
        (
            f"{HEAD}\n0,0,1,2,3\n0,0,1,2,3",
            "line 3: candidate 0 of episode 0 was already given in line 2",
        ),
        (
            f"{HEAD}\n0,0,1,2,3\n0,1,1,2,3\n7,0,1,2,3",
            "episode 0 has 2, episode 7 has 1",
        ),
        (f"{HEAD},available\n0,0,1,2,3,yes", 'line 2: "available" must be a number'),
        (f"{HEAD},available\n0,0,1,2,3,2", 'line 2: "available" must be 0 or 1'),
        (f'{HEAD}\n0,0,1,2,"3\n0,1,1,2,3', "line 3"),
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
    with pytest.raises(ValueError, match="line 2: not UTF-8"):
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
        ({"candidates": GOOD[0]}, r'"candidates" must have shape .* got \(5, 3\)'),
        ({"candidates": GOOD[:, :0]}, r"none of them 0, got \(2, 0, 3\)"),
        ({"candidates": HOLED}, "got nan in episode 1, row 2, axis 0"),
        ({"candidates": GOOD, "measured": HOLED}, '"measured" must be finite, got nan'),
        ({"candidates": GOOD, "measured": GOOD[:1]}, "measured must have shape"),
        ({"candidates": GOOD.astype(str)}, "must hold numbers, got dtype <U"),
        ({"candidates": GOOD + 1j}, "must hold numbers, got dtype complex128"),
        ({"candidates": GOOD, "available": GOOD[..., 0]}, "must hold true and false"),
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
