"""Choosing where time counts: the decision problem, the network, its runs."""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.information.regression import log_det_gram
from jaxcal.learning.environments import selection as environment
from jaxcal.learning.environments import travel
from jaxcal.learning.environments.selection import SelectionConfig
from jaxcal.learning.environments.travel import TravelConfig
from jaxcal.learning.policies import geometry, networks
from jaxcal.learning.policies import travel_decoding as decoding
from jaxcal.learning.policies.networks import NetworkConfig
from jaxcal.learning.training import ppo
from jaxcal.learning.training.ppo import PPOConfig, Task
from jaxcal.learning.training.presets import PRESETS
from jaxcal.learning.training.run import TrainConfig
from jaxcal.selection.fastest import travel as seconds

SMALL = NetworkConfig(kind="travel", width=8, encoder_rounds=1, initial_trust=0.25)
CONFIG = TravelConfig(num_candidates=9)

# Compiled: op by op, JAX takes seconds for each episode.
reset = jax.jit(travel.reset, static_argnames="config")
step = jax.jit(travel.step, static_argnames="config")


@pytest.fixture(scope="module")
def made():
    """A network and parameters away from their initial zeros."""
    network = networks.build(SMALL)
    params = jax.jit(network.init)(
        jax.random.key(0),
        jnp.zeros((1, 9, 3)),
        jnp.ones((1, 9), bool),
        jnp.full((1, 4), -1),
        jnp.ones((1, 9), bool),
    )["params"]
    noisy = jax.tree.map(lambda leaf: leaf + 0.1 * jnp.cos(jnp.arange(leaf.size)
                         .reshape(leaf.shape)), params)  # fmt: skip
    return network, noisy


def drawn(rng, m=9, price=1.0):
    """Candidates, tolls between them and from a start, of one set."""
    points = rng.uniform(size=(m, 3))
    motion = seconds.Motion((1.0, 0.5, 2.0), (2.0, 1.0, 3.0))
    start = rng.uniform(size=(1, 3))
    return (
        points.astype(np.float32),
        (price * seconds.travel_times(points, points, motion)).astype(np.float32),
        (price * seconds.travel_times(start, points, motion)[0]).astype(np.float32),
    )


def chosen_by(network, params, points, tolls, entry, k=4, num=1):
    m = len(points)
    picks = decoding.runs(
        network,
        params,
        points[None],
        np.ones((1, m), bool),
        np.zeros((1, 0), np.int32),
        tolls[None],
        entry[None],
        k=k,
        num=num,
    )
    return np.asarray(picks)[:, 0]


def net_value(points, tolls, entry, order):
    order = list(order)
    paid = entry[order[0]] + sum(tolls[i, j] for i, j in itertools.pairwise(order))
    return log_det_gram(points[order].astype(float)) - paid


def test_the_seconds_of_training_are_those_of_the_profile(rng):
    points, others = rng.uniform(size=(2, 6, 3))
    speed, ramp = rng.uniform(0.1, 2.0, (2, 3))
    expected = seconds.travel_times(
        points, others, seconds.Motion(tuple(speed), tuple(ramp))
    )
    got = travel.travel_seconds(*map(jnp.asarray, (points, others, speed, ramp)))
    np.testing.assert_allclose(got, expected, rtol=1e-5)


@pytest.mark.parametrize("k", [4, 6])
def test_an_episode_pays_log_det_less_the_tolls_of_its_order(key, k):
    config = TravelConfig(num_candidates=9, num_selected=k)
    state = reset(key, config)
    tolls, entry = np.asarray(state.tolls), np.asarray(state.entry)
    points, paid = np.asarray(state.candidates), 0.0
    order = [5, 0, 7, 2, 8, 1][:k]
    for action in order:
        state, reward, done = step(state, jnp.asarray(action), config)
        paid += float(reward)
    tolls_of_it = entry[order[0]] + sum(
        tolls[i, j] for i, j in itertools.pairwise(order)
    )
    expected = 3 * (log_det_gram(points[order].astype(float)) - tolls_of_it)
    assert bool(done)
    assert paid == pytest.approx(config.reward_scale * expected, abs=1e-4)
    assert float(state.spent) == pytest.approx(tolls_of_it, rel=1e-5)
    assert float(travel.toll_of(state.tolls, state.entry, jnp.asarray(order))) == (
        pytest.approx(tolls_of_it, rel=1e-5)
    )


