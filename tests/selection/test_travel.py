"""The look-ahead, the last two postures and long tours, against plain enumeration."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import jaxcal
from jaxcal.information.regression import log_det_gram
from jaxcal.selection.fastest import (
    Motion,
    fastest_tour,
    pareto_front,
    select_fastest,
    travel_times,
)
from jaxcal.selection.fastest import lookahead as rule
from jaxcal.selection.fastest.task import make_task

MOTION = Motion(speed=(20.0, 10.0, 30.0), acceleration=(50.0, 100.0, 20.0), settle=0.5)
HOME = np.zeros(3)


def drawn(seed, m=12):
    return np.random.default_rng(seed).uniform(-20, 20, (m, 3))


def task_of(candidates, k=4, **given):
    given = {"available": None, "required": None} | given
    return make_task(candidates, k, MOTION, start=HOME, **given)


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
    return (
        subsets,
        np.array([log_det_gram(candidates[list(s)]) for s in subsets]),
        least,
    )


def run_of(task, price, num=1):
    """(num, k) runs at one price of a mean move, into the pool."""
    x = np.ascontiguousarray(task.blocks[:, 0].T) * np.sqrt(len(task.blocks))
    each = np.array([price / task.times.mean()])
    return rule._runs(x, task.times, task.start, each, task.fixed, task.k, num)


def worth_of(task, price, order):
    """log det of the run's whitened rows less the tolls of its moves."""
    toll = price / task.times.mean()
    moves = sum(task.times[i, j] for i, j in itertools.pairwise(order))
    x = task.blocks[list(order), 0] * np.sqrt(len(task.blocks))
    gram = x @ x.T if len(order) <= x.shape[1] else x.T @ x
    return np.linalg.slogdet(gram)[1] - toll * (task.start[order[0]] + moves)


@pytest.mark.slow
@pytest.mark.parametrize("price", [0.0, 0.3, 3.0])
def test_the_first_posture_is_where_greedy_leads_furthest(price):
    task = task_of(drawn(1))
    ends = {}
    for first in range(12):
        order = [first]
        for _ in range(3):
            rest = [j for j in range(12) if j not in order]
            order.append(max(rest, key=lambda j: worth_of(task, price, [*order, j])))
        ends[first] = worth_of(task, price, order)
    run = run_of(task, price)[0]
    assert ends[run[0]] == pytest.approx(max(ends.values()), abs=1e-9)
    firsts = run_of(task, price, num=5)[:, 0]
    assert sorted(ends.values())[-5:] == pytest.approx(
        sorted(ends[first] for first in firsts)
    )


@pytest.mark.parametrize(
    "price", [0.3, *(pytest.param(p, marks=pytest.mark.slow) for p in (0.0, 3.0))]
)
def test_the_last_two_choices_are_the_best_pair_in_order(price):
    for seed in range(5):
        task = task_of(drawn(seed))
        run = run_of(task, price)[0]
        best = max(
            worth_of(task, price, [*run[:2], *pair])
            for pair in itertools.permutations(set(range(12)) - set(run[:2]), 2)
        )
        assert worth_of(task, price, run) == pytest.approx(best, abs=1e-6)


def test_a_high_price_keeps_the_device_near_its_start():
    task = task_of(drawn(2))

    def seconds(order):
        return task.start[order[0]] + task.times[order[:-1], order[1:]].sum()

    assert seconds(run_of(task, 100.0)[0]) < seconds(run_of(task, 0.01)[0])


def test_masked_and_given_postures_are_in_every_run():
    task = task_of(drawn(9), 5, available=np.arange(12) >= 3, required=[6, 4])
    runs = task.pool[rule.lookahead_runs(task, rule.PRICES, 8)]
    for run in runs:
        assert run[:2].tolist() == [6, 4]
        assert len(set(run.tolist())) == 5 and run.min() >= 3


def test_the_last_two_of_a_run_are_the_soonest_pair_that_will_do(rng):
    task = task_of(drawn(10))
    subsets, _, _ = every_run(drawn(10))
    values = np.array([task_value(task, s) for s in subsets])
    wanted = values.max() + 4 * np.log(0.8)
    runs = subsets[rng.permutation(len(subsets))[:3]]
    chosen = rule.complete(task, runs, wanted)
    ways = [
        task.tour(np.array([*before, *pair]))[1]
        for before in runs[:, :2].tolist()
        for pair in itertools.combinations(set(range(12)) - set(before), 2)
        if task_value(task, [*before, *pair]) >= wanted
    ]
    if ways:
        assert chosen is not None and task_value(task, chosen) >= wanted
        assert task.tour(chosen)[1] == pytest.approx(min(ways), abs=1e-9)
    else:
        assert chosen is None


def task_value(task, chosen):
    x = task.blocks[list(chosen), 0]
    return np.linalg.slogdet(x.T @ x)[1]


