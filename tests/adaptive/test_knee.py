"""Exact beliefs, sessions and rules, against a second implementation in numpy."""

import math

import jax
import numpy as np
import pytest
from scipy import stats

from benchmarks.sequential.optimum import solve
from jaxcal.adaptive.episodes import compare, play
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.rules import Gain, GainRate, Random
from jaxcal.adaptive.tasks.knee import PRICED, STATE_RULE, knee

SMALL = {"cells": 6, "sigma": 0.05, "seconds": (5.0, 9.0)}


def plain_knee(cells, sigma, rho=0.6, slip=0.01):
    """Prior (C, C) and the chance of a trip (2, C - 1, C), float64, by loops."""
    tau = (np.arange(cells) + 0.5) / cells
    z = stats.norm.ppf(tau)
    pair = stats.multivariate_normal([0, 0], [[1, rho], [rho, 1]])
    prior = np.array(
        [[pair.pdf([a, b]) / stats.norm.pdf([a, b]).prod() for b in z] for a in z]
    )
    trip = np.array(
        [
            [
                slip + (1 - 2 * slip) * stats.norm.cdf((k / cells - t) / sigma)
                for t in tau
            ]
            for k in range(1, cells)
        ]
    )
    return prior / prior.sum(), trip


def replay(task, episodes, number, cells, sigma):
    """One session by the text of the task: belief, seconds and trips left."""
    belief, trip = plain_knee(cells, sigma)
    joint, at = 0, 0.0
    seconds = float(episodes.begun.seconds[number])
    trips = int(episodes.begun.uses[number])
    total, made = 0.0, 0
    for design, outcome, gain in zip(
        np.asarray(episodes.designs[number]),
        np.asarray(episodes.outcomes[number]),
        np.asarray(episodes.gains[number]),
        strict=True,
    ):
        if seconds <= 0.0 or trips <= 0:
            break
        j, k = divmod(int(design), cells - 1)
        u = (k + 1) / cells
        seconds -= 1.0 + (2.0 * abs(u - at) if j == joint else 2.0 + 2.0 * u)
        joint, at = j, u
        p = trip[k][:, None] if j == 0 else trip[k][None]
        chance = float((belief * p).sum())
        entropy = -(p * np.log(p) + (1 - p) * np.log(1 - p))
        told = -(chance * math.log(chance) + (1 - chance) * math.log(1 - chance))
        assert gain == pytest.approx(told - (belief * entropy).sum(), abs=2e-5)
        belief = belief * (p if outcome else 1 - p)
        belief /= belief.sum()
        total += float(gain)
        made += 1
        if outcome:
            seconds, trips = seconds - 1.0, trips - 1
    assert made == int(np.asarray(episodes.alive[number]).sum())
    return belief, total


@pytest.mark.slow
@pytest.mark.parametrize("rule", [Random(), STATE_RULE])
def test_sessions_are_those_of_the_second_implementation(rule):
    task = knee(**SMALL)
    prior, _ = plain_knee(6, 0.05)
    np.testing.assert_allclose(task.prior, prior.ravel(), rtol=1e-5)
    episodes = play(task, rule, jax.random.split(jax.random.key(1), 24))
    for number in range(24):
        belief, total = replay(task, episodes, number, 6, 0.05)
        told = stats.entropy(prior.ravel()) - stats.entropy(belief.ravel())
        assert float(episodes.entropy_drop[number]) == pytest.approx(told, abs=1e-4)
        assert float(episodes.gain[number]) == pytest.approx(total, abs=1e-5)
        truth = int(episodes.truth[number])
        ratio = math.log(belief.ravel()[truth] / prior.ravel()[truth])
        assert float(episodes.log_ratio[number]) == pytest.approx(ratio, abs=1e-4)


def test_outcomes_come_as_often_as_the_likelihood_says():
    task = knee(**SMALL)
    keys = jax.random.split(jax.random.key(0), 4000)
    for design, truth in ((0, 3), (4, 20), (8, 35)):
        drawn = jax.vmap(lambda k, d=design, s=truth: task.measure(s, d, k))(keys)
        wanted = float(task.likelihood[design, 1, truth])
        error = math.sqrt(wanted * (1 - wanted) / 4000) + 1e-6
        assert abs(float(drawn.mean()) - wanted) < 5 * error
    truths = np.asarray(jax.vmap(task.draw)(keys))
    found = np.bincount(truths, minlength=36) / 4000
    assert np.abs(found - np.asarray(task.prior)).max() < 5 * math.sqrt(0.1 / 4000)


@pytest.mark.slow
def test_three_estimators_of_the_information_agree():
    found = compare(knee(**SMALL), {"state": STATE_RULE, "random": Random()}, 2048)
    for row in range(2):
        for other in (found.entropy_drop, found.log_ratio):
            gap = found.gain[row] - other[row]
            assert abs(gap.mean()) < 4.5 * gap.std() / math.sqrt(len(gap))


