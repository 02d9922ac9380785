"""The least time at a wanted efficiency, against every subset in every order."""

from __future__ import annotations

import itertools
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from questions import pareto_front, score, select_fastest

import jaxcal
from jaxcal.designs.travel import Motion, fastest_tour, travel_times
from jaxcal.information.regression import log_det_gram
from jaxcal.models import Noise, Polynomial, SerialChain

MOTION = Motion(speed=(20.0, 10.0, 30.0), acceleration=(50.0, 100.0, 20.0), settle=0.5)


def seconds_of(candidates, order, start):
    """Move by move, axis by axis, from the definition of the profile."""
    at, total = start, 0.0
    for i in order:
        if at is not None:
            longest = 0.0
            for axis in range(3):
                v, a = MOTION.speed[axis], MOTION.acceleration[axis]
                d = abs(candidates[i, axis] - at[axis])
                cruise = d / v + v / a if d >= v * v / a else 2 * (d / a) ** 0.5
                longest = max(longest, cruise)
            total += longest
        total += MOTION.settle
        at = candidates[i]
    return total


def every_run(candidates, k, start, required=(), available=None):
    """(log det S, least seconds) of every subset allowed."""
    usable = range(len(candidates)) if available is None else np.flatnonzero(available)
    runs = []
    for subset in itertools.combinations(usable, k):
        if set(required) <= set(subset):
            value = 3 * float(log_det_gram(candidates[list(subset)]))
            orders = itertools.permutations(subset)
            runs.append((value, min(seconds_of(candidates, o, start) for o in orders)))
    return np.array(runs)


def excess(found, runs, least, size=12):
    """How much longer the run is than the fastest of all ``runs`` (N, 2), a share.

    It is of a subset as efficient as asked, in its best order; ``size`` is of the
    efficiency's root.
    """
    own = np.isclose(runs[:, 0], found.log_det, rtol=1e-9)
    assert found.seconds == pytest.approx(runs[own, 1].min(), abs=1e-8)
    assert found.efficiency >= least - 1e-9
    assert (found.method, found.proven) == ("heuristic", False)
    share = np.exp((runs[:, 0] - runs[:, 0].max()) / size)
    more = found.seconds / runs[share >= least - 1e-12, 1].min() - 1.0
    assert more >= -1e-9
    return more


def nearly_always_the_fastest(shares):
    """Half a percent longer in the mean, and mostly not at all."""
    assert np.mean(shares) < 0.005
    assert np.mean(np.array(shares) < 1e-9) > 0.7


@pytest.mark.parametrize("started", [False, True])
def test_runs_are_nearly_the_fastest_of_every_subset_and_order(rng, started):
    shares = []
    for k, r in ((4, 0), (4, 2), (5, 0), (6, 0)):
        candidates = rng.uniform(-20, 20, (8, 3))
        start = np.zeros(3) if started else None
        available = rng.permutation(8) < 7
        required = np.flatnonzero(available)[:r]
        runs = every_run(candidates, k, start, required, available)
        for least in (0.7, 0.9, 0.99):
            found = select_fastest(
                candidates, k, motion=MOTION, least_efficiency=least, start=start,
                available=available, required=required,
            )  # fmt: skip
            shares.append(excess(found, runs, least))
            own = seconds_of(candidates, found.indices, start)
            assert found.seconds == pytest.approx(own, abs=1e-9)
            own = jaxcal.log_det_information(candidates[found.indices])
            assert found.log_det == pytest.approx(own)
            assert set(required.tolist()) <= set(found.indices.tolist())
            assert available[found.indices].all()
    nearly_always_the_fastest(shares)


@pytest.mark.parametrize("started", [False, True])
def test_the_front_is_nearly_that_of_every_subset(rng, started):
    shares = []
    for _ in range(3):
        candidates = rng.uniform(-20, 20, (9, 3))
        start = np.zeros(3) if started else None
        runs = every_run(candidates, 4, start)
        front = pareto_front(
            candidates, 4, motion=MOTION, least_efficiency=0.6, start=start
        )
        assert (front.method, front.proven) == ("heuristic", False)
        shares += [excess(p, runs, p.efficiency * (1 - 1e-9)) for p in front.points]
        efficiencies = [p.efficiency for p in front.points]
        assert efficiencies == sorted(efficiencies)
        assert efficiencies[-1] == pytest.approx(1.0)
    nearly_always_the_fastest(shares)


