"""Proximal policy optimisation: loss, advantages, optimiser, update, training.

A ``Learner`` plays and scores: ``postures`` has that of episodes of a fixed number of
choices, ``streams`` that of sessions of any length. ``training.run`` adds files.
Sources: Schulman et al. 2017 (clipped surrogate), 2016 (advantages).
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxcal.learning.config import TRACED, PPOConfig
from jaxcal.learning.core.network import log_softmax

Metrics = dict[str, jax.Array]


class Learner(Protocol):
    """What is trained: it plays and it scores; a dataclass with a field ``config``, of
    which ``TRACED`` may be arrays. ``given`` are arrays that go through ``train`` or an
    update, such as a task's tables: other values compile nothing."""

    def __hash__(self) -> int:
        """Hashable: a static argument of ``jit``."""

    def init(self, key: jax.Array, *given: Any) -> Any:
        """Parameters before training."""

    def begin(self, keys: jax.Array, *given: Any) -> Any:
        """What goes on from update to update, of rows that begin with keys (B,)."""

    def rollout(
        self, params: Any, rollout_state: Any, *given: Any
    ) -> tuple[Any, Any, Metrics]:
        """Play a row for each of ``rollout_state``, leaves (B, ...): rows, leaves (B,
        ...); what goes on from there; metrics."""

    def loss(
        self, params: Any, experience: Any, update_index: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """Mean loss and metrics of rows of experience, after so many updates."""


@struct.dataclass
class Batch:
    """Experience that PPO learns from: B rows of T decisions (of several episodes)."""

    observations: Any  # leaves (B, ...): what the learner scores
    action: jax.Array  # (B, T, ...) int32
    log_prob: jax.Array  # (B, T, ...) of the action when it was taken
    advantage: jax.Array  # (B, T, ...)
    target: jax.Array  # (B, T, ...) of the value, reward units


def advantages(
    config: PPOConfig,
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    continues: jax.Array,
) -> jax.Array:
    """(T, ...) generalised advantage estimates of arrays (T, ...).

    ``A_t = d_t + discount lambda continues_t A_(t+1)``, where ``d_t = reward_t +
    discount next_value_t - value_t``; ``continues`` is 0 where an episode ends, else 1.
    """
    deltas = reward + config.discount * next_value - value

    def back(later: jax.Array, now: Any) -> tuple[jax.Array, jax.Array]:
        delta, continues = now
        advantage = delta + config.discount * config.gae_lambda * continues * later
        return advantage, advantage

    start = jnp.zeros_like(deltas[0])
    return jax.lax.scan(back, start, (deltas, continues), reverse=True)[1]


def normalised(config: PPOConfig, batch: Batch) -> Batch:
    """Advantages with mean 0 and scale 1, over the batch or for each of the T decisions
    (``normalise_per_decision``), then clipped."""
    axes = 0, *range(2, batch.advantage.ndim)
    over = axes if config.normalise_per_decision else None
    centred = batch.advantage - batch.advantage.mean(over, keepdims=True)
    scaled = centred / (jnp.sqrt((centred**2).mean(over, keepdims=True)) + 1e-6)
    limit = config.advantage_limit
    return dataclasses.replace(batch, advantage=jnp.clip(scaled, -limit, limit))


def explained_variance(target: jax.Array, value: jax.Array) -> jax.Array:
    """() share of the targets' variance that the values explain."""
    return 1.0 - (target - value).var() / jnp.maximum(target.var(), 1e-12)


def surrogate(
    config: PPOConfig,
    logits: jax.Array,
    value: jax.Array,
    batch: Batch,
    update_index: jax.Array,
) -> tuple[jax.Array, Metrics]:
    """Clipped surrogate, the value's error and an entropy bonus, which follows the
    updates made: ``logits`` (B, T, ..., A), masked by a large finite minimum or -inf,
    ``value`` (B, T, ...) in reward units."""
    log_probs = log_softmax(logits)
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
        "clip_fraction": (jnp.abs(ratio - 1.0) > config.clip_range).mean(),
    }
    share = jnp.minimum(update_index / config.num_updates, 1.0)
    bonus = (1.0 - share) * config.entropy_start + share * config.entropy_end
    loss = metrics["policy_loss"] + config.value_coefficient * metrics["value_loss"]
    return loss - bonus * metrics["entropy"], metrics


@struct.dataclass
class TrainState:
    """All that a resumed run needs to go on as if uninterrupted, bit for bit."""

    params: Any  # network parameters
    average: Any  # exponential average of the parameters: the policy
    opt_state: Any  # of Adam, whose moments (P,) are of all parameters
    key: jax.Array  # (2,) uint32, data of the PRNG key of the next update
    num_updates: jax.Array  # () int32, updates made
    rollout_state: Any = ()  # leaves (B, ...): what the learner goes on from
    values: Metrics = struct.field(default_factory=dict)  # () of names in ``TRACED``


