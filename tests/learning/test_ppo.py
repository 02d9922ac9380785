"""PPO: advantages, the surrogate's bookkeeping, learning, one compilation."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxcal.learning.environments.selection import SelectionConfig
from jaxcal.learning.environments.task import Task
from jaxcal.learning.policies import networks
from jaxcal.learning.policies.build import build
from jaxcal.learning.policies.networks import NetworkConfig
from jaxcal.learning.training import optimiser, ppo, rollout
from jaxcal.learning.training.config import PPOConfig
from jaxcal.learning.training.ppo import surrogate

SMALL = NetworkConfig(width=8, encoder_rounds=1)
TINY = PPOConfig(
    num_episodes=64 * 40,
    episodes_per_update=64,
    episodes_per_set=4,
    num_minibatches=2,
    warmup_updates=1,
)


def test_advantages_are_those_of_the_definition(rng):
    rewards, values = rng.normal(size=(2, 5, 3))
    got = rollout.advantages(jnp.asarray(rewards), jnp.asarray(values), 0.9, 0.8)
    deltas = rewards + 0.9 * np.vstack([values[1:], np.zeros((1, 3))]) - values
    for t in range(5):
        weights = (0.9 * 0.8) ** np.arange(5 - t)
        np.testing.assert_allclose(got[t], weights @ deltas[t:], rtol=1e-5)


def test_undiscounted_advantages_are_return_less_value(rng):
    rewards, values = rng.normal(size=(2, 4, 2))
    got = rollout.advantages(jnp.asarray(rewards), jnp.asarray(values), 1.0, 1.0)
    returns = np.cumsum(rewards[::-1], axis=0)[::-1]
    np.testing.assert_allclose(got, returns - values, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("size", [1e-3, 0.2, 30.0])
def test_clipping_is_that_of_optax(rng, size):
    grads = {"a": size * rng.normal(size=(7, 3)), "b": size * rng.normal(size=4)}
    grads = jax.tree.map(jnp.asarray, grads)
    ours = optimiser._clip_by_global_norm(0.5)
    theirs = optax.clip_by_global_norm(0.5)
    got, _ = ours.update(grads, ours.init(grads))
    expected, _ = theirs.update(grads, theirs.init(grads))
    for name in grads:
        np.testing.assert_allclose(got[name], expected[name], rtol=1e-5)


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
    env = SelectionConfig(12, k, n, n)
    task = Task(env, random_starts=0.5)
    network = build(dataclasses.replace(SMALL, kind=kind))
    config = dataclasses.replace(TINY, episodes_per_update=512)
    state = optimiser.init(config, task, network)
    keys = jax.random.split(jax.random.key(1), 3)

    @jax.jit
    def play(params):
        sets = rollout.draw(task, 128, keys[0])
        return rollout.play(config, task, network, params, sets, keys[1], keys[2])

    played, _ = play(state.params)
    _, metrics = jax.jit(
        lambda params: surrogate(params, played, jnp.float32(0), config, task, network)
    )(state.params)
    assert abs(float(metrics["kl"])) < 1e-6


class Shelf(NamedTuple):
    """An episode of ``Pick``: take one of several numbers."""

    candidates: jax.Array  # (M, 1)
    available: jax.Array  # (M,) bool
    chosen: jax.Array  # (1,) int32


@dataclasses.dataclass(frozen=True)
class Pick:
    """A probe environment: one decision, which pays the number that is chosen."""

    random_starts: float = 0.0
    num_decisions: int = 1
    value_scale: float = 1.0

    def reset(self, key):
        return Shelf(
            jax.random.uniform(key, (6, 1)), jnp.ones(6, bool), -jnp.ones(1, int)
        )

    def step(self, state, action):
        return (
            state._replace(chosen=action[None]),
            state.candidates[action, 0],
            jnp.array(True),
        )

    def paid(self, state):
        return jnp.zeros(())

    def outcome(self, state):
        return state.candidates[state.chosen[0], 0]


class Slope(nn.Module):
    """Scores a number by a learned slope; its value is a learned constant."""

    num_unlearned = 0

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

    def __call__(self, candidates, usable, chosen, available):
        return self.decode(self.encode(candidates[..., 0]), available)


def test_value_and_policy_are_learned_in_a_probe_environment():
    config = dataclasses.replace(TINY, learning_rate=0.3, entropy_start=0.0)
    state = optimiser.init(config, Pick(), Slope())
    update = ppo.updater(config, Pick(), Slope())
    assert ppo.updater(config, Pick(), Slope()) is update
    rewards = []
    for _ in range(config.num_updates):
        state, metrics = update(state)
        rewards.append(float(metrics["reward_mean"]))
    assert update._cache_size() == 1
    assert int(state.num_updates) == 40 and metrics["rewards"].shape == (64,)
    # At random 1/2; the largest of six uniform numbers is 6/7 on average.
    assert abs(rewards[0] - 0.5) < 0.1 and np.mean(rewards[-5:]) > 0.75
    assert abs(float(state.average["value"]) - np.mean(rewards[-5:])) < 0.1


@pytest.mark.slow
def test_the_policy_learns_on_a_small_task():
    # Without the look ahead, so that it must learn by itself.
    network = build(dataclasses.replace(SMALL, lookahead=1, width=16))
    config = dataclasses.replace(
        TINY, num_episodes=512 * 40, episodes_per_update=512, learning_rate=5e-3
    )
    task = Task(SelectionConfig(8, 3, 2, 2))
    state = optimiser.init(config, task, network)
    rewards = []
    update = ppo.updater(config, task, network)
    for _ in range(config.num_updates):
        state, metrics = update(state)
        rewards.append(float(metrics["reward_mean"]))
    assert np.mean(rewards[-5:]) > np.mean(rewards[:3]) + 0.3
    assert float(metrics["value_loss"]) < 0.2


def test_the_averaged_weights_owe_nothing_to_the_initial_ones(rng):
    # A mean with weights decay^age that add up to one, from the first step on.
    config = dataclasses.replace(
        TINY, num_minibatches=1, num_epochs=1, average_decay=0.9, learning_rate=0.1
    )
    params = {"w": jnp.asarray(rng.normal(size=3) + 100.0, jnp.float32)}
    state = optimiser.TrainState(
        params=params,
        average=params,
        opt_state=optimiser.optimiser(config).init(params),
        key=jax.random.key(0),
        num_updates=jnp.zeros((), jnp.int32),
    )
    data, seen = jnp.asarray(rng.normal(size=(4, 3)), jnp.float32), []
    for _ in range(4):
        state, _ = optimiser.learn(
            state,
            config,
            4,
            lambda index: data[index],
            lambda params, rows: (((params["w"][None] - rows) ** 2).sum(), {}),
            jax.random.key(1),
        )
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
        ({"seed": -1}, "seed"),
    ],
)
def test_a_bad_configuration_is_named(values, named):
    with pytest.raises(ValueError, match=named):
        PPOConfig(**values)
