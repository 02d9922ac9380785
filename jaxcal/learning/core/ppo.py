"""Proximal policy optimisation: loss, advantages, optimiser, update, training.

    train = make_train(config)
    weights, metrics = jax.jit(train)(jax.random.key(0))
    jax.vmap(train)(jax.random.split(jax.random.key(0), 8))  # eight runs, one program

A ``Learner`` plays and scores: ``postures`` does it for episodes of a fixed number of
choices, ``streams`` for sessions that end when they end. Everything here is pure;
``training.run`` adds files, progress and a host.

Sources: Schulman et al. 2017 (clipped surrogate), 2016 (advantages).
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxcal.learning.settings import require, setting

__all__ = [
    "Batch",
    "Config",
    "Learner",
    "Metrics",
    "PPOConfig",
    "TrainState",
    "Update",
    "advantages",
    "begin",
    "epochs",
    "keys_of",
    "make_train",
    "make_update",
    "normalised",
    "optimiser",
    "placed",
    "schedule",
    "sliced",
    "squared_error",
    "surrogate",
]

Metrics = dict[str, jax.Array]


@dataclasses.dataclass(frozen=True)
class PPOConfig(abc.ABC):
    """Every number of the optimisation; what is played adds its sizes."""

    num_epochs: int = setting(2, "passes over what an update has played")
    num_minibatches: int = setting(4, "gradient steps per pass")
    learning_rate: float = setting(2e-3, "of Adam, after the warm-up")
    final_learning_rate: float = setting(3e-5, "at the end; a cosine leads there")
    warmup_updates: int = setting(5, "updates in which the learning rate rises")
    clip_range: float = setting(0.2, "most that a probability ratio counts beyond 1")
    value_coefficient: float = setting(0.5, "weight of the value's error")
    value_error_limit: float = setting(
        3.0, "reward units; beyond, the value's error counts linearly (Huber)"
    )
    entropy_start: float = setting(0.02, "entropy bonus at the beginning")
    entropy_end: float = setting(0.0, "entropy bonus at the end; linear between")
    discount: float = setting(1.0, "of a reward one decision later")
    gae_lambda: float = setting(1.0, "of the advantages; 1 is return less value")
    normalise_per_decision: bool = False
    advantage_limit: float = setting(
        6.0, "standard deviations; a larger advantage (a singular pick) is clipped"
    )
    max_grad_norm: float = setting(0.5, "global norm at which gradients are clipped")
    average_decay: float = setting(
        0.99, "for each gradient step, of the averaged weights, which are what is kept"
    )
    slice_rows: int = setting(
        8, "rows of a minibatch whose gradient is computed at once on a CPU: its cache"
    )

    def __post_init__(self) -> None:
        counts = ("num_epochs", "num_minibatches", "slice_rows")
        require(self, "at least 1", lambda v: v >= 1, *counts)
        positive = ("learning_rate", "clip_range", "max_grad_norm", "value_error_limit")
        require(self, "positive", lambda v: v > 0, *positive)
        require(self, "in [0, 1]", lambda v: 0.0 <= v <= 1.0, "discount", "gae_lambda")
        require(self, "in [0, 1)", lambda v: 0.0 <= v < 1.0, "average_decay")

    @property
    @abc.abstractmethod
    def num_updates(self) -> int:
        """Updates that a run makes."""

    @property
    @abc.abstractmethod
    def rows_per_update(self) -> int:
        """Rows of experience that an update plays and cuts into minibatches."""

    @property
    def steps_per_update(self) -> int:
        """Gradient steps in an update."""
        return self.num_epochs * self.num_minibatches

    @property
    def rows_per_minibatch(self) -> int:
        """What devices share among them."""
        return self.rows_per_update // self.num_minibatches


class Learner(Protocol):
    """What is trained: it plays and it scores. Hashable, since it is static to ``jit``.

    ``given`` are arrays that the caller passes through ``train`` or an update, such as
    a task's tables: arguments, so that other values compile nothing.
    """

    def __hash__(self) -> int:
        """Of its configuration."""

    def init(self, key: jax.Array, *given: Any) -> Any:
        """Parameters before training."""

    def gather(self, params: Any, keys: jax.Array, *given: Any) -> tuple[Any, Metrics]:
        """Play a row of experience with each of the keys (B,).

        Returns:
            Experience with B leading rows, and metrics. Its ``counted`` (B, ...) is 1
            where ``loss`` counts, which is a mean over that.
        """

    def loss(
        self, params: Any, experience: Any, done: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """Loss and metrics of some rows of experience, after ``done`` updates."""


@struct.dataclass
class Batch:
    """Experience that PPO learns from: B rows of T decisions (of several episodes)."""

    seen: Any  # leaves (B, ...): what the learner scores
    action: jax.Array  # (B, T, ...) int32
    log_prob: jax.Array  # (B, T, ...) of the action when it was taken
    advantage: jax.Array  # (B, T, ...)
    target: jax.Array  # (B, T, ...) of the value, reward units
    counted: jax.Array  # (B, T, ...) 1 where the policy chose, 0 where it was given


# -- advantages and the loss -----------------------------------------------------------


def advantages(
    config: PPOConfig,
    reward: jax.Array,
    value: jax.Array,
    following: jax.Array,
    goes_on: jax.Array,
) -> jax.Array:
    """(T, ...) generalised advantage estimates.

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
    """Advantages with mean 0 and scale 1 over what counts, then clipped."""
    axes = [a for a in range(batch.counted.ndim) if a != 1]
    over = tuple(axes) if config.normalise_per_decision else None
    number = jnp.maximum(batch.counted.sum(over, keepdims=True), 1.0)

    def mean(array: jax.Array) -> jax.Array:
        return (array * batch.counted).sum(over, keepdims=True) / number

    centred = batch.advantage - mean(batch.advantage)
    scaled = centred / (jnp.sqrt(mean(centred**2)) + 1e-6)
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
    number = jnp.maximum(batch.counted.sum(), 1.0)

    def mean(array: jax.Array) -> jax.Array:
        return (array * batch.counted).sum() / number

    policy_loss = -mean(jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))
    value_loss = mean(squared_error(value - batch.target, config.value_error_limit))
    entropy = mean(-(jnp.exp(log_probs) * log_probs).sum(-1))
    share = jnp.minimum(done / config.num_updates, 1.0)
    bonus = (1.0 - share) * config.entropy_start + share * config.entropy_end
    loss = policy_loss + config.value_coefficient * value_loss - bonus * entropy
    return loss, {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": entropy,
        "kl": mean(ratio - 1.0 - log_ratio),
    }


