"""Two steps, rollouts, static sequences and tuning, on tasks small enough to judge."""

import subprocess
import sys

import jax
import numpy as np
import pytest
from scipy import stats

from benchmarks.sequential import sequence
from benchmarks.sequential.deciders import Rollouts, TwoStep
from jaxcal.adaptive.episodes import compare, play
from jaxcal.adaptive.rules import Priced, shortlist
from jaxcal.adaptive.session import Options
from jaxcal.adaptive.tasks.knee import STATE_RULE, knee
from jaxcal.adaptive.tuning import tune

TASK = knee(6, sigma=0.05, seconds=(5.0, 9.0))
ALL = Options(np.arange(10), np.ones(10), np.ones(10, bool))


def state(task, designs, outcomes, seconds=8.0, uses=2):
    """Belief and session after some measurements."""
    belief, session = task.begin(jax.random.key(0))
    session = task.session(seconds, uses)
    for design, outcome in zip(designs, outcomes, strict=True):
        belief = belief.update(task, design, outcome)
        session = task.spend(session, design, outcome)
    return belief, session


def test_a_shortlist_holds_the_best_of_each_group():
    score = np.array([3.0, 1, 9, 2, 0, 7, 8, 5, 4, 6], np.float32)
    index, valid = shortlist(TASK, score, ALL, 2)
    assert index.tolist() == [2, 0, 6, 5] and valid.all()
    index, valid = shortlist(TASK, score, ALL, 7)
    assert len(index) == 14 and valid.sum() == 10
    assert set(np.asarray(index)[np.asarray(valid)].tolist()) == set(range(10))


def entropy(p):
    return stats.entropy(p, axis=0)


def gains_of(task, belief):
    """(A,) nats, float64."""
    table = np.asarray(task.likelihood, np.float64)
    p = table @ belief
    return entropy(p.T) - entropy(table.transpose(1, 0, 2)) @ belief


@pytest.mark.slow
@pytest.mark.parametrize("measured", [((), ()), ((2, 7), (0, 1)), ((4, 1), (1, 0))])
def test_two_steps_are_those_of_a_second_implementation(measured):
    """With prices of nothing but 1, in float64 by loops."""
    belief, session = state(TASK, *measured)
    options = TASK.options(belief, session)
    chosen = TwoStep(Priced(1.0, 0.0, 0.0), per_group=5)(
        TASK, belief, session, options, jax.random.key(0)
    )
    table = np.asarray(TASK.likelihood, np.float64)
    weights = np.asarray(belief.weights, np.float64)
    values = gains_of(TASK, weights)
    for a in range(len(table)):
        for y in range(2):
            after = weights * table[a, y]
            left = float(session.seconds - TASK.travel[session.place, a])
            left -= float(TASK.extra[a, y])
            uses = int(session.uses - TASK.uses[a, y])
            if left > 0 and uses > 0:
                gain = gains_of(TASK, after / after.sum()).max()
                values[a] += after.sum() * gain
    assert values[int(chosen)] == pytest.approx(values.max(), abs=1e-5)


def value_of_first(task, rule, belief, weights, session, first):
    """Expected nats of a measurement, then a rule to the end, by recursion."""
    table = np.asarray(task.likelihood, np.float64)
    total = float(gains_of(task, weights)[first])
    for y in range(table.shape[1]):
        after = weights * table[first, y]
        if after.sum() < 1e-12:
            continue
        left = task.spend(session, first, y)
        if not bool(task.over(left)):
            then = belief.update(task, first, y)
            options = task.options(then, left)
            follow = int(_choose(task, rule, then, left, options))
            total += after.sum() * value_of_first(
                task, rule, then, after / after.sum(), left, follow
            )
    return total


_choose = jax.jit(lambda task, rule, *rest: rule(task, *rest, jax.random.key(0)))


def test_a_rule_played_is_worth_what_recursion_says():
    task = knee(4, sigma=0.05, seconds=5.0, trips=2)
    belief, session = task.begin(jax.random.key(0))
    options = task.options(belief, session)
    first = int(_choose(task, STATE_RULE, belief, session, options))
    prior = np.asarray(task.prior, np.float64)
    exact = value_of_first(task, STATE_RULE, belief, prior, session, first)
    mean, error = compare(task, {"state": STATE_RULE}, 4096).mean("state")
    assert error < 0.02
    assert mean == pytest.approx(exact, abs=4.0 * error)


def test_rollouts_find_what_is_best_before_their_base():
    """Many rollouts choose a measurement whose exact value is the largest there is."""
    task = knee(4, sigma=0.05, seconds=5.0, trips=2)
    belief, session = task.begin(jax.random.key(0))
    options = task.options(belief, session)
    rule = Priced(0.01, 0.01, 100.0)  # avoids trips at any cost
    rollouts = Rollouts(rule, rollouts=2000, per_group=3)
    chosen = int(_choose(task, rollouts, belief, session, options))
    prior = np.asarray(task.prior, np.float64)
    values = [value_of_first(task, rule, belief, prior, session, a) for a in range(6)]
    assert values[chosen] > max(values) - 0.02
    assert max(values) > values[int(_choose(task, rule, belief, session, options))]


@pytest.mark.slow
def test_rollouts_are_better_than_their_base():
    deciders = {
        "base": Priced(1.0, 0.0, 0.0),
        "rollouts": Rollouts(Priced(1.0, 0.0, 0.0)),
    }
    mean, error = compare(TASK, deciders, 512, batch=128).paired("rollouts", "base")
    assert mean > 4.0 * error


def test_a_static_sequence_is_as_good_as_the_best_of_all():
    task = knee(4, sigma=0.05, seconds=4.0, trips=1)
    keys = jax.random.split(jax.random.key(5), 256)
    found = sequence.optimise(task, length=3, episodes=256, starts=8, seed=5)

    def nats(designs):
        return float(play(task, sequence.Static(np.array(designs)), keys).gain.mean())

    every = [nats((a, b, c)) for a in range(6) for b in range(6) for c in range(6)]
    assert nats(found.sequence) == pytest.approx(max(every), rel=0.02)
    played = play(task, found, keys)
    same = np.asarray(played.designs[:, :3]) == np.array(found.sequence)
    assert same[np.asarray(played.alive[:, :3])].all()


def test_tuning_mends_a_rule_that_ignores_what_trips_cost():
    start = Priced(1.0, 1.0, 0.01)
    tuned = tune(TASK, start, episodes=128, generations=4, population=8, elite=3)
    assert tuned.c1 == start.c1
    found = compare(TASK, {"start": start, "tuned": tuned}, 1024, seed=9)
    mean, error = found.paired("tuned", "start")
    assert mean > 3.0 * error


def test_bad_sizes_of_a_search_are_refused():
    with pytest.raises(ValueError, match="elite must be between 1 and population = 4"):
        tune(TASK, STATE_RULE, population=4, elite=4)
    with pytest.raises(ValueError, match="length must be"):
        sequence.optimise(TASK, length=0)


pytestmark = pytest.mark.slow  # minutes together


@pytest.mark.slow
def test_ahead_plays_on_a_single_core():
    """On one core ``pure_callback`` deadlocks; the look-ahead must finish there."""
    code = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import subprocess
import sys

import jax
from jaxcal.adaptive.episodes import compare
from jaxcal.adaptive.lookahead import AHEAD
from jaxcal.adaptive.tasks.knee import knee
nats = [compare(knee(24), {"ahead": AHEAD}, 1024).mean("ahead")[0] for _ in range(4)]
print(min(nats) == max(nats))
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120
    )
    assert done.stdout.strip() == "True", done.stderr