def begin(
    config: PPOConfig, learner: Learner, key: jax.Array, *given: Any, **values: Any
) -> TrainState:
    """The state before the first update, from the () key of a run; ``values`` are ()
    arrays by names in ``TRACED``, in place of the configuration's."""
    if unknown := sorted(set(values) - set(TRACED)):
        raise ValueError(f"values must be of {', '.join(TRACED)}, got {unknown[0]}")
    key_weights, key_updates = jax.random.split(key)
    key_updates, key_rows = jax.random.split(key_updates)
    params = learner.init(key_weights, *given)
    return TrainState(
        params=params,
        average=jax.tree.map(jnp.copy, params),
        opt_state=optimiser(config).init(ravel_pytree(params)[0]),
        key=jax.random.key_data(key_updates),
        num_updates=jnp.zeros((), jnp.int32),
        rollout_state=learner.begin(
            jax.random.split(key_rows, config.rows_per_update), *given
        ),
        values={name: jnp.asarray(value, float) for name, value in values.items()},
    )


def _with_values(config: PPOConfig, values: Metrics) -> PPOConfig:
    changed = copy.copy(config)
    for name, value in values.items():
        object.__setattr__(changed, name, value)
    return changed


def schedule(config: PPOConfig) -> optax.Schedule:
    """Learning rate by gradient step: linear warm-up, then cosine decay."""
    per_update = config.steps_per_update
    warm = max(config.warmup_updates, 1) * per_update
    steps = max(config.num_updates, config.warmup_updates + 1) * per_update - warm
    peak, last = config.learning_rate, config.final_learning_rate

    def rate(step: jax.typing.ArrayLike) -> jax.Array:
        rise = 0.1 + 0.9 * jnp.asarray(step) / warm
        turn = jnp.pi * jnp.clip((jnp.asarray(step) - warm) / steps, 0.0, 1.0)
        fall = last + (peak - last) * 0.5 * (1.0 + jnp.cos(turn))
        return jnp.where(jnp.asarray(step) < warm, peak * rise, fall)

    return rate


def optimiser(config: PPOConfig) -> optax.GradientTransformation:
    """Adam under the schedule, of all parameters as one vector; ``descend`` clips."""
    return optax.adam(schedule(config), eps=1e-5)


def descend(
    config: PPOConfig, state: TrainState, grads: Any
) -> tuple[TrainState, jax.Array]:
    """One gradient step on ``grads``, a tree as ``state.params`` or one vector of all
    its leaves: the next state, and the () norm before clipping."""
    grads = ravel_pytree(grads)[0]
    norm = jnp.linalg.norm(grads)
    # One factor: optax divides each gradient by the norm, which XLA does not fuse with
    # Adam's moments (that takes 7 to 14 % of an update of the paper's network).
    factor = jnp.minimum(1.0, config.max_grad_norm / jnp.maximum(norm, 1e-30))
    changes, opt_state = optimiser(config).update(factor * grads, state.opt_state)
    as_params = ravel_pytree(state.params)[1]
    params = optax.apply_updates(state.params, as_params(changes))
    # Exponential average with bias correction: the share of the newest weights is 1 at
    # the first step, so the initial weights do not enter.
    decay, count = config.average_decay, opt_state[0].count
    share = jnp.asarray((1.0 - decay) / (1.0 - decay**count), jnp.float32)
    average = optax.incremental_update(params, state.average, share)
    changed = {"params": params, "average": average, "opt_state": opt_state}
    return dataclasses.replace(state, **changed), norm


def placed(tree: Any, mesh: Mesh | None, *axes: str) -> Any:
    """The tree, leading axes of leaves sharded over the mesh ``axes``; none: copies."""
    if mesh is None:
        return tree
    sharding = NamedSharding(mesh, PartitionSpec(*axes))
    return jax.lax.with_sharding_constraint(tree, sharding)


def minibatches(config: PPOConfig, key: jax.Array, blocks: int, rows: int) -> jax.Array:
    """(steps, blocks, n) indices of rows in each of the blocks, by gradient step; every
    epoch has an order of its own."""
    order = jnp.argsort(jax.random.bits(key, (config.num_epochs, blocks, rows)))
    order = order.reshape(config.num_epochs, blocks, config.num_minibatches, -1)
    return order.swapaxes(1, 2).reshape(config.steps_per_update, blocks, -1)


def mean_over(
    function: Callable[[Any], Any],
    rows: Any,
    index: jax.Array,
    size: int,
    mesh: Mesh | None,
) -> Any:
    """Mean of a function of rows, leaves (blocks, ...), computed for ``size`` of each
    block at a time; ``index`` (blocks, n) says which, n a multiple of ``size``."""

    def of_part(part: jax.Array) -> Any:
        pick = jax.vmap(lambda leaf, number: leaf[number])
        some = placed(jax.tree.map(lambda leaf: pick(leaf, part), rows), mesh, "sets")
        return function(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), some))

    parts = index.reshape(len(index), -1, size).swapaxes(0, 1)
    return jax.tree.map(lambda x: x.mean(0), jax.lax.map(of_part, parts))