def test_weightless_episodes_pay_what_the_plain_problem_pays(key):
    config = TravelConfig(num_candidates=9, weightless=1.0)
    plain = SelectionConfig(num_candidates=9)
    state = reset(key, config)
    assert not np.asarray(state.tolls).any() and not np.asarray(state.entry).any()
    other = environment.start(state.candidates, state.available, plain, key)
    for action in (3, 1, 4, 8):
        state, reward, _ = step(state, jnp.asarray(action), config)
        other, expected, _ = environment.step(other, jnp.asarray(action), plain)
        assert float(reward) == pytest.approx(float(expected), abs=1e-6)


def test_every_episode_has_its_own_weight_start_and_speeds():
    config = TravelConfig(num_candidates=9, free_starts=0.5, weightless=0.2)
    states = jax.vmap(lambda key: travel.reset(key, config))(
        jax.random.split(jax.random.key(2), 400)
    )
    level = np.asarray(states.tolls).mean(axis=(1, 2))
    free = ~np.asarray(states.entry).any(axis=1)
    assert 0.1 < (level == 0).mean() < 0.3
    assert 0.4 < free[level > 0].mean() < 0.6
    priced = level[level > 0]
    assert priced.min() >= 0.02 - 1e-6 and priced.max() <= 6.0 + 1e-4
    assert 0.3 < (priced < np.sqrt(0.02 * 6.0)).mean() < 0.7  # log-uniform
    tolls = np.asarray(states.tolls)
    np.testing.assert_allclose(tolls, np.swapaxes(tolls, 1, 2), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"reward_gain": False}, "reward_gain must be True"),
        ({"weightless": 1.5}, r"weightless must be in \[0, 1\], got 1.5"),
        ({"least_weight": 0.0}, "least_weight must be positive"),
        ({"least_weight": 2.0, "most_weight": 1.0}, "at most most_weight"),
    ],
)
def test_a_configuration_that_makes_no_sense_is_named(wrong, words):
    with pytest.raises(ValueError, match=words):
        TravelConfig(**wrong)


def test_lookahead_with_tolls_is_greedy_by_gain_less_toll(rng):
    points, tolls, _ = drawn(rng)
    x, _ = geometry.whiten(jnp.asarray(points), jnp.ones(9, bool))
    kernel = np.asarray(x, float) @ np.asarray(x, float).T
    values = np.stack(
        geometry.lookahead(x, False, jnp.ones(9, bool), 4, jnp.asarray(tolls))
    )

    def worth(picked):
        moves = sum(tolls[i, j] for i, j in itertools.pairwise(picked))
        return np.linalg.slogdet(kernel[np.ix_(picked, picked)])[1] - moves

    for start in range(9):
        picked = [start]
        for depth in range(4):
            if depth:
                rest = [j for j in range(9) if j not in picked]
                picked = [*picked, max(rest, key=lambda j: worth([*picked, j]))]
            assert values[depth, start] == pytest.approx(worth(picked), abs=1e-4)


def test_without_tolls_the_lookahead_is_the_plain_one(rng):
    points, tolls, _ = drawn(rng)
    x, _ = geometry.whiten(jnp.asarray(points), jnp.ones(9, bool))
    plain = geometry.lookahead(x, False, jnp.ones(9, bool), 4)
    free = geometry.lookahead(x, False, jnp.ones(9, bool), 4, jnp.zeros_like(tolls))
    np.testing.assert_allclose(np.stack(free), np.stack(plain), atol=1e-5)


@pytest.mark.parametrize("learned", [True, False])
def test_the_last_two_choices_are_the_best_pair_in_order(rng, made, learned):
    network, params = made
    for _ in range(5):
        points, tolls, entry = drawn(rng, price=3.0)
        picks = chosen_by(network, params if learned else None, points, tolls, entry)[0]
        best = max(
            net_value(points, tolls, entry, [*picks[:2], *pair])
            for pair in itertools.permutations(set(range(9)) - set(picks[:2]), 2)
        )
        got = net_value(points, tolls, entry, picks)
        assert got == pytest.approx(best, abs=1e-3)


