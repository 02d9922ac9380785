"""The family of tasks: its laws, the padded arrays, and the rule for any task."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.sequential.family.draws import BUDGETS, draw
from benchmarks.sequential.family.padded import SHAPE, batch, pad, stack
from benchmarks.sequential.family.structures import HELD_OUT, TRAINED_ON, Limits
from jaxcal.adaptive import next_measurement, play
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.lookahead import fit
from jaxcal.adaptive.rules import SHARES, Gain, Random
from jaxcal.adaptive.tasks.knee import knee

ALL = sorted(TRAINED_ON | HELD_OUT)
TABLES = (
    *("prior", "likelihood", "travel", "place_after", "extra", "uses"),
    *("seconds", "num_uses", "place", "groups"),
)


@pytest.mark.slow
@settings(deadline=None, max_examples=40)
@given(
    st.integers(0, 2**31), st.sampled_from(ALL), st.sampled_from(BUDGETS),
    st.sampled_from([SHAPE, Limits(400, 40, 8, 5, 50), Limits()]),
)  # fmt: skip
def test_every_draw_is_a_task_within_its_limits(seed, structure, budget, limits):
    task = draw(seed, structure, budget, limits)
    count, outcomes, states = task.likelihood.shape
    likelihood, prior = np.asarray(task.likelihood), np.asarray(task.prior)
    assert np.isfinite(likelihood).all() and likelihood.min() >= 0.0
    np.testing.assert_allclose(likelihood.sum(axis=1), 1.0, atol=1e-5)
    assert prior.min() >= 0.0 and abs(prior.sum() - 1.0) < 1e-5
    assert count <= limits.designs and outcomes <= limits.outcomes
    assert states <= limits.states and task.horizon <= limits.measurements
    assert task.num_groups <= limits.groups and min(count, outcomes, states) > 1
    assert 1 <= np.min(task.num_uses) and np.max(task.num_uses) <= limits.uses
    assert (np.asarray(task.travel) >= 0.0).all()
    assert np.isfinite(task.seconds).all() == ("time" in budget.split("+"))
    assert bool((task.uses > 0).any()) <= ("uses" in budget.split("+"))


def test_the_same_seed_is_the_same_task_and_another_is_not():
    one, same, other = draw(5), draw(5), draw(6)
    for name in TABLES:
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))
    assert (
        one.likelihood.shape != other.likelihood.shape
        or (one.likelihood != other.likelihood).any()
    )
    both, again = batch(3, tasks=2), batch(3, tasks=2)
    np.testing.assert_array_equal(both.likelihood, again.likelihood)
    assert (both.likelihood != batch(4, tasks=2).likelihood).any()


def test_held_out_structures_are_not_drawn_unless_named():
    assert not set(HELD_OUT) & set(TRAINED_ON)
    with pytest.raises(ValueError, match=r"structure must be of .*, got 'knot'"):
        draw(0, "knot")
    with pytest.raises(ValueError, match=r"budget must be of time, .*, got 'money'"):
        draw(0, budget="money")


@pytest.fixture(scope="module")
def pairs():
    """Tasks as drawn, and the same padded."""
    tasks = [draw(seed, ALL[seed % len(ALL)], limits=SHAPE) for seed in range(24)]
    return [(task, jax.tree.map(jnp.asarray, pad(task, SHAPE))) for task in tasks]


@pytest.mark.slow
def test_a_padded_task_is_the_task(pairs):
    """Belief, costs, budget and the rule's choice agree, after some measurements."""
    looked = jax.jit(
        lambda task, belief, session, key: (
            belief.predictive(task),
            belief.gains(task),
            belief.entropies_after(task),
            task.expected(belief, session, task.options(belief, session)),
            SHARES(task, belief, session, task.options(belief, session), key),
        )
    )
    follow = jax.jit(
        lambda task, belief, session, design, outcome: (
            belief.update(task, design, outcome),
            task.spend(session, design, outcome),
        )
    )
    rng = np.random.default_rng(1)
    for small, large in pairs[:3]:
        count, outcomes, states = small.likelihood.shape
        key = jax.random.key(3)
        (belief, session), (wide, state) = small.begin(key), large.begin(key)
        truth = int(small.draw(key))
        for _ in range(3):
            one = looked(small, belief, session, key)
            other = looked(large, wide, state, key)
            p, gains, after, cost, choice = other
            np.testing.assert_allclose(p[:count, :outcomes], one[0], atol=2e-6)
            np.testing.assert_allclose(gains[:count], one[1], atol=1e-5)
            # Entropies are of what a design depends on; a padded task has one part.
            seen = np.asarray(one[0]) > 1e-4
            seen &= [part.axes for part in small.parts] == [whole(small)]
            np.testing.assert_allclose(
                np.asarray(after)[:count, :outcomes][seen], np.asarray(one[2])[seen],
                rtol=1e-3, atol=2e-3,
            )  # fmt: skip
            for a, b in zip(cost, one[3], strict=True):
                np.testing.assert_allclose(a[:count], b, rtol=1e-5, atol=1e-5)
            assert int(choice) < count
            chosen = int(one[4])
            if int(choice) != chosen:  # level to rounding
                np.testing.assert_allclose(gains[choice], gains[chosen], rtol=1e-3)
            likelihood = np.asarray(small.likelihood)[chosen, :, truth]
            outcome = int(rng.choice(outcomes, p=likelihood / likelihood.sum()))
            belief, session = follow(small, belief, session, chosen, outcome)
            wide, state = follow(large, wide, state, chosen, outcome)
            np.testing.assert_allclose(wide.weights[:states], belief.weights, atol=1e-5)
            assert not wide.weights[states:].any()
            np.testing.assert_allclose(state.seconds, session.seconds, rtol=1e-5)
            assert state.uses == session.uses
            assert large.horizon - state.made == small.horizon - session.made


