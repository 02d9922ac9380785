"""Proximal policy optimisation, whole: loss, advantages, optimiser, update, training.

    train = make_train(config)
    weights, metrics = jax.jit(train)(jax.random.key(0))
    jax.vmap(train)(jax.random.split(jax.random.key(0), 8))  # eight runs, one program

What is played and how it is scored is a ``Learner``'s: ``postures`` plays episodes of a
fixed number of choices, ``streams`` plays sessions that end when they end. Everything
else is here, once for both. Nothing touches a file or the host; ``training.run`` calls
it and does.

Sources: Schulman et al. 2017 (clipped surrogate), 2016 (advantages).
"""

from __future__ import annotations

import dataclasses
import functools
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
    "advantages",
    "begin",
    "epochs",
    "learning_rate",
    "make_train",
    "make_update",
    "normalised",
    "optimiser",
    "sliced",
    "spread",
    "squared_error",
    "surrogate",
    "updates",
]

Metrics = dict[str, jax.Array]


@dataclasses.dataclass(frozen=True)
class PPOConfig:
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
    def num_updates(self) -> int:
        """Updates that a run makes."""
        raise NotImplementedError

    @property
    def rows_per_update(self) -> int:
        """Rows of experience that an update plays and cuts into minibatches."""
        raise NotImplementedError

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

    def draw(self, key: jax.Array, *given: Any) -> Any:
        """What an update plays on: ``rows_per_update`` leading rows."""

    def gather(
        self, params: Any, rows: Any, key: jax.Array, *given: Any
    ) -> tuple[Any, Metrics]:
        """Play on each row: experience with as many leading rows, and metrics.

        Experience has ``counted`` (rows, ...), of which ``loss`` is a mean.
        """

    def loss(
        self, params: Any, experience: Any, done: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """Loss and metrics of some rows of experience, after ``done`` updates."""


@struct.dataclass
class Batch:
    """Experience that PPO learns from: B rows of some decisions each."""

    seen: Any  # leaves (B, ...): what the learner scores
    action: jax.Array  # (B, ...) int32
    log_prob: jax.Array  # (B, ...) of the action when it was taken
    advantage: jax.Array  # (B, ...)
    target: jax.Array  # (B, ...) of the value, reward units
    counted: jax.Array  # (B, ...) 1 where the policy chose, 0 where a choice was given


# -- the loss --------------------------------------------------------------------------


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
        logits: (B, ..., A) of the decisions in ``batch``, masked by a finite minimum.
        value: (B, ...) reward units.
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
    progress = jnp.minimum(done / config.num_updates, 1.0)
    bonus = config.entropy_start + progress * (
        config.entropy_end - config.entropy_start
    )
    loss = policy_loss + config.value_coefficient * value_loss - bonus * entropy
    metrics = {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "kl": mean(ratio - 1.0 - log_ratio),
    }
    return loss, metrics


def squared_error(error: jax.Array, limit: float) -> jax.Array:
    """The square of an error, beyond ``limit`` going on as a line: twice Huber's loss.

    Unlike the square of a clipped error it has a gradient however wrong a value is.
    (``optax.losses.huber_loss`` cancels large numbers in its gradient.)
    """
    size = jnp.abs(error)
    near = jnp.minimum(size, limit)
    return near * (2.0 * size - near)


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

    def back(carry: jax.Array, now: Any) -> tuple[jax.Array, jax.Array]:
        delta, goes_on = now
        carry = delta + config.discount * config.gae_lambda * goes_on * carry
        return carry, carry

    start = jnp.zeros_like(deltas[0])
    return jax.lax.scan(back, start, (deltas, goes_on), reverse=True)[1]


def normalised(
    config: PPOConfig, advantage: jax.Array, counted: jax.Array, axes: tuple[int, ...]
) -> jax.Array:
    """Advantages with mean 0 and scale 1 over ``axes`` of what counts, then clipped."""
    number = jnp.maximum(counted.sum(axes, keepdims=True), 1.0)
    mean = (advantage * counted).sum(axes, keepdims=True) / number
    centred = advantage - mean
    scale = jnp.sqrt((centred**2 * counted).sum(axes, keepdims=True) / number)
    limit = config.advantage_limit
    return jnp.clip(centred / (scale + 1e-6), -limit, limit)


# -- the optimiser ---------------------------------------------------------------------


@struct.dataclass
class TrainState:
    """All that an uninterrupted run would need to go on, bit for bit."""

    params: Any  # network parameters
    average: Any  # exponential average of the parameters, what a checkpoint offers
    opt_state: Any  # optax state
    key: jax.Array  # (2,) uint32, data of the PRNG key of the next update
    num_updates: jax.Array  # () int32, updates made


def streams_of(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Keys of the weights, the updates and what is imitated, from that of a run.

    They are split apart first, since ``fold_in(key, i)`` would be ``split(key)[i]``.
    """
    weights, played, imitated = jax.random.split(key, 3)
    return weights, played, imitated


def begin(
    config: PPOConfig, learner: Learner, key: jax.Array, *given: Any
) -> TrainState:
    """The state before the first update, from the key of a run."""
    weights, played, _ = streams_of(key)
    params = learner.init(weights, *given)
    return TrainState(
        params=params,
        average=jax.tree.map(jnp.copy, params),
        opt_state=optimiser(config).init(params),
        key=jax.random.key_data(played),
        num_updates=jnp.zeros((), jnp.int32),
    )


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


def epochs(
    state: TrainState,
    config: PPOConfig,
    num_rows: int,
    gradient: Callable[[Any, jax.Array], tuple[Any, Metrics]],
    key: jax.Array,
) -> tuple[TrainState, Metrics]:
    """Epochs of minibatches over what an update has gathered.

    Args:
        state: before the update.
        config: how to optimise.
        num_rows: gathered.
        gradient: of parameters and the (S,) indices of a minibatch's rows.
        key: orders the minibatches.

    Returns:
        The state after the update, its key as it was; the mean of each metric.
    """
    optimise = optimiser(config)
    size = num_rows // config.num_minibatches

    def step(carry: Any, index: jax.Array) -> tuple[Any, Metrics]:
        params, average, opt_state, count = carry
        grads, metrics = gradient(params, index)
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
        size: rows of a slice, at most.
    """
    size = max(part for part in range(1, size + 1) if len(index) % part == 0)
    if size == len(index):
        return gradient(params, rows_of(index))

    def add(total: Any, index: jax.Array) -> tuple[Any, None]:
        rows = rows_of(index)
        number = rows.counted.sum()
        found = gradient(params, rows), jnp.ones(())
        return jax.tree.map(lambda t, f: t + number * f, total, found), None

    parts = index.reshape(-1, size)
    shapes = jax.eval_shape(lambda: gradient(params, rows_of(parts[0])))
    zero = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes), jnp.zeros(())
    (total, number), _ = jax.lax.scan(add, zero, parts)
    mean: tuple[Any, Metrics] = jax.tree.map(
        lambda t: t / jnp.maximum(number, 1.0), total
    )
    return mean


# -- an update, and training -----------------------------------------------------------

Update = Callable[..., tuple[TrainState, Metrics]]
"""(state, *given) -> the next state and metrics."""


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

    def update(state: TrainState, *given: Any) -> tuple[TrainState, Metrics]:
        key, key_gather, key_epochs = jax.random.split(
            jax.random.wrap_key_data(state.key), 3
        )
        rows = spread(learner.draw(key_gather, *given), mesh)
        experience, metrics = learner.gather(state.params, rows, key_gather, *given)
        experience = _everywhere(experience, mesh)

        def rows_of(index: jax.Array) -> Any:
            return spread(jax.tree.map(lambda leaf: leaf[index], experience), mesh)

        def gradient(params: Any, index: jax.Array) -> tuple[Any, Metrics]:
            whole = mesh is not None or jax.default_backend() != "cpu"
            size = len(index) if whole else min(config.slice_rows, len(index))
            one = jax.grad(
                lambda params, rows: learner.loss(params, rows, state.num_updates),
                has_aux=True,
            )
            return sliced(one, params, rows_of, index, size)

        num_rows = len(experience.counted)
        after, losses = epochs(state, config, num_rows, gradient, key_epochs)
        after = dataclasses.replace(after, key=jax.random.key_data(key))
        return _everywhere((after, metrics | losses), mesh)

    return update


def spread(tree: Any, mesh: Mesh | None) -> Any:
    """The same values, the leading axis of every leaf spread over the devices."""
    return _placed(tree, mesh, PartitionSpec("sets"))


def _everywhere(tree: Any, mesh: Mesh | None) -> Any:
    return _placed(tree, mesh, PartitionSpec())


def _placed(tree: Any, mesh: Mesh | None, spec: PartitionSpec) -> Any:
    if mesh is None:
        return tree
    return jax.lax.with_sharding_constraint(tree, NamedSharding(mesh, spec))


@functools.lru_cache(maxsize=32)
def updates(
    config: PPOConfig,
    learner: Learner,
    mesh: Mesh | None = None,
    most: int = 1,
    seeds: int = 0,
) -> Callable[..., tuple[TrainState, Metrics]]:
    """Several updates in one compiled call; nothing is compiled for another seed.

    Args:
        config, learner, mesh: as for ``make_update``.
        most: updates of a call, at most.
        seeds: runs side by side, each leaf of the state with a leading axis of so many;
            0 for one run without that axis.

    Returns:
        (state, given up; () number of updates to make, at most ``most``; *given) -> the
        next state, and metrics with a leading axis ``most``, zero from that number on.
        An update is the same program whatever the number, so cutting a run into calls
        in another way changes no bit of it.
    """
    one = make_update(config, learner, mesh)

    def several(state: TrainState, count: jax.Array, *given: Any) -> Any:
        def update(state: TrainState) -> tuple[TrainState, Metrics]:
            return one(state, *given)

        each = jax.vmap(update) if seeds else update

        def step(number: jax.Array, carry: Any) -> Any:
            state, kept = carry
            state, found = each(state)
            kept = jax.tree.map(lambda k, f: k.at[number].set(f), kept, found)
            return state, kept

        shapes = jax.eval_shape(each, state)[1]
        kept = jax.tree.map(lambda m: jnp.zeros((most, *m.shape), m.dtype), shapes)
        return jax.lax.fori_loop(0, count, step, (state, kept))

    return jax.jit(several, donate_argnums=0)


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