def test_the_run_is_efficient_enough_and_close_to_the_fastest():
    excess = []
    for seed in range(4):
        candidates = drawn(seed)
        _, value, seconds = every_run(candidates)
        efficiency = np.exp((value - value.max()) / 4)
        for least in (0.7, 0.9, 1.0):
            found = select_fastest(
                candidates,
                motion=MOTION,
                start=HOME,
                least_efficiency=least,
                method="lookahead",
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


def test_time_worth_nothing_leaves_the_optimum():
    for seed in range(3):
        candidates = drawn(seed)
        free = select_fastest(candidates, motion=MOTION, start=HOME, weight=0.0)
        assert free.method == "lookahead"
        assert free.efficiency >= 1.0 - 1e-9


def test_a_weighted_run_is_near_the_best_of_all():
    candidates = drawn(5)
    _, value, seconds = every_run(candidates)
    log_efficiency = (value - value.max()) / 4
    travel = seconds - 4 * MOTION.settle
    for weight in (0.02, 0.2, 1.0, 1e6):
        found = select_fastest(candidates, motion=MOTION, start=HOME, weight=weight)
        best = (log_efficiency - weight * travel).max()
        got = np.log(found.efficiency) - weight * found.travel_seconds
        assert best - max(0.05, 1e-3 * abs(best)) <= got <= best + 1e-6


def test_dearer_time_is_never_answered_with_a_slower_run():
    candidates = drawn(6)
    seconds = [
        select_fastest(candidates, motion=MOTION, start=HOME, weight=w).seconds
        for w in (0.0, 0.1, 2.0)
    ]
    assert seconds[0] > seconds[2]
    assert seconds == sorted(seconds, reverse=True)


def test_another_unit_of_time_changes_no_choice():
    candidates = drawn(7)
    faster = Motion(
        speed=tuple(8.0 * np.array(MOTION.speed)),
        acceleration=tuple(64.0 * np.array(MOTION.acceleration)),
        settle=MOTION.settle / 8.0,
    )
    slow = select_fastest(candidates, motion=MOTION, start=HOME, weight=0.2)
    fast = select_fastest(candidates, motion=faster, start=HOME, weight=1.6)
    assert fast.indices.tolist() == slow.indices.tolist()
    assert fast.seconds == pytest.approx(slow.seconds / 8.0)


def test_the_order_of_the_candidates_changes_no_time(rng):
    candidates = drawn(8)
    turn = rng.permutation(len(candidates))
    seconds = [
        select_fastest(
            points,
            motion=MOTION,
            start=HOME,
            least_efficiency=0.85,
            method="lookahead",
        ).seconds
        for points in (candidates, candidates[turn])
    ]
    assert seconds[0] == pytest.approx(seconds[1], abs=1e-9)


@pytest.mark.parametrize("required", [[5, 7, 4], [4, 5, 6, 7]])
def test_masked_and_required_postures_are_respected(required):
    found = select_fastest(
        drawn(9),
        motion=MOTION,
        least_efficiency=0.6,
        available=np.arange(12) >= 3,
        required=required,
        method="lookahead",
    )
    assert set(required) <= set(found.indices.tolist())
    assert found.indices.min() >= 3 and len(set(found.indices.tolist())) == 4


def test_the_front_ascends_to_the_optimum_and_is_never_faster_than_the_proven_one():
    candidates = drawn(11)
    _, value, seconds = every_run(candidates)
    efficiency = np.exp((value - value.max()) / 4)
    front = pareto_front(candidates, motion=MOTION, start=HOME, method="lookahead")
    points = front.points
    assert not front.proven and len(points) >= 3
    assert points[-1].efficiency == pytest.approx(1.0, abs=1e-9)
    for before, after in itertools.pairwise(points):
        assert before.seconds < after.seconds
        assert before.efficiency < after.efficiency
    for point in points:
        fastest = seconds[efficiency >= point.efficiency - 1e-9].min()
        assert point.seconds >= fastest - 1e-9


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"weight": -1.0}, "weight must be a number of at least 0, got -1.0"),
        ({"weight": 0.1, "least_efficiency": 0.9}, "must not both be given"),
        ({"weight": 0.1, "method": "exact"}, "method must be lookahead with a weight"),
        ({"weight": 0.1, "seed": 3}, 'seed is not an option of method "lookahead"'),
        ({"method": "lookahead", "num": 0}, "num must be"),
    ],
)
def test_what_makes_no_sense_is_named(given, words):
    with pytest.raises(ValueError, match=words):
        select_fastest(drawn(0), motion=MOTION, **given)


def test_k_is_the_fewest_that_identify_where_not_given():
    planar = np.random.default_rng(3).uniform(-20, 20, (10, 2))
    found = select_fastest(planar, motion=Motion((20.0,), (100.0,)))
    assert len(found.indices) == 3 and found.proven


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
