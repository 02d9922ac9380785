"""A budget is a limit: what it cannot pay is not measured, whoever decides."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.adaptive import next_measurement, play, run
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.lookahead import AHEAD, fit
from jaxcal.adaptive.policy.network import (
    Exercise,
    PolicyDecider,
    Sessions,
    initial,
)
from jaxcal.adaptive.rules import SHARES, Gain, Random, StateRule

RULE = StateRule(0.1, 1.0, 1.0)


def task(overrun=False, seconds=(3.0, 6.0), cost=1.0):
    """Eight cells, seven thresholds to test; a yes takes a use and .5 s; the last test
    costs ``cost`` times as much and tells everything."""
    cells = (np.arange(8) + 0.5) / 8
    at = np.append(np.arange(1, 8) / 8, 0.5)
    yes = (cells[None] < at[:, None]) * 0.9 + 0.05
    yes[-1] = cells < 0.5
    way = np.abs(np.append(at, 0.0)[:, None] - at) + 0.5
    way[:, -1] = cost
    return GridTask.make(
        cells, at, np.stack([1.0 - yes, yes], axis=1), travel=way, extra=[0.0, 0.5],
        uses=[0, 1], seconds=seconds, num_uses=(1, 3), horizon=12, overrun=overrun,
    )  # fmt: skip


DECIDERS = {
    "random": lambda of: Random(),
    "gain": lambda of: Gain(),
    "shares": lambda of: SHARES,
    "state": lambda of: RULE,
    "ahead": lambda of: AHEAD,
    "fitted": lambda of: fit(of),
    "policy": lambda of: PolicyDecider(initial(jax.random.key(0), 4, 1, 8), RULE, 4, 8),
}
QUICK = ("random", "state")


def spent(of, episodes, number):
    """Seconds and uses left after each measurement of a session, in numpy; the place
    and the number of measurements at its end."""
    seconds = float(episodes.begun.seconds[number])
    uses = int(episodes.begun.uses[number])
    place, left, travel = int(of.place), [], np.asarray(of.travel)
    made = int(np.asarray(episodes.alive[number]).sum())
    assert np.asarray(episodes.alive[number])[:made].all()
    for a, y in zip(
        np.asarray(episodes.designs[number])[:made].tolist(),
        np.asarray(episodes.outcomes[number])[:made].tolist(),
        strict=True,
    ):
        seconds -= float(travel[place, a]) + 0.5 * y
        uses -= y
        place = a
        left.append((seconds, uses))
    return left, place, made


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[] if n in QUICK else pytest.mark.slow) for n in DECIDERS],
)
def test_no_decider_spends_more_than_there_is_and_each_goes_on_while_it_can(name):
    of = task(cost=3.0)
    keys = jax.random.split(jax.random.key(0), 48)
    episodes = play(of, jax.tree.map(jnp.asarray, DECIDERS[name](of)), keys)
    for number in range(48):
        left, place, made = spent(of, episodes, number)
        assert made > 0
        assert min(seconds for seconds, _ in left) > -1e-3
        assert min(uses for _, uses in left) >= 0
        seconds, uses = left[-1]
        cheapest = float(np.asarray(of.travel)[place].min()) + 0.5
        assert uses == 0 or made == 12 or seconds < cheapest + 1e-3


@pytest.mark.slow
def test_with_overrun_the_last_measurement_may_cost_more():
    of = task(overrun=True, seconds=1.0, cost=100.0)
    episodes = play(of, Gain(), jax.random.split(jax.random.key(0), 8))
    assert (np.asarray(episodes.designs)[:, 0] == 7).all()
    assert next_measurement(of, decider=Gain(), uses=1).design == 7
    hard = next_measurement(task(seconds=3.0, cost=100.0), decider=Gain(), uses=1)
    assert hard.design != 7 and hard.gain > 0.0


def test_the_loop_ends_where_nothing_can_be_paid():
    of = task(seconds=3.0)
    finished = run(of, AHEAD, lambda proposal: 0, uses=1)
    left = float(finished.session.seconds)
    assert 0.0 < left < 1.0 + 0.5  # the cheapest, .5 s, may take .5 s more
    assert bool(of.over(finished.session)) and not bool(finished.session.spent)
    assert next_measurement(of, finished.history, uses=1).design is None


def test_a_history_that_could_not_be_paid_is_named():
    with pytest.raises(
        ValueError, match=r"history\[1\] takes up to 100.5 s and 1 uses"
    ):
        next_measurement(task(seconds=3.0, cost=100.0), [(0, 0), (7, 0)], uses=1)


def test_a_budget_that_pays_for_nothing_is_refused():
    with pytest.raises(ValueError, match=r"design 0, takes up to 1\.125 s and 1 uses"):
        task(seconds=1.0)
    task(seconds=1.0, overrun=True)


def test_costs_that_sum_to_the_budget_can_all_be_paid():
    """Ten tests of .1 s in 1 s, though sums of float32 are a little off."""
    table = np.full((1, 2, 2), 0.5)
    for count in (10, 30, 70):
        of = GridTask.make(
            [0.0, 1.0], [0.0], table, travel=0.1, seconds=0.1 * count, horizon=100
        )
        played = play(of, Gain(), jax.random.split(jax.random.key(0), 2))
        assert np.asarray(played.alive).sum(axis=1).tolist() == [count] * 2


@pytest.mark.slow
def test_a_stream_for_training_ends_where_nothing_can_be_paid():
    of = Exercise(task(), RULE)
    sessions = Sessions(4)
    state = sessions.reset(of, jax.random.key(3))
    for number in range(13):
        seen = sessions.observe(of, state, jax.random.key(number))
        assert bool(seen.valid.any())
        action = jnp.argmax(jnp.where(seen.valid, seen.features[:, 1], -1.0))
        step = sessions.step(of, state, seen, action, jax.random.key(number))
        state, ended = jax.tree.map(
            lambda leaf, at=step.happened: leaf[at], (step.states, step.ended)
        )
        assert float(state.session.seconds) > -1e-3 and int(state.session.uses) >= 0
        if bool(ended):
            break
    assert bool(ended) and number < 12