@settings(max_examples=6)
@given(st.integers(0, 2**31), st.sampled_from([4, 5, 8, 13]))
def test_a_run_keeps_every_rule(seed, k):
    rng = np.random.default_rng(seed)
    candidates = rng.uniform(-20, 20, (20, 3))
    found = select_fastest(
        candidates,
        k,
        motion=MOTION,
        least_efficiency=0.9,
        required=[3],
        seed=seed,
    )
    assert found.efficiency >= 0.9 - 1e-9
    assert not found.proven
    assert len(set(found.indices.tolist())) == k
    assert 3 in found.indices
    assert found.seconds == pytest.approx(seconds_of(candidates, found.indices, None))


@given(st.integers(0, 2**31))
def test_travel_time_is_a_metric_and_the_slowest_axis(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-30, 30, (6, 3))
    t = travel_times(points, points, MOTION)
    np.testing.assert_allclose(t, t.T)
    np.testing.assert_array_equal(np.diagonal(t), 0.0)
    assert (t[:, None] <= t[:, :, None] + t[None] + 1e-12).all()
    for i, j in itertools.permutations(range(6), 2):
        one_way = seconds_of(points, [j], points[i]) - MOTION.settle
        assert t[i, j] == pytest.approx(one_way)


def test_a_profile_reaches_its_speed_or_does_not():
    motion = Motion(speed=(2.0,), acceleration=(1.0,))
    far = travel_times([[0.0]], [[10.0], [4.0], [1.0]], motion)
    np.testing.assert_allclose(far, [[7.0, 4.0, 2.0]])


@given(st.integers(0, 2**31), st.integers(1, 6), st.booleans())
def test_the_tour_is_the_best_permutation(seed, k, started):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-30, 30, (k, 3))
    t = travel_times(points, points, MOTION)
    start = rng.random(k) if started else np.zeros(k)
    order, seconds = fastest_tour(t, start if started else None)
    lengths = [
        start[p[0]] + sum(t[a, b] for a, b in itertools.pairwise(p))
        for p in itertools.permutations(range(k))
    ]
    assert sorted(order.tolist()) == list(range(k))
    assert seconds == pytest.approx(min(lengths))


def test_long_tours_are_no_worse_than_any_nearest_neighbour_tour(rng):
    points = rng.uniform(-30, 30, (16, 3))
    t = travel_times(points, points, MOTION)
    order, seconds = fastest_tour(t)
    assert sorted(order.tolist()) == list(range(16))
    assert seconds == pytest.approx(t[order[:-1], order[1:]].sum())
    for first in range(16):
        tour, left = [first], set(range(16)) - {first}
        while left:
            tour.append(min(left, key=lambda j: t[tour[-1], j]))
            left.remove(tour[-1])
        assert seconds <= sum(t[a, b] for a, b in itertools.pairwise(tour)) + 1e-9


def test_all_of_the_efficiency_is_the_d_optimum_in_its_best_order(rng):
    candidates = rng.uniform(-20, 20, (40, 3))
    found = select_fastest(candidates, 5, motion=MOTION, least_efficiency=1.0)
    best = jaxcal.select(candidates, 5, "exact")
    assert found.log_det == pytest.approx(best.log_det, abs=1e-8)
    assert set(found.indices.tolist()) == set(best.indices.tolist())


def test_less_efficiency_never_takes_longer(rng):
    candidates = rng.uniform(-20, 20, (40, 3))
    seconds = [
        select_fastest(candidates, 4, motion=MOTION, least_efficiency=e).seconds
        for e in (0.5, 0.8, 0.9, 0.95, 1.0)
    ]
    assert seconds == sorted(seconds)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"least_efficiency": 0.0}, r"least_efficiency must be in \(0, 1\], got 0"),
        ({"motion": 20.0}, "motion must be a Motion, got 20.0"),
        ({"k": 3}, "k must be at least 4"),
        ({"start": np.zeros(2)}, r"start must have shape \(3,\), got \(2,\)"),
        ({"time_limit": -1}, "time_limit must be a number above 0 in seconds, got -1"),
        ({"motion": Motion((1.0, 2.0), (1.0,))}, "motion.speed must hold 1 or 3"),
    ],
)
def test_bad_requests_name_argument_rule_and_value(rng, change, message):
    given = {"k": 4, "motion": MOTION} | change
    with pytest.raises(ValueError, match=message):
        select_fastest(rng.random((20, 3)), given.pop("k"), **given)


