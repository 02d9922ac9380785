"""Train a policy on an environment of one's own, CartPole in JAX, with jaxcal's PPO.

python examples/cartpole.py           # 60 updates
python examples/cartpole.py --full    # 150 updates of three seeds

The physics are those of Barto, Sutton and Anderson 1983, as Gymnasium's CartPole-v1 has
them; an episode pays 1 a step and ends when the pole falls, or after 500 steps.
"""

from __future__ import annotations

import dataclasses
import sys
from typing import Any, NamedTuple

import common
import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from jaxcal.learning import Step, Streams, StreamsConfig, make_train

HORIZON = 500


class Pole(NamedTuple):
    """x, its speed, the angle, its speed; steps made."""

    physics: jax.Array  # (4,)
    count: jax.Array  # ()


@dataclasses.dataclass(frozen=True)
class CartPole:
    """The environment; it needs no task, so ``task`` is None."""

    def reset(self, task: None, key: jax.Array) -> Pole:
        return Pole(
            jax.random.uniform(key, (4,), minval=-0.05, maxval=0.05), jnp.zeros(())
        )

    def observe(self, task: None, state: Pole, key: jax.Array) -> jax.Array:
        return jnp.append(state.physics, state.count / HORIZON)

    def step(self, task: None, state: Pole, seen: Any, action: Any, key: Any) -> Step:
        _, v, angle, spin = state.physics
        force, sine, cosine = 20.0 * action - 10.0, jnp.sin(angle), jnp.cos(angle)
        push = (force + 0.05 * spin**2 * sine) / 1.1
        turn = (9.8 * sine - cosine * push) / (
            0.5 * (4.0 / 3.0 - 0.1 * cosine**2 / 1.1)
        )
        move = push - 0.05 * turn * cosine / 1.1
        after = state.physics + 0.02 * jnp.stack([v, move, spin, turn])
        count = state.count + 1.0
        fallen = (jnp.abs(after[0]) > 2.4) | (jnp.abs(after[2]) > 12.0 * jnp.pi / 180.0)
        return Step.known(Pole(after, count), 1.0, fallen | (count >= HORIZON))


class Network(nn.Module):
    """Logits of the two pushes, and the value."""

    @nn.compact
    def __call__(self, seen: jax.Array) -> tuple[jax.Array, jax.Array]:
        policy, value = seen, seen
        for _ in range(2):
            policy = nn.tanh(nn.Dense(64)(policy))
            value = nn.tanh(nn.Dense(64)(value))
        logits = nn.Dense(2, kernel_init=nn.initializers.orthogonal(0.01))(policy)
        return logits, 50.0 * nn.Dense(1)(value)[..., 0]


def learner(updates: int) -> Streams:
    """32 streams of 128 steps an update: sessions go on from one update to the next."""
    config = StreamsConfig(
        num_updates=updates, decisions_per_update=4096, stream_length=128,
        num_epochs=4, learning_rate=2e-3, discount=0.99, gae_lambda=0.95,
        value_coefficient=0.01, value_error_limit=100.0, average_decay=0.9,
    )  # fmt: skip
    return Streams(config, CartPole(), Network())


def study(full: bool) -> np.ndarray:
    """(seeds, updates) mean reward of the episodes that ended in each update."""
    train = make_train(learner(150 if full else 60))
    keys = jax.random.split(jax.random.key(0), 3 if full else 1)
    _, metrics = jax.jit(jax.vmap(lambda key: train(key, None)))(keys)
    return np.asarray(metrics["reward_mean"])


def rows(found: np.ndarray) -> common.Rows:
    """Mean over the seeds, every tenth update."""
    return [
        common.row({"steps": 4096 * (i + 1)}, ("reward",), [found[:, i].mean()], ".1f")
        for i in range(9, found.shape[1], 10)
    ]


def draw(axes, rows: common.Rows) -> None:
    """Reward of an episode by steps played."""
    steps, reward = ([float(row[name]) for row in rows] for name in ("steps", "reward"))
    axes.plot(steps, reward, marker="o")
    axes.set(
        xlabel="steps played", ylabel="reward of an episode", ylim=(0, 1.04 * HORIZON)
    )


if __name__ == "__main__":
    common.main(sys.modules[__name__])
