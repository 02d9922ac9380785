"""The local search against every run, and tours too long for Held and Karp."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from questions import pareto_front, select_fastest

import jaxcal
from jaxcal.designs.travel import Motion, fastest_tour, travel_times
from jaxcal.information.regression import log_det_gram

MOTION = Motion(speed=(20.0, 10.0, 30.0), acceleration=(50.0, 100.0, 20.0), settle=0.5)
HOME = np.zeros(3)


def drawn(seed, m=12):
    return np.random.default_rng(seed).uniform(-20, 20, (m, 3))


def every_run(candidates, k=4, start=HOME):
    """log det(Z.T Z) and least seconds of every subset, by permutation."""
    between = travel_times(candidates, candidates, MOTION)
    begin = travel_times(start[None], candidates, MOTION)[0]
    subsets = np.array(list(itertools.combinations(range(len(candidates)), k)))
    least = np.full(len(subsets), np.inf)
    for turn in itertools.permutations(range(k)):
        q = subsets[:, turn]
        way = begin[q[:, 0]] + between[q[:, :-1], q[:, 1:]].sum(axis=1)
        least = np.minimum(least, way + k * MOTION.settle)
    return np.array([log_det_gram(candidates[list(s)]) for s in subsets]), least


def test_the_run_is_efficient_enough_and_close_to_the_fastest():
    excess = []
    for seed in range(4):
        candidates = drawn(seed)
        value, seconds = every_run(candidates)
        efficiency = np.exp((value - value.max()) / 4)
        for least in (0.7, 0.9, 1.0):
            found = select_fastest(
                candidates,
                motion=MOTION,
                start=HOME,
                least_efficiency=least,
            )
            assert found.efficiency >= least - 1e-9
            assert not found.proven
            at = np.isclose(value, log_det_gram(candidates[found.indices]))
            assert found.seconds == pytest.approx(seconds[at].min(), abs=1e-9)
            fastest = seconds[efficiency >= least - 1e-12].min()
            excess.append(found.seconds / fastest - 1.0)
    assert min(excess) >= -1e-9
    assert np.mean(excess) < 0.005
    assert np.mean(np.array(excess) < 1e-9) > 0.7


@pytest.mark.parametrize("required", [[5, 7, 4], [4, 5, 6, 7]])
def test_masked_and_required_postures_are_respected(required):
    found = select_fastest(
        drawn(9),
        motion=MOTION,
        least_efficiency=0.6,
        available=np.arange(12) >= 3,
        required=required,
    )
    assert set(required) <= set(found.indices.tolist())
    assert found.indices.min() >= 3 and len(set(found.indices.tolist())) == 4


def test_the_front_ascends_to_the_optimum_and_is_never_faster_than_the_proven_one():
    candidates = drawn(11)
    value, seconds = every_run(candidates)
    efficiency = np.exp((value - value.max()) / 4)
    front = pareto_front(candidates, motion=MOTION, start=HOME)
    points = front.points
    assert not front.proven and len(points) >= 3
    assert points[-1].efficiency == pytest.approx(1.0, abs=1e-9)
    for before, after in itertools.pairwise(points):
        assert before.seconds < after.seconds
        assert before.efficiency < after.efficiency
    for point in points:
        fastest = seconds[efficiency >= point.efficiency - 1e-9].min()
        assert point.seconds >= fastest - 1e-9


def test_k_is_the_fewest_that_identify_where_not_given():
    planar = np.random.default_rng(3).uniform(-20, 20, (10, 2))
    found = select_fastest(planar, motion=Motion((20.0,), (100.0,)))
    assert len(found.indices) == 3


def test_an_answer_stays_when_the_callers_array_changes():
    candidates = drawn(4)
    found = select_fastest(candidates, motion=MOTION)
    told = jaxcal.log_det_information(candidates[found.indices])
    candidates[:] = 0.0
    assert found.log_det == pytest.approx(told)


# Tours too long for Held and Karp


@given(st.integers(0, 2**31), st.booleans())
def test_a_long_tour_is_locally_optimal(seed, started):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-30, 30, (15, 3))
    t = travel_times(points, points, MOTION)
    start = rng.random(15) if started else np.zeros(15)

    def seconds(order):
        return start[order[0]] + t[order[:-1], order[1:]].sum()

    order, told = fastest_tour(t, start if started else None)
    assert sorted(order.tolist()) == list(range(15))
    assert told == pytest.approx(seconds(order), abs=1e-9)
    for i, j in itertools.combinations(range(15), 2):
        reverse = np.r_[order[:i], order[i : j + 1][::-1], order[j + 1 :]]
        later = np.insert(np.delete(order, i), j, order[i])
        assert min(seconds(reverse), seconds(later)) >= told - 1e-9


def test_hundreds_of_postures_are_ordered_in_a_moment(rng):
    points = rng.uniform(-30, 30, (200, 3))
    order, _ = fastest_tour(travel_times(points, points, MOTION))
    assert sorted(order.tolist()) == list(range(200))


@pytest.mark.parametrize(
    ("times", "start", "words"),
    [
        (np.zeros((2, 3)), None, r"times must have shape \(K, K\), got \(2, 3\)"),
        (np.zeros((0, 0)), None, r"times must have shape \(K, K\), got \(0, 0\)"),
        ([[0.0, 1.0], [2.0, 0.0]], None, "symmetric, got 1 from 0 to 1 and 2 back"),
        (np.zeros((2, 2)), [0.0], r"start must have shape \(2,\), got \(1,\)"),
    ],
)
def test_a_tour_through_nonsense_is_refused(times, start, words):
    with pytest.raises(ValueError, match=words):
        fastest_tour(times, start)