@struct.dataclass
class _Measured:
    """Numbers as one array: many small kernels take XLA long to compile."""

    vector: jax.Array  # (..., N), of which the last have names
    names: tuple[str, ...] = struct.field(pytree_node=False)


def make_update(
    config: PPOConfig, learner: Learner, mesh: Mesh | None = None
) -> Callable[..., tuple[TrainState, Metrics]]:
    """One update, (state, *given) -> the next state and metrics: play, then epochs of
    minibatches; pure, not compiled.

    On a mesh with the one axis ``sets`` every device plays some of the rows and keeps
    them: of each minibatch it draws an equal part from its own, and gradients alone are
    summed over the devices. Where a loss or a gradient is not finite, weights and
    optimiser stay as they were and the metric ``skipped`` is 1; what is played goes on.
    """
    whole = mesh is not None or jax.default_backend() != "cpu"
    blocks = 1 if mesh is None else mesh.size

    def update(before: TrainState, *given: Any) -> tuple[TrainState, Metrics]:
        ppo = _with_values(config, before.values)
        trained: Learner = dataclasses.replace(learner, config=ppo)  # type: ignore[type-var]  # a dataclass
        key = jax.random.wrap_key_data(before.key)
        key, key_epochs = jax.random.split(key)
        rollout_state = placed(before.rollout_state, mesh, "sets")
        rows, rollout_state, played = trained.rollout(
            before.params, rollout_state, *given
        )
        per_block = len(jax.tree.leaves(rows)[0]) // blocks

        def cut(leaf: jax.Array) -> jax.Array:  # (blocks, per_block, ...)
            return leaf.reshape(blocks, per_block, *leaf.shape[1:])

        rows = placed(jax.tree.map(cut, rows), mesh, "sets")

        # A slice's arrays stay in a core's cache: faster than all rows at once.
        number = per_block // ppo.num_minibatches
        size = number if whole else math.gcd(number, ppo.slice_rows)

        def step(state: TrainState, index: jax.Array) -> tuple[TrainState, _Measured]:
            def gradient(some: Any) -> _Measured:
                of_loss = jax.grad(trained.loss, has_aux=True)
                grads, metrics = of_loss(state.params, some, state.num_updates)
                vector = ravel_pytree((grads, metrics))[0]
                return _Measured(vector, tuple(sorted(metrics)))

            total = mean_over(gradient, rows, index, size, mesh)
            named = total.vector.size - len(total.names)
            grads, metrics = total.vector[:named], total.vector[named:]
            state, norm = descend(ppo, state, grads)
            names = *total.names, "grad_norm"
            return state, _Measured(jnp.append(metrics, norm), names)

        order = minibatches(ppo, key_epochs, blocks, per_block)
        state, steps = jax.lax.scan(step, before, order)
        losses = dict(zip(steps.names, steps.vector.mean(0), strict=True))
        if "kl" in losses:  # of a minibatch, by the weights that the update ends with

            def measure(some: Any) -> jax.Array:
                return trained.loss(state.params, some, state.num_updates)[1]["kl"]

            index = jnp.broadcast_to(jnp.arange(number), (blocks, number))
            losses["kl_after"] = mean_over(measure, rows, index, size, mesh)
        rate = schedule(ppo)((before.num_updates + 1) * ppo.steps_per_update)
        fine = jnp.isfinite(jnp.stack(jax.tree.leaves(losses))).all()
        after = dataclasses.replace(
            jax.lax.cond(fine, lambda: state, lambda: before),
            key=jax.random.key_data(key),
            num_updates=before.num_updates + 1,
            rollout_state=(),
        )
        skipped = jnp.where(fine, 0.0, 1.0)
        metrics = played | losses | {"learning_rate": rate, "skipped": skipped}
        after, metrics = placed((after, metrics), mesh)
        rollout_state = placed(rollout_state, mesh, "sets")
        return dataclasses.replace(after, rollout_state=rollout_state), metrics

    return update


def make_train(config: Any) -> Callable[..., tuple[Any, Metrics]]:
    """``learning.make_train`` of anything but a preset's name."""
    if imitated := getattr(config, "num_imitated", 0):
        raise ValueError(
            f"imitation must be 0, got {imitated} imitated updates: the teacher runs "
            "on the host. Use training.postures.train, or imitation=0"
        )
    if all(hasattr(config, name) for name in ("config", "rollout", "loss")):
        learners, ppo = (config,), config.config
    elif all(hasattr(config, name) for name in ("ppo", "learners")):
        learners, ppo = config.learners, config.ppo
    else:
        raise ValueError(
            "config must be a preset's name, a TrainConfig or a learner, got "
            f"{type(config).__name__}"
        )
    updates = [make_update(ppo, learner) for learner in learners]

    def train(key: jax.Array, *given: Any, **values: Any) -> tuple[TrainState, Metrics]:
        def update(state: TrainState, number: jax.Array) -> tuple[TrainState, Metrics]:
            return jax.lax.switch(number % len(updates), updates, state, *given)

        state = begin(ppo, learners[0], key, *given, **values)
        return jax.lax.scan(update, state, jnp.arange(ppo.num_updates))

    return train
