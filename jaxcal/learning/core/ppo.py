"""Proximal policy optimisation: loss, advantages, optimiser, update, training.

    train = make_train(config)
    weights, metrics = jax.jit(train)(jax.random.key(0))
    jax.vmap(train)(jax.random.split(jax.random.key(0), 8))  # eight runs, one program

A ``Learner`` plays and scores: ``postures`` has that of episodes of a fixed number of
choices, ``streams`` that of sessions of any length. Everything here is pure;
``training.run`` adds files, progress and a host.

Sources: Schulman et al. 2017 (clipped surrogate), 2016 (advantages).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxcal.learning.config import PPOConfig

__all__ = [
    "Batch",
    "Learner",
    "Metrics",
    "TrainState",
    "advantages",
    "begin",
    "make_train",
    "make_update",
    "normalised",
    "placed",
    "schedule",
    "surrogate",
]

Metrics = dict[str, jax.Array]


class Learner(Protocol):
    """What is trained: it plays and it scores.

    ``given`` are arrays that the caller passes through ``train`` or an update, such as
    a task's tables: arguments, so that other values compile nothing.
    """

    def __hash__(self) -> int:
        """Hashable, as a static argument of ``jit``."""

    def init(self, key: jax.Array, *given: Any) -> Any:
        """Parameters before training."""

    def gather(self, params: Any, keys: jax.Array, *given: Any) -> tuple[Any, Metrics]:
        """Play one row of experience per key (B,): leaves (B, ...), and metrics."""

    def loss(
        self, params: Any, experience: Any, done: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """Mean loss and metrics of rows of experience, after ``done`` updates."""


@struct.dataclass
class Batch:
    """Experience that PPO learns from: B rows of T decisions (of several episodes)."""

    seen: Any  # leaves (B, ...): what the learner scores
    action: jax.Array  # (B, T, ...) int32
    log_prob: jax.Array  # (B, T, ...) of the action when it was taken
    advantage: jax.Array  # (B, T, ...)
    target: jax.Array  # (B, T, ...) of the value, reward units


def advantages(
    config: PPOConfig,
    reward: jax.Array,
    value: jax.Array,
    following: jax.Array,
    goes_on: jax.Array,
) -> jax.Array:
    """(T, ...) generalised advantage estimates.

    ``A_t = d_t + discount lambda goes_on_t A_(t+1)``, where ``d_t = reward_t + discount
    following_t - value_t``.

    Args:
        config: discount and lambda.
        reward: (T, ...) of each decision.
        value: (T, ...) before each decision.
        following: (T, ...) value expected after it, 0 where an episode ends.
        goes_on: (T, ...) 0 where an episode ends with the decision, else 1.
    """
    deltas = reward + config.discount * following - value

    def back(later: jax.Array, now: Any) -> tuple[jax.Array, jax.Array]:
        delta, goes_on = now
        advantage = delta + config.discount * config.gae_lambda * goes_on * later
        return advantage, advantage

    start = jnp.zeros_like(deltas[0])
    return jax.lax.scan(back, start, (deltas, goes_on), reverse=True)[1]


def normalised(config: PPOConfig, batch: Batch) -> Batch:
    """Advantages with mean 0 and scale 1, over the batch or for each of the T decisions
    (``normalise_per_decision``), then clipped."""
    axes = 0, *range(2, batch.advantage.ndim)
    over = axes if config.normalise_per_decision else None
    centred = batch.advantage - batch.advantage.mean(over, keepdims=True)
    scaled = centred / (jnp.sqrt((centred**2).mean(over, keepdims=True)) + 1e-6)
    limit = config.advantage_limit
    return dataclasses.replace(batch, advantage=jnp.clip(scaled, -limit, limit))


def surrogate(
    config: PPOConfig,
    logits: jax.Array,
    value: jax.Array,
    batch: Batch,
    done: jax.Array,
) -> tuple[jax.Array, Metrics]:
    """Clipped surrogate, the value's error and an entropy bonus.

    Args:
        config: coefficients and limits.
        logits: (B, T, ..., A) of the decisions in ``batch``, masked by a finite
            minimum.
        value: (B, T, ...) reward units.
        batch: what was played.
        done: () updates made; the entropy bonus follows it.
    """
    log_probs = jax.nn.log_softmax(logits)
    taken = jnp.take_along_axis(log_probs, batch.action[..., None], axis=-1)[..., 0]
    log_ratio = taken - batch.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - config.clip_range, 1.0 + config.clip_range)
    gain = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
    # Squared up to the limit, linear beyond, where a clipped error has no gradient.
    limit = config.value_error_limit
    error = 2.0 * optax.losses.huber_loss(value, batch.target, delta=limit)
    metrics = {
        "policy_loss": -gain.mean(),
        "value_loss": error.mean(),
        "entropy": -(jnp.exp(log_probs) * log_probs).sum(-1).mean(),
        "kl": (ratio - 1.0 - log_ratio).mean(),
    }
    share = jnp.minimum(done / config.num_updates, 1.0)
    bonus = (1.0 - share) * config.entropy_start + share * config.entropy_end
    loss = metrics["policy_loss"] + config.value_coefficient * metrics["value_loss"]
    return loss - bonus * metrics["entropy"], metrics


@struct.dataclass
class TrainState:
    """All that a resumed run needs to go on as if uninterrupted, bit for bit."""

    params: Any  # network parameters
    average: Any  # exponential average of the parameters: the policy
    opt_state: Any  # of Adam
    key: jax.Array  # (2,) uint32, data of the PRNG key of the next update
    num_updates: jax.Array  # () int32, updates made


def begin(
    config: PPOConfig, learner: Learner, key: jax.Array, *given: Any
) -> TrainState:
    """The state before the first update, from the key of a run."""
    key_weights, key_updates = jax.random.split(key)
    params = learner.init(key_weights, *given)
    return TrainState(
        params=params,
        average=jax.tree.map(jnp.copy, params),
        opt_state=optimiser(config).init(params),
        key=jax.random.key_data(key_updates),
        num_updates=jnp.zeros((), jnp.int32),
    )


def schedule(config: PPOConfig) -> optax.Schedule:
    """Learning rate by gradient step: linear warm-up, then cosine decay."""
    steps = config.steps_per_update
    return optax.warmup_cosine_decay_schedule(
        init_value=config.learning_rate / 10,
        peak_value=config.learning_rate,
        warmup_steps=max(config.warmup_updates, 1) * steps,
        decay_steps=max(config.num_updates, config.warmup_updates + 1) * steps,
        end_value=config.final_learning_rate,
    )


def optimiser(config: PPOConfig) -> optax.GradientTransformation:
    """Adam under the schedule; ``descend`` clips the gradients."""
    return optax.adam(schedule(config), eps=1e-5)


def descend(config: PPOConfig, state: TrainState, grads: Any) -> TrainState:
    """One gradient step: clipped by the global norm, Adam, averaged weights."""
    # One factor: optax divides each gradient by the norm, which XLA does not fuse with
    # Adam's moments (that takes 7 to 14 % of an update of the paper's network).
    norm = jnp.sqrt(sum(jnp.vdot(grad, grad) for grad in jax.tree.leaves(grads)))
    factor = jnp.minimum(1.0, config.max_grad_norm / jnp.maximum(norm, 1e-30))
    grads = jax.tree.map(lambda grad: grad * factor, grads)
    changes, opt_state = optimiser(config).update(grads, state.opt_state)
    params = optax.apply_updates(state.params, changes)
    # Exponential average with bias correction: the share of the newest weights is 1 at
    # the first step, so the initial weights do not enter.
    decay, count = config.average_decay, opt_state[0].count
    share = (1.0 - decay) / (1.0 - decay**count)
    average = optax.incremental_update(params, state.average, share)
    return TrainState(params, average, opt_state, state.key, state.num_updates)


def placed(tree: Any, mesh: Mesh | None, *axes: str) -> Any:
    """The tree, leading axes of leaves sharded over the mesh ``axes``; none: copies."""
    if mesh is None:
        return tree
    sharding = NamedSharding(mesh, PartitionSpec(*axes))
    return jax.lax.with_sharding_constraint(tree, sharding)


def make_update(
    config: PPOConfig, learner: Learner, mesh: Mesh | None = None
) -> Callable[..., tuple[TrainState, Metrics]]:
    """One update: play, then epochs of minibatches; pure, not compiled.

    On a mesh every device plays some of the rows; all rows are then copied to every
    device, so that a minibatch can hold any of them, as on a single device. A device
    computes the gradient of its part of each minibatch.

    Args:
        config: the optimisation.
        learner: what is trained.
        mesh: with the one axis ``sets``; None for one device.

    Returns:
        (state, *given) -> the next state and metrics.
    """
    whole = mesh is not None or jax.default_backend() != "cpu"

    def update(state: TrainState, *given: Any) -> tuple[TrainState, Metrics]:
        key = jax.random.wrap_key_data(state.key)
        key, key_rows, key_epochs = jax.random.split(key, 3)
        keys = jax.random.split(key_rows, config.rows_per_update)
        rows, played = learner.gather(state.params, placed(keys, mesh, "sets"), *given)
        rows = placed(rows, mesh)

        def step(state: TrainState, index: jax.Array) -> tuple[TrainState, Metrics]:
            def gradient(part: jax.Array) -> tuple[Any, Metrics]:
                cut = placed(jax.tree.map(lambda leaf: leaf[part], rows), mesh, "sets")
                of_loss = jax.grad(learner.loss, has_aux=True)
                return of_loss(state.params, cut, state.num_updates)

            # A slice's arrays stay in a core's cache: faster than all rows at once.
            size = len(index) if whole else math.gcd(len(index), config.slice_rows)
            found = jax.lax.map(gradient, index.reshape(-1, size))
            grads, metrics = jax.tree.map(lambda leaf: leaf.mean(0), found)
            return descend(config, state, grads), metrics

        def epoch(state: TrainState, key: jax.Array) -> tuple[TrainState, Metrics]:
            order = jax.random.permutation(key, len(jax.tree.leaves(rows)[0]))
            return jax.lax.scan(step, state, order.reshape(config.num_minibatches, -1))

        keys = jax.random.split(key_epochs, config.num_epochs)
        state, losses = jax.lax.scan(epoch, state, keys)
        later = {"key": jax.random.key_data(key), "num_updates": state.num_updates + 1}
        state = dataclasses.replace(state, **later)
        return placed((state, played | jax.tree.map(jnp.mean, losses)), mesh)

    return update


def make_train(config: Any) -> Callable[..., tuple[Any, Metrics]]:
    """A whole training as one pure function, to be jitted, scanned or vmapped.

    Args:
        config: a ``TrainConfig`` of postures or a ``PolicyConfig`` of tasks, of which
            it reads ``ppo`` and ``learners``: update u trains number u modulo theirs.

    Returns:
        ``train(key, *given)`` -> the averaged weights, and metrics with a leading axis
        of ``config.ppo.num_updates``. ``given``: none for postures, the arrays of a
        task for streams.
    """
    learners = config.learners
    each = [make_update(config.ppo, learner) for learner in learners]

    def train(key: jax.Array, *given: Any) -> tuple[Any, Metrics]:
        def update(state: TrainState, number: jax.Array) -> tuple[TrainState, Metrics]:
            return jax.lax.switch(number % len(each), each, state, *given)

        state = begin(config.ppo, learners[0], key, *given)
        numbers = jnp.arange(config.ppo.num_updates)
        state, metrics = jax.lax.scan(update, state, numbers)
        return state.average, metrics

    return train