def whole(task: GridTask) -> tuple[int, ...]:
    return tuple(range(len(task.shape)))


def test_no_rule_picks_what_padding_added(pairs):
    tasks = stack([large for _, large in pairs])
    counts = np.array([len(small.designs) for small, _ in pairs])

    @jax.jit
    @jax.vmap
    def choose(task, key):
        belief, session = task.begin(key)
        options = task.options(belief, session)
        keys = jax.random.split(key, 64)
        free = jax.vmap(lambda k: Random()(task, belief, session, options, k))(keys)
        return free, Gain()(task, belief, session, options, key), belief.weights

    keys = jax.random.split(jax.random.key(0), len(counts))
    free, best, weights = choose(tasks, keys)
    assert (np.asarray(free) < counts[:, None]).all()
    assert (np.asarray(best) < counts).all()
    np.testing.assert_allclose(np.asarray(weights).sum(axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (Limits(states=1023), "at most 1,023 states, got 1,024"),
        (Limits(designs=61), "at most 61 designs, got 62"),
        (Limits(outcomes=1), "at most 1 outcomes, got 2"),
        (Limits(uses=2), "at most 2 uses, got 3"),
        (Limits(measurements=31), "at most 31 measurements, got 32"),
        (Limits(groups=1), "at most 1 groups, got 2"),
    ],
)
def test_a_task_beyond_the_shapes_is_refused_with_the_limit(limits, message):
    with pytest.raises(ValueError, match=message):
        pad(knee(), limits)


def scaled(task: GridTask, factor: float) -> GridTask:
    return dataclasses.replace(
        task, travel=task.travel * factor, extra=task.extra * factor,
        seconds=task.seconds * factor,
    )  # fmt: skip


@pytest.mark.parametrize("budget", ["time", "time+uses"])
def test_the_unit_of_time_changes_no_choice_of_shares(budget):
    task = draw(11, "thresholds", budget, SHAPE)
    keys = jax.random.split(jax.random.key(0), 64)
    one, other = (play(scaled(task, factor), SHARES, keys) for factor in (1.0, 2.0**10))
    np.testing.assert_array_equal(one.designs * one.alive, other.designs * other.alive)
    assert one.alive.any(axis=0).sum() > 2


@pytest.mark.slow
def test_the_default_looks_ahead_where_time_or_uses_count():
    budget = {"seconds": 9.0, "uses": 2}
    counted, free = knee(8, sigma=0.05), draw(3, "band", "number", SHAPE)
    made = [(5, 0)]
    mine = next_measurement(counted, made, **budget)
    fitted = fit(counted, **budget)
    assert (
        mine.design == next_measurement(counted, made, fitted, **budget, seed=3).design
    )
    assert mine.design != next_measurement(counted, made, Gain(), **budget).design
    mine = next_measurement(free, [])
    assert mine.design == next_measurement(free, [], Gain()).design


@pytest.mark.slow
def test_deciding_matters_in_every_structure():
    tasks = [
        pad(draw(900 + seed, structure, limits=SHAPE), SHAPE)
        for structure in ALL
        for seed in range(6)
    ]
    whole = jax.tree.map(jnp.asarray, stack(tasks))
    keys = jax.random.split(jax.random.key(4), 32)

    @jax.jit
    def nats(tasks, rule):
        return jax.vmap(lambda task: play(task, rule, keys).gain.mean())(tasks)

    shares = jax.tree.map(jnp.asarray, SHARES)
    share = (nats(whole, Random()) / nats(whole, shares)).reshape(len(ALL), -1)
    assert share.mean() < 0.7
    assert (share.mean(axis=1) < 0.9).all(), share.mean(axis=1)