@pytest.mark.slow
def test_rules_are_ordered_as_they_should_be():
    """A price on trips pays; so does thinking of what is left."""
    rules = {"gain": Gain(), "rate": GainRate(), "priced": PRICED, "state": STATE_RULE}
    found = compare(knee(), rules, 512)
    for better, worse in (("rate", "gain"), ("priced", "rate"), ("state", "priced")):
        mean, error = found.paired(better, worse)
        assert mean > 2.0 * error, (better, worse, mean, error)


def brute(task, belief, seconds, uses, place, rule=None):
    """The optimum, or the value of a rule, by recursion over everything."""
    if seconds <= 1e-9 or uses <= 0:
        return 0.0
    values = [0.0]
    table = np.asarray(task.likelihood, np.float64)
    for a in range(len(table)):
        p = table[a] @ belief
        dearest = float(task.travel[place, a] + task.extra[a].max())
        if not task.overrun and dearest > seconds + 1e-9:
            continue  # each test may trip, and one use is left
        total = stats.entropy(p)
        if total < 1e-9:
            values.append(0.0)
            continue
        for y in np.flatnonzero(p > 1e-9):
            after = belief * table[a, y]
            total += p[y] * brute(
                task,
                after / after.sum(),
                seconds - float(task.travel[place, a] + task.extra[a, y]),
                uses - int(task.uses[a, y]),
                int(task.place_after[a, y]),
            )
        values.append(total)
    return max(values)


@pytest.mark.parametrize(("uses", "overrun"), [(1, True), (2, True), (2, False)])
def test_the_optimum_is_that_of_brute_force(uses, overrun):
    task = knee(4, sigma=1e-9, slip=0.0, seconds=7.0, trips=uses, overrun=overrun)
    found = solve(task, 0.5)
    prior = np.asarray(task.prior, np.float64)
    wanted = brute(task, prior / prior.sum(), 7.0, uses, int(task.place))
    assert found.value(7.0, uses) == pytest.approx(wanted, abs=1e-5)
    assert found.mean == pytest.approx(wanted, abs=1e-5)


@pytest.mark.slow
def test_no_rule_passes_the_optimum_and_more_never_hurts():
    task = knee(5, sigma=1e-9, slip=0.0, seconds=(4.0, 12.0), trips=(1, 2))
    found = solve(task, 0.2)
    assert (np.diff(found.values, axis=0) >= -1e-6).all()
    assert (np.diff(found.values, axis=1) >= -1e-6).all()
    rules = {"state": STATE_RULE, "gain": Gain(), "optimum": found.decider}
    played = compare(task, rules, 2048)
    for name in played.names:
        mean, error = played.mean(name)
        assert mean < found.mean + 4.0 * error
    assert played.mean("state")[0] > 0.95 * found.mean
    mean, error = played.mean("optimum")
    assert mean > found.mean - 4.0 * error
    for name in ("state", "gain"):
        mean, error = played.paired("optimum", name)
        assert mean > 2.0 * error


def made(**change):
    base = {
        "theta": [0.0, 1.0],
        "designs": [0.0, 1.0, 2.0],
        "likelihood": np.full((3, 2, 2), 0.5),
        "horizon": 3,
    }
    return GridTask.make(**base | change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"likelihood": np.full((3, 2, 2), 0.4)},
            "must sum to 1 .* got 0.8 for",
        ),
        (
            {"likelihood": np.full((2, 2, 2), 0.5)},
            r"shape \(3, Y, 2\), got",
        ),
        ({"likelihood": np.full((3, 2, 2), -1.0)}, "at least 0, got -1"),
        ({"travel": -1.0}, "travel must be at least 0, got -1"),
        ({"extra": [0.0, -2.0]}, "extra must be at least 0, got -2"),
        ({"uses": np.zeros((4, 2))}, r"uses must broadcast to \(3, 2\)"),
        ({"prior": [0.0, 0.0]}, "prior must hold 2 weights"),
        ({"place_after": 9}, r"place_after must hold places in \[0, 4\), got 9"),
        ({"seconds": (3.0, 2.0)}, r"seconds must be above 0.* got \(3, 2\)"),
        ({"num_uses": 0}, "num_uses must be whole numbers of at least 1, got"),
        ({"groups": [0, 1]}, "groups must hold 3 whole numbers"),
        ({"theta_names": ["a", "b"]}, "theta_names must hold 1 names"),
    ],
)
def test_a_bad_task_is_one_clear_error(change, message):
    with pytest.raises(ValueError, match=message):
        made(**change)


def test_dynamic_programming_refuses_what_it_cannot_list():
    with pytest.raises(ValueError, match="must be 0 or 1"):
        solve(knee(4), 0.5)
    with pytest.raises(ValueError, match=r"travel must be multiples of 0\.3 s"):
        solve(knee(4, sigma=1e-9, slip=0.0), 0.3)
