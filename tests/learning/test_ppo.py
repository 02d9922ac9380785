"""PPO: advantages, the surrogate's bookkeeping, learning, one compilation."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.flatten_util import ravel_pytree

import jaxcal.learning
from jaxcal.learning.config import EpisodesConfig, NetworkConfig, StreamsConfig
from jaxcal.learning.core import network as networks
from jaxcal.learning.core import ppo
from jaxcal.learning.core.network import build
from jaxcal.learning.core.postures import Postures
from jaxcal.learning.environments.selection import SelectionConfig
from jaxcal.learning.environments.task import Task
from jaxcal.learning.training.presets import TrainConfig
from jaxcal.learning.training.run import Recipe, compiled_update, run
from jaxcal.selection import exact_batch

SMALL = NetworkConfig(width=8, encoder_rounds=1)
TINY = EpisodesConfig(
    num_episodes=64 * 40,
    episodes_per_update=64,
    episodes_per_set=4,
    num_minibatches=2,
    warmup_updates=1,
)


def episodes(config, rewards, values):
    """Advantages of complete episodes (T, ...): the value after the last is 0."""
    rewards, values = jnp.asarray(rewards), jnp.asarray(values)
    next_value = jnp.concatenate([values[1:], jnp.zeros_like(values[:1])])
    continues = jnp.ones_like(values).at[-1].set(0.0)
    return ppo.advantages(config, rewards, values, next_value, continues)


def test_advantages_are_those_of_the_definition(rng):
    rewards, values = rng.normal(size=(2, 5, 3))
    config = dataclasses.replace(TINY, discount=0.9, gae_lambda=0.8)
    got = episodes(config, rewards, values)
    deltas = rewards + 0.9 * np.vstack([values[1:], np.zeros((1, 3))]) - values
    for t in range(5):
        weights = (0.9 * 0.8) ** np.arange(5 - t)
        np.testing.assert_allclose(got[t], weights @ deltas[t:], rtol=1e-5)


def test_undiscounted_advantages_are_return_less_value(rng):
    rewards, values = rng.normal(size=(2, 4, 2))
    got = episodes(TINY, rewards, values)
    returns = np.cumsum(rewards[::-1], axis=0)[::-1]
    np.testing.assert_allclose(got, returns - values, rtol=1e-5, atol=1e-6)


def test_an_advantage_ends_with_its_session_and_counts_what_follows_by_its_chance():
    """A session of two choices, then one of another: by hand, lambda 0.5."""
    config = StreamsConfig(gae_lambda=0.5)
    chance, others = jnp.array([0.25, 0.5, 1.0]), jnp.array([3.0, 8.0, 0.0])
    continues, after = jnp.array([1.0, 0.0, 1.0]), jnp.array([20.0, 30.0, 40.0])
    found = ppo.advantages(
        config,
        jnp.array([1.0, 2.0, 4.0]),
        jnp.array([10.0, 20.0, 30.0]),
        chance * continues * after + others,
        continues,
    )
    last = 4.0 + 40.0 - 30.0  # cut: closed by the last value
    second = 2.0 + 8.0 - 20.0  # this outcome ended the session, another would not
    first = 1.0 + 0.25 * 20.0 + 3.0 - 10.0 + 0.5 * second
    np.testing.assert_allclose(found, [first, second, last])


def test_the_loss_is_that_of_the_definition(rng):
    """In float64 by loops, with errors of the value on both sides of the limit."""
    config = dataclasses.replace(
        TINY, clip_range=0.2, value_error_limit=3.0, entropy_start=0.1, entropy_end=0.1
    )
    logits, shape = rng.normal(size=(6, 2, 5)), (6, 2)
    value, target = rng.normal(size=shape), rng.normal(size=shape) * 6.0
    action = rng.integers(5, size=shape)
    before, advantage = -np.abs(rng.normal(size=shape)) - 1.0, rng.normal(size=shape)
    assert (abs(value - target) > 3.0).any() and (abs(value - target) < 3.0).any()
    batch = ppo.Batch(
        observations=None,
        action=jnp.asarray(action),
        log_prob=jnp.asarray(before),
        advantage=jnp.asarray(advantage),
        target=jnp.asarray(target),
    )
    found, metrics = ppo.surrogate(
        config, jnp.asarray(logits), jnp.asarray(value), batch, jnp.int32(0)
    )
    gain = error = entropy = kl = 0.0
    for at in np.ndindex(shape):
        shares = np.exp(logits[at]) / np.exp(logits[at]).sum()
        ratio = shares[action[at]] / np.exp(before[at])
        gain += min(ratio * advantage[at], np.clip(ratio, 0.8, 1.2) * advantage[at])
        wrong = abs(value[at] - target[at])
        error += wrong**2 if wrong <= 3.0 else 9.0 + 6.0 * (wrong - 3.0)
        entropy -= (shares * np.log(shares)).sum()
        kl += ratio - 1.0 - np.log(ratio)
    number = action.size
    np.testing.assert_allclose(metrics["policy_loss"], -gain / number, rtol=1e-5)
    np.testing.assert_allclose(metrics["value_loss"], error / number, rtol=1e-5)
    np.testing.assert_allclose(metrics["kl"], kl / number, rtol=1e-4)
    whole = -gain + config.value_coefficient * error - 0.1 * entropy
    np.testing.assert_allclose(found, whole / number, rtol=1e-5)


@pytest.mark.parametrize("least", [-1e9, -np.inf])
def test_a_mask_of_minus_infinity_is_taken(least):
    one = jnp.zeros((1, 1))
    batch = ppo.Batch(None, one.astype(int), one - 0.7, one + 1.0, one)

    def loss(free):
        logits = jnp.array([0.0, 0.0, least]).at[1].set(free)[None, None]
        return ppo.surrogate(TINY, logits, one, batch, 0)[0]

    value, gradient = jax.value_and_grad(loss)(0.3)
    expected, slope = jax.value_and_grad(
        lambda free: ppo.surrogate(
            TINY, jnp.array([0.0, free])[None, None], one, batch, 0
        )[0]
    )(0.3)
    np.testing.assert_allclose([value, gradient], [expected, slope], rtol=1e-6)


@pytest.mark.slow
def test_it_trains_with_64_bits_switched_on():
    code = (
        "import jax\n"
        "from jaxcal.learning import SelectionConfig, Task, make_train\n"
        "from jaxcal.learning import EpisodesConfig, NetworkConfig, TrainConfig\n"
        "ppo = EpisodesConfig(num_episodes=128, episodes_per_update=64,\n"
        "    episodes_per_set=4, num_minibatches=2, warmup_updates=1)\n"
        "task = Task(SelectionConfig(8, 3, 2, 2))\n"
        "config = TrainConfig(network=NetworkConfig(width=8, encoder_rounds=0),\n"
        "    ppo=ppo, tasks=(task,))\n"
        "state, metrics = jax.jit(make_train(config))(jax.random.key(0))\n"
        "assert not metrics['skipped'].any(), metrics\n"
    )
    wide = os.environ | {"JAX_ENABLE_X64": "1"}
    subprocess.run([sys.executable, "-c", code], env=wide, check=True)


def test_a_value_that_is_far_off_is_still_pulled():
    """The square of a clipped error has no gradient beyond the limit of 3."""
    none = jnp.zeros((1, 1))
    batch = ppo.Batch(None, none.astype(int), none, none, none)

    def loss(value):
        found = ppo.surrogate(TINY, none[..., None], value[None, None], batch, 0)
        return found[1]["value_loss"]

    found = jax.vmap(jax.grad(loss))(jnp.array([-100.0, -3.0, 0.5, 3.0, 100.0]))
    np.testing.assert_allclose(found, [-6.0, -6.0, 1.0, 6.0, 6.0])


@pytest.mark.parametrize("size", [1e-3, 0.2, 30.0])
def test_a_gradient_step_is_that_of_optax(rng, size):
    """Clipping by the global norm, then Adam under the schedule."""
    config = dataclasses.replace(TINY, num_minibatches=1, num_epochs=1)
    params = {"a": rng.normal(size=(7, 3)), "b": rng.normal(size=4)}
    params = jax.tree.map(jnp.asarray, params)
    grads = jax.tree.map(lambda leaf: size * jnp.sin(leaf), params)
    ours = ppo.TrainState(
        params,
        params,
        ppo.optimiser(config).init(ravel_pytree(params)[0]),
        None,
        jnp.int32(0),
    )
    chain = optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm),
        optax.adam(ppo.schedule(config), eps=1e-5),
    )
    state, theirs = chain.init(params), params
    for _ in range(2):
        ours, norm = ppo.descend(config, ours, grads)
        np.testing.assert_allclose(norm, optax.tree.norm(grads), rtol=1e-6)
        changes, state = chain.update(grads, state, theirs)
        theirs = optax.apply_updates(theirs, changes)
    for name in params:
        np.testing.assert_allclose(ours.params[name], theirs[name], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "n", "k"),
    [
        ("compact", 1, 3),
        pytest.param("compact", 2, 3, marks=pytest.mark.slow),
        pytest.param("paper", 1, 4, marks=pytest.mark.slow),
    ],
)
def test_the_first_minibatch_sees_the_probabilities_that_played(kind, n, k):
    # Play and loss compute the same probabilities in differently compiled programs;
    # a difference here would silently make every gradient wrong.
    task = Task(SelectionConfig(12, k, n, n))
    config = dataclasses.replace(TINY, episodes_per_update=512)
    learner = Postures(config, task, build(dataclasses.replace(SMALL, kind=kind)))
    params = learner.init(jax.random.key(0))

    @jax.jit
    def play(params):
        keys = jax.random.split(jax.random.key(1), config.rows_per_update)
        return learner.rollout(params, learner.begin(keys))[0]

    played = play(params)
    _, metrics = jax.jit(learner.loss)(params, played, jnp.int32(0))
    assert abs(float(metrics["kl"])) < 1e-6


class Shelf(NamedTuple):
    """An episode of ``Pick``: take one of several numbers."""

    candidates: jax.Array  # (M, 1)
    available: jax.Array  # (M,) bool
    chosen: jax.Array  # (1,) int32


@dataclasses.dataclass(frozen=True)
class Pick:
    """A probe environment: one decision, which pays the number that is chosen."""

    num_decisions: int = 1
    value_scale: float = 1.0
    payment: float = 1.0

    def reset(self, key):
        return Shelf(
            jax.random.uniform(key, (6, 1)), jnp.ones(6, bool), -jnp.ones(1, int)
        )

    def step(self, state, action):
        return (
            state._replace(chosen=action[None]),
            self.payment * state.candidates[action, 0],
            jnp.array(True),
        )

    def paid(self, state):
        return jnp.zeros(())

    def outcome(self, state):
        return state.candidates[state.chosen[0], 0]


class Slope(networks.Network):
    """Scores a number by a learned slope; its value is a learned constant."""

    def setup(self):
        self.slope = self.param("slope", nn.initializers.zeros, ())
        self.value = self.param("value", nn.initializers.zeros, ())

    def candidate_features(self, candidates, usable):
        return candidates[..., 0]

    def decision_features(self, features, chosen, available, count):
        return available

    def encode(self, features):
        return self.slope * features

    def decode(self, memory, available):
        logits = networks.mask_logits(
            jnp.broadcast_to(memory, available.shape), available
        )
        return logits, jnp.broadcast_to(self.value, logits.shape[:-1])


@dataclasses.dataclass(frozen=True)
class Probe:
    """What ``make_train`` needs of a configuration."""

    ppo: EpisodesConfig

    tasks: tuple[Pick, ...] = (Pick(),)
    seed: int = 3
    num_seeds: int = 1
    validate_every: float = 15.0
    save_every: float = 60.0

    def as_meta(self):
        return {}

    @property
    def learners(self):
        return tuple(Postures(self.ppo, task, Slope()) for task in self.tasks)


PROBE = Probe(dataclasses.replace(TINY, learning_rate=0.3, entropy_start=0.0))
train = jax.jit(ppo.make_train(PROBE))


def test_value_and_policy_are_learned_in_a_probe_environment():
    state, metrics = train(jax.random.key(0))
    rewards = metrics["reward_mean"]
    assert metrics["rewards"].shape == (40, 64)
    # At random 1/2; the largest of six uniform numbers is 6/7 on average.
    assert abs(rewards[0] - 0.5) < 0.1 and np.mean(rewards[-5:]) > 0.75
    assert abs(float(state.average["value"]) - np.mean(rewards[-5:])) < 0.1


@pytest.mark.slow
def test_training_maps_over_seeds():
    """Each of several in one program is what it is alone, and no two are the same."""
    keys = jax.random.split(jax.random.key(5), 3)
    several, _ = jax.jit(jax.vmap(ppo.make_train(PROBE)))(keys)
    slopes = several.average["slope"]
    assert len(set(np.asarray(slopes).tolist())) == 3
    alone, _ = train(keys[1])
    np.testing.assert_allclose(slopes[1], alone.average["slope"], rtol=1e-4)


@pytest.mark.parametrize(
    "tasks",
    [
        (Pick(),),
        pytest.param((Pick(), Pick(payment=0.5)), marks=pytest.mark.slow),
    ],
)
def test_a_run_trains_what_the_pure_function_does(tmp_path, tasks):
    """Also where two tasks take turns."""
    config = Probe(PROBE.ppo, tasks)
    pure = train if config == PROBE else jax.jit(ppo.make_train(config))
    pure, metrics = pure(jax.random.key(3))
    recipe = Recipe(config, (), "probe", (), (), validate=None)
    state = run(recipe, tmp_path)
    for one, other in zip(
        *map(jax.tree.leaves, (pure.average, state.average)), strict=True
    ):
        np.testing.assert_allclose(one, other, atol=1e-5)
    rows = np.genfromtxt(tmp_path / "metrics.csv", delimiter=",", names=True)
    np.testing.assert_allclose(metrics["reward_mean"], rows["reward_mean"], atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 6])
def test_an_update_in_slices_is_that_of_the_whole(size):
    """8 rows in 6 become slices of 2."""
    ends = []
    for rows in (size, 8):
        config = dataclasses.replace(
            TINY, episodes_per_update=32, num_minibatches=1, slice_rows=rows
        )
        learner = Postures(config, Task(SelectionConfig(8, 4, 1, 1)), build(SMALL))
        state = ppo.begin(config, learner, jax.random.key(0))
        ends.append(jax.jit(ppo.make_update(config, learner))(state))
    for a, b in zip(*map(jax.tree.leaves, ends), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)


def test_an_update_repeats_to_the_bit_and_a_seed_compiles_nothing():
    config, (learner,) = PROBE.ppo, PROBE.learners
    update = compiled_update(config, learner, None, 0)  # as ``run`` asks for it
    assert compiled_update(config, learner, None, 0) is update
    ends = []
    for _ in range(2):
        state = ppo.begin(config, learner, jax.random.key(3))
        for _ in range(3):
            state, metrics = update(state)
            assert metrics["rewards"].shape == (64,)
        ends.append((state, metrics))
    for one, other in zip(*map(jax.tree.leaves, ends), strict=True):
        np.testing.assert_array_equal(one, other)
    update(ppo.begin(config, learner, jax.random.key(4)))
    assert update._cache_size() == 1


@pytest.mark.slow
def test_the_policy_learns_on_a_small_task():
    # Without the look ahead, so that it must learn by itself; judged by the optimum.
    config = TrainConfig(
        network=dataclasses.replace(SMALL, lookahead=1, width=16),
        ppo=dataclasses.replace(
            TINY, num_episodes=512 * 40, episodes_per_update=512, learning_rate=5e-3
        ),
        tasks=(Task(SelectionConfig(8, 3, 2, 2)),),
    )
    _, metrics = jax.jit(ppo.make_train(config))(jax.random.key(0))
    rewards = metrics["reward_mean"]
    sets = np.random.default_rng(0).random((2000, 8, 2))
    optimum = 0.1 * exact_batch(sets, 3).log_det.mean()
    begun, ended = np.mean(rewards[:3]), np.mean(rewards[-5:])
    assert ended - begun > 0.8 * (optimum - begun)
    assert float(metrics["value_loss"][-1]) < 0.2


def test_the_averaged_weights_owe_nothing_to_the_initial_ones(rng):
    # A mean with weights decay^age that add up to one, from the first step on.
    config = dataclasses.replace(
        TINY, num_minibatches=1, num_epochs=1, average_decay=0.9, learning_rate=0.1
    )
    params = {"w": jnp.asarray(rng.normal(size=3) + 100.0, jnp.float32)}
    state = ppo.TrainState(
        params=params,
        average=params,
        opt_state=ppo.optimiser(config).init(ravel_pytree(params)[0]),
        key=jax.random.key(0),
        num_updates=jnp.zeros((), jnp.int32),
    )
    data, seen = jnp.asarray(rng.normal(size=(4, 3)), jnp.float32), []
    for _ in range(4):
        grads = jax.grad(lambda w: ((w[None] - data) ** 2).sum())(state.params["w"])
        state, _ = ppo.descend(config, state, {"w": grads})
        seen.append(np.asarray(state.params["w"], np.float64))
        ages = 0.9 ** np.arange(len(seen))[::-1]
        expected = ages @ np.stack(seen) / ages.sum()
        np.testing.assert_allclose(state.average["w"], expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"episodes_per_update": 100}, "episodes_per_update"),
        ({"num_epochs": 0}, "num_epochs"),
        ({"learning_rate": 0.0}, "learning_rate"),
        ({"gae_lambda": 1.5}, "gae_lambda"),
        ({"average_decay": 1.0}, "average_decay"),
        ({"explore_once": True, "episodes_per_set": 1}, "episodes_per_set must be at"),
    ],
)
def test_a_bad_configuration_is_named(values, named):
    with pytest.raises(ValueError, match=named):
        EpisodesConfig(**values)


def test_a_bad_seed_is_named():
    with pytest.raises(ValueError, match="seed must be 0 or more, got -1"):
        TrainConfig(seed=-1)


@pytest.mark.slow
def test_a_training_is_asked_for_by_name_by_configuration_or_by_learner():
    config = jaxcal.learning.preset("compact")
    wanted = jax.eval_shape(ppo.make_train(config), jax.random.key(0))
    for asked in ("compact", config.learners[0]):
        train = jaxcal.learning.make_train(asked)
        assert jax.eval_shape(train, jax.random.key(0)) == wanted


def test_what_no_training_can_be_made_of_is_named():
    with pytest.raises(ValueError, match=r"preset must be one of .*, got 'small'"):
        jaxcal.learning.make_train("small")
    with pytest.raises(ValueError, match=r"a TrainConfig or a learner, got int"):
        jaxcal.learning.make_train(4)
    for name in jaxcal.learning.__all__:
        assert getattr(jaxcal.learning, name) is not None
