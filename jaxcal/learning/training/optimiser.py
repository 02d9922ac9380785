"""From a loss to new weights: a run's state, the optimiser, epochs of minibatches."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from jaxcal.learning.policies import networks
from jaxcal.learning.policies.networks import Network
from jaxcal.learning.training.config import PPOConfig
from jaxcal.learning.training.rules import Rules

__all__ = ["Keys", "TrainState", "init", "learn", "learning_rate", "optimiser"]

Metrics = dict[str, jax.Array]
Loss = Callable[[Any, Any], tuple[jax.Array, Metrics]]
"""(parameters, a minibatch) -> loss and metrics."""


class Keys(NamedTuple):
    """The three random streams of a run; no number is drawn from two of them."""

    weights: jax.Array  # () initial parameters
    updates: jax.Array  # () episodes and minibatches, see TrainState.key
    lessons: jax.Array  # () what is imitated

    @staticmethod
    def of(seed: int) -> Keys:
        """From one seed, split once; ``fold_in(key, i)`` would be ``split(key)[i]``."""
        return Keys(*jax.random.split(jax.random.key(seed), 3))


@struct.dataclass
class TrainState:
    """All that an uninterrupted run would need to go on, bit for bit."""

    params: Any  # network parameters
    average: Any  # exponential average of the parameters, what a checkpoint offers
    opt_state: Any  # optax state
    key: jax.Array  # (2,) uint32, data of the PRNG key of the next update
    num_updates: jax.Array  # () int32, updates made


# One program: op by op it would be two hundred small ones, seconds to compile.
@functools.partial(jax.jit, static_argnames=("config", "task", "network"))
def init(config: PPOConfig, task: Rules, network: Network) -> TrainState:
    """The state before the first update, from the seed alone."""
    keys = Keys.of(config.seed)
    m, n = jax.eval_shape(task.reset, keys.updates).candidates.shape
    params = networks.initial(network, keys.weights, m, n, task.num_decisions)
    return TrainState(
        params=params,
        average=jax.tree.map(jnp.copy, params),
        opt_state=optimiser(config).init(params),
        key=jax.random.key_data(keys.updates),
        num_updates=jnp.zeros((), jnp.int32),
    )


def learn(
    state: TrainState,
    config: PPOConfig,
    num_sets: int,
    minibatch: Callable[[jax.Array], Any],
    loss: Loss,
    key: jax.Array,
) -> tuple[TrainState, Metrics]:
    """Epochs of minibatches over the ``num_sets`` sets that an update has gathered.

    Args:
        state, config: before the update, and how to optimise.
        num_sets: candidate sets gathered, B.
        minibatch: (S,) indices of sets -> what was gathered of them.
        loss: of a minibatch.
        key: orders the minibatches.

    Returns:
        The state after the update, its key as it was; the mean of each metric.
    """
    optimise = optimiser(config)
    size = num_sets // config.num_minibatches

    def step(carry: Any, index: jax.Array) -> tuple[Any, Metrics]:
        params, average, opt_state, count = carry
        grads, metrics = jax.grad(loss, has_aux=True)(params, minibatch(index))
        changes, opt_state = optimise.update(grads, opt_state, params)
        params = optax.apply_updates(params, changes)
        # The share of the newest weights in a mean whose weights decay and add up to
        # one: 1 at the first step, so that nothing of the initial weights stays.
        decay = config.average_decay
        share = (1.0 - decay) / (1.0 - decay ** (count + 1))
        average = optax.incremental_update(params, average, share)
        return (params, average, opt_state, count + 1), metrics

    def epoch(carry: Any, key: jax.Array) -> tuple[Any, Metrics]:
        order = jax.random.permutation(key, num_sets)
        return jax.lax.scan(step, carry, order.reshape(config.num_minibatches, size))

    count = state.num_updates * config.steps_per_update
    carry = (state.params, state.average, state.opt_state, count)
    keys = jax.random.split(key, config.num_epochs)
    (params, average, opt_state, _), metrics = jax.lax.scan(epoch, carry, keys)
    state = dataclasses.replace(
        state,
        params=params,
        average=average,
        opt_state=opt_state,
        num_updates=state.num_updates + 1,
    )
    return state, {name: value.mean() for name, value in metrics.items()}


def optimiser(config: PPOConfig) -> optax.GradientTransformation:
    """Adam under a warmed-up cosine schedule, gradients clipped by global norm."""
    return optax.chain(
        _clip_by_global_norm(config.max_grad_norm),
        optax.adam(_schedule(config), eps=1e-5),
    )


def _clip_by_global_norm(limit: float) -> optax.GradientTransformation:
    """``optax.clip_by_global_norm`` as one factor for every gradient.

    optax divides each gradient by the norm; XLA fuses a division into neither of Adam's
    moments and writes the clipped gradients to memory first. The factor saves 7 to 14 %
    of an update of the paper's network.
    """

    def clip(grads: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        norm = jnp.sqrt(sum(jnp.vdot(grad, grad) for grad in jax.tree.leaves(grads)))
        factor = jnp.minimum(1.0, limit / jnp.maximum(norm, 1e-30))
        return jax.tree.map(lambda grad: grad * factor, grads), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), clip)


def _schedule(config: PPOConfig) -> optax.Schedule:
    steps = config.steps_per_update
    return optax.warmup_cosine_decay_schedule(
        init_value=config.learning_rate / 10,
        peak_value=config.learning_rate,
        warmup_steps=max(config.warmup_updates, 1) * steps,
        decay_steps=max(config.num_updates, config.warmup_updates + 1) * steps,
        end_value=config.final_learning_rate,
    )


def learning_rate(config: PPOConfig, update: int) -> float:
    """The learning rate after an update."""
    return float(_schedule(config)(update * config.steps_per_update))