def squared_error(error: jax.Array, limit: float) -> jax.Array:
    """The square of an error, beyond ``limit`` going on as a line: twice Huber's loss.

    Unlike the square of a clipped error it has a gradient however wrong a value is.
    (``optax.losses.huber_loss`` cancels large numbers in its gradient.)
    """
    size = jnp.abs(error)
    near = jnp.minimum(size, limit)
    return near * (2.0 * size - near)


# -- the optimiser ---------------------------------------------------------------------


@struct.dataclass
class TrainState:
    """All that an uninterrupted run would need to go on, bit for bit."""

    params: Any  # network parameters
    average: Any  # exponential average of the parameters, what a checkpoint offers
    opt_state: Any  # optax state
    key: jax.Array  # (2,) uint32, data of the PRNG key of the next update
    num_updates: jax.Array  # () int32, updates made


def keys_of(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Keys of the weights, the updates and what is imitated, from that of a run.

    They are split apart first, since ``fold_in(key, i)`` would be ``split(key)[i]``.
    """
    weights, updates, imitated = jax.random.split(key, 3)
    return weights, updates, imitated


def begin(
    config: PPOConfig, learner: Learner, key: jax.Array, *given: Any
) -> TrainState:
    """The state before the first update, from the key of a run."""
    key_weights, key_updates, _ = keys_of(key)
    params = learner.init(key_weights, *given)
    return TrainState(
        params=params,
        average=jax.tree.map(jnp.copy, params),
        opt_state=optimiser(config).init(params),
        key=jax.random.key_data(key_updates),
        num_updates=jnp.zeros((), jnp.int32),
    )


def schedule(config: PPOConfig) -> optax.Schedule:
    """The learning rate after so many gradient steps: a rise, then a cosine."""
    steps = config.steps_per_update
    return optax.warmup_cosine_decay_schedule(
        init_value=config.learning_rate / 10,
        peak_value=config.learning_rate,
        warmup_steps=max(config.warmup_updates, 1) * steps,
        decay_steps=max(config.num_updates, config.warmup_updates + 1) * steps,
        end_value=config.final_learning_rate,
    )


def optimiser(config: PPOConfig) -> optax.GradientTransformation:
    """Adam under the schedule; ``epochs`` clips the gradients."""
    return optax.adam(schedule(config), eps=1e-5)


def epochs(
    config: PPOConfig,
    state: TrainState,
    num_rows: int,
    gradient: Callable[[Any, jax.Array], tuple[Any, Metrics]],
    key: jax.Array,
) -> tuple[TrainState, Metrics]:
    """Epochs of minibatches over what an update has gathered.

    Args:
        config: how to optimise.
        state: before the update.
        num_rows: gathered.
        gradient: of parameters and the (S,) indices of a minibatch's rows.
        key: orders the minibatches.

    Returns:
        The state after the update, its key as it was; the mean of each metric.
    """
    optimise = optimiser(config)

    def step(carry: Any, index: jax.Array) -> tuple[Any, Metrics]:
        params, average, opt_state, count = carry
        grads, metrics = gradient(params, index)
        # By one factor: optax divides every gradient by the norm, which XLA fuses into
        # neither of Adam's moments (7 to 14 % of an update of the paper's network).
        norm = jnp.sqrt(sum(jnp.vdot(grad, grad) for grad in jax.tree.leaves(grads)))
        factor = jnp.minimum(1.0, config.max_grad_norm / jnp.maximum(norm, 1e-30))
        grads = jax.tree.map(lambda grad: grad * factor, grads)
        changes, opt_state = optimise.update(grads, opt_state, params)
        params = optax.apply_updates(params, changes)
        # The share of the newest weights in a mean whose weights decay and add up to
        # one: 1 at the first step, so that nothing of the initial weights stays.
        decay = config.average_decay
        share = (1.0 - decay) / (1.0 - decay ** (count + 1))
        average = optax.incremental_update(params, average, share)
        return (params, average, opt_state, count + 1), metrics

    def epoch(carry: Any, key: jax.Array) -> tuple[Any, Metrics]:
        order = jax.random.permutation(key, num_rows)
        return jax.lax.scan(step, carry, order.reshape(config.num_minibatches, -1))

    count = state.num_updates * config.steps_per_update
    carry = (state.params, state.average, state.opt_state, count)
    keys = jax.random.split(key, config.num_epochs)
    (params, average, opt_state, _), metrics = jax.lax.scan(epoch, carry, keys)
    after = TrainState(params, average, opt_state, state.key, state.num_updates + 1)
    return after, {name: value.mean() for name, value in metrics.items()}


def sliced(
    gradient: Callable[[Any, Any], tuple[Any, Metrics]],
    params: Any,
    rows_of: Callable[[jax.Array], Any],
    index: jax.Array,
    size: int,
) -> tuple[Any, Metrics]:
    """The gradient of a minibatch's mean loss, and its metrics, slice by slice.

    A slice's arrays stay in a core's cache, which is faster than all rows at once.

    Args:
        gradient: of parameters and rows, of their mean loss over ``rows.counted``.
        params: parameters.
        rows_of: indices -> rows.
        index: (S,) of the minibatch.
        size: rows of a slice, at most; a divisor of S is taken.
    """
    size = max(part for part in range(1, size + 1) if len(index) % part == 0)

    def add(total: Any, part: jax.Array) -> tuple[Any, Any]:
        rows = rows_of(part)
        number = rows.counted.sum()
        grads, metrics = gradient(params, rows)
        total = jax.tree.map(lambda t, g: t + number * g, total, grads)
        return total, (number, metrics)

    zero = jax.tree.map(jnp.zeros_like, params)
    total, (number, metrics) = jax.lax.scan(add, zero, index.reshape(-1, size))
    share = 1.0 / jnp.maximum(number.sum(), 1.0)
    mean = {name: share * (number @ value) for name, value in metrics.items()}
    return jax.tree.map(lambda t: share * t, total), mean


# -- an update, and training -----------------------------------------------------------

Update = Callable[..., tuple[TrainState, Metrics]]
"""(state, *given) -> the next state and metrics."""


def placed(tree: Any, mesh: Mesh | None, *axes: str) -> Any:
    """The same values, each leaf's leading axes spread over those of the mesh."""
    if mesh is None:
        return tree
    sharding = NamedSharding(mesh, PartitionSpec(*axes))
    return jax.lax.with_sharding_constraint(tree, sharding)


def make_update(
    config: PPOConfig, learner: Learner, mesh: Mesh | None = None
) -> Update:
    """One update: play, then learn from it; pure, not compiled.

    On a mesh the rows are spread over its devices while they are played, what was
    played is then whole on every device, and each minibatch is spread again: it is any
    of the rows, as on a single device, and is cut without further communication.

    Args:
        config: the optimisation.
        learner: what is trained.
        mesh: with the one axis ``sets``; None for one device, which places nothing.
    """
    whole = mesh is not None or jax.default_backend() != "cpu"

    def update(state: TrainState, *given: Any) -> tuple[TrainState, Metrics]:
        key = jax.random.wrap_key_data(state.key)
        key, key_rows, key_epochs = jax.random.split(key, 3)
        keys = jax.random.split(key_rows, config.rows_per_update)
        rows, metrics = learner.gather(state.params, placed(keys, mesh, "sets"), *given)
        rows = placed(rows, mesh)

        def loss(params: Any, rows: Any) -> tuple[jax.Array, Metrics]:
            return learner.loss(params, rows, state.num_updates)

        def rows_of(index: jax.Array) -> Any:
            return placed(jax.tree.map(lambda leaf: leaf[index], rows), mesh, "sets")

        def gradient(params: Any, index: jax.Array) -> tuple[Any, Metrics]:
            size = len(index) if whole else min(config.slice_rows, len(index))
            one = jax.grad(loss, has_aux=True)
            return sliced(one, params, rows_of, index, size)

        after, losses = epochs(config, state, len(rows.counted), gradient, key_epochs)
        after = dataclasses.replace(after, key=jax.random.key_data(key))
        return placed((after, metrics | losses), mesh)

    return update


class Config(Protocol):
    """What ``make_train`` needs of a configuration."""

    @property
    def ppo(self) -> PPOConfig:
        """The optimisation."""

    @property
    def learners(self) -> tuple[Learner, ...]:
        """What update u trains on: number u modulo their number."""


def make_train(config: Config) -> Callable[..., tuple[Any, Metrics]]:
    """A whole training as one pure function, to be jitted, scanned or vmapped.

    Args:
        config: a ``TrainConfig`` of postures, or a ``PolicyConfig`` of tasks.

    Returns:
        (key; *given, what the learners are given: nothing for postures, the arrays of a
        task for streams) -> the averaged weights, and metrics with a leading axis of
        ``config.ppo.num_updates``.
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