def test_replicates_and_scenarios_have_no_run(rng):
    twice = jaxcal.Design(rng.random((9, 3)), max_replicates=2)
    for ask in (twice.fastest, twice.pareto):
        with pytest.raises(ValueError, match="max_replicates must be 1 with fastest"):
            ask(4, MOTION)
    several = jaxcal.Design.from_blocks(rng.random((2, 9, 1, 3)))
    with pytest.raises(ValueError, match="scenarios must be left out with fastest"):
        several.fastest(4, MOTION)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (((0.0,), (1.0,), 0.0), "speed must be positive"),
        (((1.0,), (-1.0,), 0.0), "acceleration must be positive"),
        (((1.0,), (1.0,), -0.1), "settle must be at least 0 seconds, got -0.1"),
    ],
)
def test_a_motion_is_checked_once(values, message):
    with pytest.raises(ValueError, match=message):
        Motion(*values)


def test_cost_loads_neither_jax_nor_matplotlib():
    code = (
        "import sys, numpy\n"
        "from jaxcal import Design, Motion\n"
        "c = numpy.random.default_rng(0).random((9, 3))\n"
        "Design(c).fastest(4, Motion((1.0,), (1.0,)))\n"
        "print(sorted({'jax', 'matplotlib'} & set(sys.modules)))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


@settings(max_examples=8)
@given(st.integers(0, 2**31), st.sampled_from([0.8, 0.95]), st.booleans())
def test_blocks_are_visited_as_by_brute_force(seed, least, known):
    rng = np.random.default_rng(seed)
    candidates = rng.uniform(-20, 20, (8, 3))
    blocks = rng.normal(size=(8, 2, 5))
    prior = np.diag([0.0, 1.0, 0.0, 0.5, 0.0]) if known else np.zeros((5, 5))
    runs = []
    for subset in itertools.combinations(range(8), 4):
        rows = blocks[list(subset)].reshape(-1, 5)
        orders = itertools.permutations(subset)
        least_seconds = min(seconds_of(candidates, o, None) for o in orders)
        runs.append((np.linalg.slogdet(rows.T @ rows + prior)[1], least_seconds))
    given = {"blocks": blocks, "prior": prior, "least_efficiency": least}
    found = select_fastest(candidates, 4, motion=MOTION, **given)
    assert excess(found, np.array(runs), least, size=5) < 0.05


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"prior": np.eye(5), "blocks": None}, "prior must be a jaxcal.Prior"),
        ({"candidates": np.zeros((7, 3))}, r"commands must have shape \(8, n\)"),
        ({"candidates": None}, "blocks need the commands"),
    ],
)
def test_bad_requests_with_blocks_are_named(rng, change, message):
    given = {"candidates": rng.random((8, 3)), "blocks": rng.normal(size=(8, 2, 5))}
    given |= change
    with pytest.raises(ValueError, match=message):
        select_fastest(given.pop("candidates"), motion=MOTION, **given)


@pytest.mark.parametrize(
    ("model", "k"),
    [(SerialChain.from_dh([(9, 90, 5, 0)] * 3), 2), (Polynomial(2, 3, 1), 4)],
)
def test_any_model_is_visited_as_by_brute_force(rng, model, k):
    candidates = rng.uniform(-20, 20, (8, 3))
    measured = rng.uniform(-20, 20, (7, 3))
    rows, before = (model.jacobian(c) / 0.1 for c in (candidates, measured))
    known = np.diag(model.default_prior().resolve(model).precisions)
    known = known + np.einsum("kqa,kqb->ab", before, before)
    runs = []
    for subset in itertools.combinations(range(8), k):
        some = rows[list(subset)]
        orders = itertools.permutations(subset)
        least_seconds = min(seconds_of(candidates, o, None) for o in orders)
        added = np.einsum("kqa,kqb->ab", some, some)
        runs.append((np.linalg.slogdet(known + added)[1], least_seconds))
    given = {"model": model, "noise": Noise(0.1), "measured": measured}
    found = select_fastest(candidates, k, motion=MOTION, least_efficiency=0.99, **given)
    assert excess(found, np.array(runs), 0.99, size=len(known)) < 1e-9
    front = pareto_front(candidates, k, motion=MOTION, least_efficiency=0.99, **given)
    assert front.points[0].seconds == pytest.approx(found.seconds)


def test_the_noise_of_an_arm_counts_as_it_does_for_select():
    arm = SerialChain.from_dh([(0, 90, 90, 0), (-425, 0, 0, 0), (-390, 0, 0, 0)])
    poses = np.random.default_rng(0).uniform(-90, 90, (12, 3))
    motion = Motion((30.0,), (200.0,))
    found = select_fastest(poses, 6, motion=motion, model=arm)
    judged = score(poses, found.indices, model=arm, criterion="D")
    assert found.log_det == pytest.approx(judged.log_det)
