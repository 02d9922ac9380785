"""Going on from a partial selection under a mask, against brute force.

A posture was measured already (``required``), another cannot be reached (``available``
False): what is left must still be near, or at, the best that is left.
"""

from __future__ import annotations

import itertools
import pathlib
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxcal
from jaxcal.information.regression import log_det_gram
from jaxcal.selection import exact_batch
from jaxcal.selection.policy import select_batch

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "benchmarks"))

import replanning

REST = ((4, 2), (4, 3), (6, 1), (6, 2), (6, 3))


def conditional_optimum(candidates, k, required, available):
    """log det(Z.T Z) of the best completion, by trying all of them."""
    free = [i for i in np.flatnonzero(available) if i not in required]
    rest = itertools.combinations(free, k - len(required))
    subsets = np.array([[*required, *more] for more in rest])
    return log_det_gram(candidates[subsets]).max()


def gaps_of_the_policy(sets, k, required, available):
    chosen = select_batch(sets, k, required=required, available=available)
    value = log_det_gram(np.take_along_axis(sets, chosen[..., None], axis=1))
    best = [
        conditional_optimum(*case)
        for case in zip(
            sets, [k] * len(sets), required.tolist(), available, strict=True
        )
    ]
    np.testing.assert_array_equal(chosen[:, : required.shape[1]], required)
    assert np.take_along_axis(available, chosen, axis=1).all()
    return value - np.array(best)


@pytest.mark.parametrize(
    ("k", "r"),
    [(4, 1), *(pytest.param(*c, marks=pytest.mark.slow) for c in REST)],
)
def test_the_policy_goes_on_near_the_brute_force_optimum(rng, k, r):
    sets = rng.uniform(size=(80, 14, 3))
    required, available = replanning.random_cases(sets, r, rng)
    available[:, :9] = True  # enough to choose from
    gap = gaps_of_the_policy(sets, k, required, available)
    assert (gap < 1e-9).all()
    assert np.exp(3 * gap).mean() >= 0.97


@pytest.mark.parametrize(
    "r", [2, *(pytest.param(r, marks=pytest.mark.slow) for r in (1, 3))]
)
def test_a_posture_lost_on_the_way_is_replaced_near_optimally(rng, r):
    sets = rng.uniform(size=(80, 14, 3))
    required, available = replanning.unreachable_cases(sets, 4, r)
    assert (available.sum(axis=1) == 13).all()
    gap = gaps_of_the_policy(sets, 4, required, available)
    assert np.exp(3 * gap).mean() >= 0.97


def test_the_last_posture_is_always_the_best_one(rng):
    """One choice left is arithmetic, no matter how bad the first three were."""
    sets = rng.uniform(size=(100, 14, 3))
    required, available = replanning.random_cases(sets, 3, rng)
    available[:, :8] = True
    gap = gaps_of_the_policy(sets, 4, required, available)
    np.testing.assert_allclose(gap, 0.0, atol=1e-5)


@settings(max_examples=40)
@given(st.integers(0, 2**31), st.integers(0, 3), st.sampled_from([4, 5]))
def test_the_exact_conditional_optimum_is_that_of_brute_force(seed, r, k):
    rng = np.random.default_rng(seed)
    candidates = rng.uniform(size=(10, 3))
    required = rng.permutation(10)[:r]
    available = rng.uniform(size=10) < 0.8
    available[required] = True
    available[rng.permutation(10)[:6]] = True
    found = jaxcal.select(
        candidates, k, "exact", required=required, available=available
    )
    best = conditional_optimum(candidates, k, required.tolist(), available)
    assert found.proven
    assert found.log_det == pytest.approx(3 * best, abs=1e-8)


def test_a_lost_posture_never_helps_and_a_found_one_never_hurts(rng):
    sets = rng.uniform(size=(40, 20, 3))
    whole = exact_batch(sets, 5)
    available = np.ones((40, 20), bool)
    available[np.arange(40), whole.indices[:, 0]] = False
    without = exact_batch(sets, 5, available=available)
    assert (without.log_det <= whole.log_det + 1e-9).all()
    kept = exact_batch(sets, 5, required=whole.indices[:, :2])
    np.testing.assert_allclose(kept.log_det, whole.log_det, atol=1e-8)


def test_what_is_complete_already_is_left_alone(rng):
    candidates = rng.uniform(size=(14, 3))
    found = jaxcal.select(candidates, 4, "policy", required=[3, 9, 1, 7])
    assert found.indices.tolist() == [3, 9, 1, 7]


def test_required_and_unreachable_at_once_is_refused(rng):
    available = np.ones(14, bool)
    available[3] = False
    with pytest.raises(ValueError, match="required must be available, got 3"):
        jaxcal.select(
            rng.uniform(size=(14, 3)), 4, required=[3, 5], available=available
        )
