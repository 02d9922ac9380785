"""Fast runs by the travel policy and by its look-ahead, against every run there is."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

import jaxcal
from jaxcal.information.regression import log_det_gram
from jaxcal.learning.training import checkpoint
from jaxcal.selection.fastest import travel_policy
from jaxcal.selection.fastest.fastest import Motion, pareto_front, select_fastest
from jaxcal.selection.fastest.travel import travel_times

MOTION = Motion(speed=(20.0, 10.0, 30.0), acceleration=(50.0, 100.0, 20.0), settle=0.5)
HOME = np.zeros(3)
METHODS = travel_policy.METHODS


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
    return (
        subsets,
        np.array([log_det_gram(candidates[list(s)]) for s in subsets]),
        least,
    )


@pytest.mark.parametrize("method", METHODS)
def test_the_run_is_efficient_enough_and_close_to_the_fastest(method):
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
                method=method,
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


@pytest.mark.parametrize("method", METHODS)
def test_time_worth_nothing_leaves_the_plain_choice(method):
    for seed in range(3):
        candidates = drawn(seed)
        free = select_fastest(
            candidates, motion=MOTION, start=HOME, weight=0.0, method=method
        )
        plain = jaxcal.select(candidates, method="policy")
        assert free.efficiency >= plain.efficiency - 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_a_weighted_run_is_near_the_best_of_all(method):
    candidates = drawn(5)
    _, value, seconds = every_run(candidates)
    log_efficiency = (value - value.max()) / 4
    travel = seconds - 4 * MOTION.settle
    for weight in (0.02, 0.2, 1.0):
        found = select_fastest(
            candidates, motion=MOTION, start=HOME, weight=weight, method=method
        )
        best = (log_efficiency - weight * travel).max()
        got = np.log(found.efficiency) - weight * found.travel_seconds
        assert best - 0.05 <= got <= best + 1e-9


@pytest.mark.parametrize("method", METHODS)
def test_dearer_time_is_never_answered_with_a_slower_run(method):
    candidates = drawn(6)
    runs = [
        select_fastest(candidates, motion=MOTION, start=HOME, weight=w, method=method)
        for w in (0.0, 0.1, 2.0)
    ]
    seconds = [run.seconds for run in runs]
    assert seconds[0] > seconds[2]
    assert seconds == sorted(seconds, reverse=True)


@pytest.mark.parametrize("method", METHODS)
def test_another_unit_of_time_changes_no_choice(method):
    candidates = drawn(7)
    faster = Motion(
        speed=tuple(8.0 * np.array(MOTION.speed)),
        acceleration=tuple(64.0 * np.array(MOTION.acceleration)),
        settle=MOTION.settle / 8.0,
    )
    slow = select_fastest(
        candidates, motion=MOTION, start=HOME, weight=0.2, method=method
    )
    fast = select_fastest(
        candidates, motion=faster, start=HOME, weight=1.6, method=method
    )
    assert fast.indices.tolist() == slow.indices.tolist()
    assert fast.seconds == pytest.approx(slow.seconds / 8.0)


@pytest.mark.parametrize("method", METHODS)
def test_the_order_of_the_candidates_changes_no_time(method, rng):
    candidates = drawn(8)
    turn = rng.permutation(len(candidates))
    seconds = [
        select_fastest(
            points, motion=MOTION, start=HOME, least_efficiency=0.85, method=method
        ).seconds
        for points in (candidates, candidates[turn])
    ]
    assert seconds[0] == pytest.approx(seconds[1], abs=1e-9)


def test_masked_and_required_postures_are_respected():
    candidates = drawn(9)
    available = np.arange(12) >= 3
    for required in ([5, 7, 4], [4, 5, 6, 7]):
        found = select_fastest(
            candidates,
            motion=MOTION,
            least_efficiency=0.6,
            available=available,
            required=required,
            method="lookahead",
        )
        assert set(required) <= set(found.indices.tolist())
        assert found.indices.min() >= 3 and len(set(found.indices.tolist())) == 4


def test_the_last_two_of_a_run_are_the_soonest_pair_that_will_do(rng):
    candidates = drawn(10)
    subsets, value, _ = every_run(candidates)
    between = travel_times(candidates, candidates, MOTION)
    begin = travel_times(HOME[None], candidates, MOTION)[0]
    rows = np.c_[candidates, np.ones(12)]
    wanted = value.max() + 4 * np.log(0.8)
    runs = subsets[rng.permutation(len(subsets))[:3]]
    chosen, seconds = travel_policy.completed(runs, rows, between, begin, wanted, 0)
    ways = []
    for before in runs[:, :2].tolist():
        for pair in itertools.permutations(set(range(12)) - set(before), 2):
            subset = [*before, *pair]
            if log_det_gram(candidates[subset]) >= wanted:
                ways.append(
                    min(
                        begin[q[0]]
                        + sum(between[i, j] for i, j in itertools.pairwise(q))
                        for q in itertools.permutations(subset)
                    )
                )
    if ways:
        assert chosen is not None and log_det_gram(candidates[chosen]) >= wanted - 1e-9
        assert seconds == pytest.approx(min(ways), abs=1e-9)
    else:
        assert chosen is None


def test_the_front_ascends_to_the_optimum_and_is_never_faster_than_the_proven_one():
    candidates = drawn(11)
    _, value, seconds = every_run(candidates)
    efficiency = np.exp((value - value.max()) / 4)
    front = pareto_front(candidates, motion=MOTION, start=HOME, method="policy")
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
        ({"weight": 0.1, "method": "exact"}, "must be one of policy, lookahead with"),
        ({"method": "policy", "num": 0}, "num must be"),
    ],
)
def test_what_makes_no_sense_is_named(given, words):
    with pytest.raises(ValueError, match=words):
        select_fastest(drawn(0), motion=MOTION, **given)


def test_a_policy_that_knows_no_time_is_refused():
    with pytest.raises(
        ValueError, match="must hold a travel policy, got a compact one"
    ):
        select_fastest(
            drawn(0),
            motion=MOTION,
            method="policy",
            checkpoint=checkpoint.default_folder(),
        )


def test_what_ships_is_of_its_kind():
    assert checkpoint.load().network.config.kind == "compact"
    travelling = checkpoint.load(checkpoint.default_folder("travel"))
    assert travelling.network.config.kind == "travel"
    assert travelling.meta["preset"] == "travel"
