"""Joint ranges."""

from __future__ import annotations

import numpy as np
import pytest

from jaxcal.candidates import JointRanges

RANGES = JointRanges([-20, -15, 0], [20, 30, 5])


def test_normalise_and_denormalise_are_inverse(rng: np.random.Generator) -> None:
    degrees = rng.uniform(RANGES.low, RANGES.high, (2, 9, 3))
    unit = RANGES.normalise(degrees)
    assert unit.min() >= 0 and unit.max() <= 1
    np.testing.assert_allclose(RANGES.denormalise(unit), degrees, rtol=1e-12)


def test_ends_map_to_zero_and_one() -> None:
    np.testing.assert_array_equal(
        RANGES.normalise([[-20, -15, 0], [20, 30, 5], [0, 7.5, 2.5]]),
        [[0, 0, 0], [1, 1, 1], [0.5, 0.5, 0.5]],
    )


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        ([0, 0], [1, 0], r"low must be below high .* got \(0, 0\) and \(1, 0\)"),
        ([0, 0], [1], r"shapes \(2,\) and \(1,\)"),
        ([0, np.nan], [1, 1], r"low must be finite, got nan at \(1,\)"),
        ([0], [np.inf], "high must be finite"),
        (["x"], [1], "low must be an array of numbers"),
    ],
)
def test_bad_ranges_are_named(low: object, high: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        JointRanges(low, high)  # type: ignore[arg-type]  # bad on purpose