@pytest.mark.parametrize("learned", [True, False])
def test_the_order_of_the_candidates_changes_no_run(rng, made, learned):
    network, params = made
    points, tolls, entry = drawn(rng)
    weights = params if learned else None
    picks = chosen_by(network, weights, points, tolls, entry)[0]
    turn = rng.permutation(9)
    turned = chosen_by(
        network, weights, points[turn], tolls[np.ix_(turn, turn)], entry[turn]
    )[0]
    assert turn[turned].tolist() == picks.tolist()


def test_a_set_without_tolls_is_chosen_as_if_time_did_not_exist(rng, made):
    network, params = made
    points, tolls, entry = drawn(rng)
    zero = chosen_by(network, params, points, 0.0 * tolls, 0.0 * entry)[0]
    view = network.look(points[None], jnp.ones((1, 9), bool))
    with_zero = network.look(
        points[None],
        jnp.ones((1, 9), bool),
        jnp.zeros((1, 9, 9)),
        jnp.zeros((1, 9)),
    )
    jax.tree.map(np.testing.assert_array_equal, view, with_zero)
    assert len(set(zero.tolist())) == 4


def test_dear_time_keeps_the_device_near_its_start(rng):
    network = networks.build(SMALL)
    points, tolls, entry = drawn(rng, m=9)
    cheap = chosen_by(network, None, points, 0.01 * tolls, 0.01 * entry)[0]
    dear = chosen_by(network, None, points, 100.0 * tolls, 100.0 * entry)[0]

    def paid(order):
        return entry[order[0]] + tolls[order[:-1], order[1:]].sum()

    assert paid(dear) < paid(cheap)


def test_masked_and_given_postures_are_respected(rng, made):
    network, params = made
    points, tolls, entry = drawn(rng)
    available = np.arange(9) < 7
    picks = np.asarray(
        decoding.runs(
            network,
            params,
            points[None],
            available[None],
            np.array([[6, 2]], np.int32),
            tolls[None],
            entry[None],
            k=5,
            num=8,
        )
    )[:, 0]
    for run in picks:
        assert run[:2].tolist() == [6, 2]
        assert len(set(run.tolist())) == 5 and run.max() < 7


@pytest.mark.parametrize("k", [4, pytest.param(5, marks=pytest.mark.slow)])
def test_the_first_minibatch_sees_the_probabilities_that_played(k):
    task = Task(TravelConfig(num_candidates=9, num_selected=k), random_starts=0.3)
    network = networks.build(SMALL)
    config = PPOConfig(episodes_per_update=64, episodes_per_set=4, num_minibatches=2)
    state = ppo.init(config, task, network)
    rollout, _ = jax.jit(
        lambda params: ppo._play(config, task, network, params, jax.random.key(1))
    )(state.params)
    _, metrics = jax.jit(
        lambda params: ppo._loss(params, rollout, jnp.float32(0), config, task, network)
    )(state.params)
    assert abs(float(metrics["kl"])) < 1e-6


def test_the_preset_survives_its_own_meta():
    config = PRESETS["travel"]
    assert TrainConfig.from_meta(config.as_meta()) == config
    assert all(isinstance(task.environment, TravelConfig) for task in config.tasks)


def test_the_network_starts_from_the_rule_without_learning(rng):
    # The trust in the look-ahead is there from the start: untrained, it agrees with the
    # rule in far more sets than a blind network could.
    trust = PRESETS["travel"].network.initial_trust
    network = networks.build(dataclasses.replace(SMALL, initial_trust=trust))
    params = jax.jit(lambda: ppo.init(PPOConfig(), Task(CONFIG), network).params)()
    same = 0
    for _ in range(20):
        points, tolls, entry = drawn(rng)
        rule = chosen_by(network, None, points, tolls, entry)[0]
        same += int((chosen_by(network, params, points, tolls, entry)[0] == rule).all())
    assert same >= 10
