"""Joint ranges, sampling and availability."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.candidates import (
    JointRanges,
    draw_from_pool,
    uniform_candidates,
)
from jaxcal.information.regression import log_det_information

# A loaded machine is no failure.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")

ranges_of_three = JointRanges([-20, -15, 0], [20, 30, 5], ["pitch", "yaw", "roll"])
seeds = st.integers(0, 2**32 - 1)


def spread(rng: np.random.Generator, num_sets: int, count: int) -> np.ndarray:
    """Candidate sets over the ranges, in degrees."""
    return ranges_of_three.denormalise(uniform_candidates(rng, num_sets, count))


@given(seeds)
def test_normalise_and_denormalise_are_inverse(seed: int) -> None:
    degrees = spread(np.random.default_rng(seed), 2, 9)
    unit = ranges_of_three.normalise(degrees)
    assert unit.min() >= -1e-15 and unit.max() <= 1 + 1e-15
    np.testing.assert_allclose(
        ranges_of_three.denormalise(unit), degrees, rtol=1e-12, atol=1e-12
    )


def test_ends_map_to_zero_and_one() -> None:
    np.testing.assert_array_equal(
        ranges_of_three.normalise([[-20, -15, 0], [20, 30, 5], [0, 7.5, 2.5]]),
        [[0, 0, 0], [1, 1, 1], [0.5, 0.5, 0.5]],
    )


def test_log_det_scale_is_the_constant_between_units(
    rng: np.random.Generator,
) -> None:
    degrees = spread(rng, 20, 5)
    unit = ranges_of_three.normalise(degrees)
    difference = np.asarray(log_det_information(degrees)) - log_det_information(unit)
    np.testing.assert_allclose(difference, ranges_of_three.log_det_scale, atol=1e-9)


def test_uniform_candidates_fill_the_ranges(rng: np.random.Generator) -> None:
    drawn = spread(rng, 100, 200)
    assert drawn.shape == (100, 200, 3)
    assert np.all(ranges_of_three.contains(drawn))
    flat = ranges_of_three.normalise(drawn).reshape(-1, 3)
    np.testing.assert_allclose(flat.mean(axis=0), 0.5, atol=0.01)
    np.testing.assert_allclose(flat.var(axis=0), 1 / 12, atol=0.002)
    assert np.abs(np.corrcoef(flat.T) - np.eye(3)).max() < 0.03


def test_the_seed_decides(rng: np.random.Generator) -> None:
    first = uniform_candidates(np.random.default_rng(3), 2, 5, 2)
    again = uniform_candidates(np.random.default_rng(3), 2, 5, 2)
    other = uniform_candidates(np.random.default_rng(4), 2, 5, 2)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert first.shape == (2, 5, 2)


def test_contains() -> None:
    inside, outside = [0.0, 0.0, 5.0], [0.0, 0.0, 5.0001]
    assert ranges_of_three.contains([inside, outside]).tolist() == [True, False]


@given(seeds, st.integers(1, 12))
def test_pool_draws_are_distinct_within_a_set(seed: int, count: int) -> None:
    drawn = draw_from_pool(np.random.default_rng(seed), 12, 5, count)
    assert drawn.shape == (5, count)
    assert drawn.min() >= 0 and drawn.max() < 12
    assert all(len(set(row)) == count for row in drawn.tolist())


def test_pool_draws_reach_the_whole_pool(rng: np.random.Generator) -> None:
    drawn = draw_from_pool(rng, 20, 4000, 5)
    counts = np.bincount(drawn.ravel(), minlength=20) / 4000
    np.testing.assert_allclose(counts, 0.25, atol=0.04)


def test_ranges_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        ranges_of_three.low[0] = 0.0
    with pytest.raises(AttributeError):
        ranges_of_three.low = np.zeros(3)  # type: ignore[misc]  # frozen on purpose


@pytest.mark.parametrize(
    ("low", "high", "names", "message"),
    [
        ([0, 0], [1, 0], None, r"low must be below high .*\[0, 0\] on u_2"),
        ([0, 2, 0], [1, 1, 1], ["a", "b", "c"], r"\[2, 1\] on b"),
        ([0, 0], [1], None, r"shapes \(2,\) and \(1,\)"),
        ([0, np.nan], [1, 1], None, r"low must be finite, got nan at \(1,\)"),
        ([0], [np.inf], None, "high must be finite"),
        (["x"], [1], None, "low must be an array of numbers"),
        ([0, 0], [1, 1], ["a"], "names must hold 2 names"),
    ],
)
def test_bad_ranges_are_named(
    low: object, high: object, names: object, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        JointRanges(low, high, names)  # type: ignore[arg-type]  # bad on purpose


def test_bad_sizes_are_named(rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match="num_sets must be at least 1, got 0"):
        uniform_candidates(rng, 0, 5)
    with pytest.raises(ValueError, match="num_candidates must be at least 1, got -1"):
        uniform_candidates(rng, 1, -1)
    with pytest.raises(ValueError, match=r"num_candidates must be in \[1, 5\]"):
        draw_from_pool(rng, 5, 1, 6)
    with pytest.raises(ValueError, match="num_sets must be at least 1, got 0"):
        draw_from_pool(rng, 5, 0, 5)
    with pytest.raises(ValueError, match=r"commands must have shape \(\.\.\., 3\)"):
        ranges_of_three.normalise([1.0, 2.0])
