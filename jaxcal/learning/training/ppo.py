"""Proximal policy optimisation over candidate sets, one jitted step an update.

An update draws fresh candidate sets, plays ``episodes_per_set`` episodes on each,
computes advantages, and takes minibatch epochs on the clipped surrogate. A minibatch
holds whole episodes: the set is encoded once and all its decisions are scored together.
Sources: Schulman et al. 2017 (clipped surrogate, GAE); paper, Table 2.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import field
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.sharding import Mesh

from jaxcal.learning.environments import scenarios
from jaxcal.learning.environments import selection as environment
from jaxcal.learning.environments.selection import SelectionConfig
from jaxcal.learning.policies import networks
from jaxcal.learning.policies.networks import Network
from jaxcal.learning.runtime import devices

__all__ = [
    "PPOConfig",
    "Task",
    "TrainState",
    "advantages",
    "init",
    "learn",
    "learning_rate",
    "update",
]


@dataclasses.dataclass(frozen=True)
class Task:
    """What is trained on: an environment and where its candidates come from."""

    environment: SelectionConfig = field(default_factory=SelectionConfig)
    shapes: tuple[str, ...] = ("uniform",)  # see scenarios.SHAPES
    masked: float = 0.0  # greatest share of candidates masked
    random_starts: float = 0.0  # share of episodes begun with random choices


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Every number of the optimisation."""

    num_episodes: int = 200_000  # training budget
    episodes_per_update: int = 2048  # fresh episodes an update
    episodes_per_set: int = 8  # episodes on the same candidates, sharing a baseline
    num_epochs: int = 2  # passes over an update's episodes
    num_minibatches: int = 4  # gradient steps a pass
    learning_rate: float = 2e-3
    final_learning_rate: float = 3e-5  # cosine from the one to the other
    warmup_updates: int = 5  # linear rise of the learning rate
    clip_range: float = 0.2  # of the probability ratio
    value_coefficient: float = 0.5
    value_error_limit: float = 3.0  # reward units; a singular pick is an outlier
    entropy_start: float = 0.02  # entropy bonus, linear to entropy_end
    entropy_end: float = 0.0
    discount: float = 1.0  # episodes are short: nothing is discounted
    gae_lambda: float = 1.0
    normalise_per_decision: bool = True  # advantages: own mean and scale a decision
    advantage_limit: float = 6.0  # standard deviations; a singular pick is an outlier
    max_grad_norm: float = 0.5  # global norm
    average_decay: float = 0.99  # of the averaged weights that are evaluated and kept
    imitation: float = 0.0  # share of the updates, the first, that imitate a teacher
    seed: int = 0

    def __post_init__(self) -> None:
        positive = (
            "num_episodes",
            "episodes_per_update",
            "episodes_per_set",
            "num_epochs",
            "num_minibatches",
        )
        for name in positive:
            if getattr(self, name) < 1:
                raise ValueError(
                    f"{name} must be at least 1, got {getattr(self, name)}"
                )
        if self.episodes_per_update % (self.episodes_per_set * self.num_minibatches):
            raise ValueError(
                "episodes_per_update must be a multiple of episodes_per_set x "
                f"num_minibatches = {self.episodes_per_set * self.num_minibatches}, "
                f"got {self.episodes_per_update}"
            )
        for name in (
            "learning_rate",
            "clip_range",
            "max_grad_norm",
            "value_error_limit",
        ):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("discount", "gae_lambda", "average_decay", "imitation"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")

    @property
    def num_updates(self) -> int:
        """Updates that cover the budget, rounded up."""
        return -(-self.num_episodes // self.episodes_per_update)

    @property
    def num_imitated(self) -> int:
        """Updates that imitate, before the others."""
        return round(self.imitation * self.num_updates)

    @property
    def sets_per_minibatch(self) -> int:
        """Candidate sets in a minibatch: what devices share among them."""
        return self.episodes_per_update // self.episodes_per_set // self.num_minibatches


@struct.dataclass
class TrainState:
    """All that an uninterrupted run would need to go on, bit for bit."""

    params: Any  # network parameters
    average: Any  # exponential average of the parameters
    opt_state: Any  # optax state
    key: jax.Array  # () PRNG key of the next update
    num_updates: jax.Array  # () int32, updates made


@struct.dataclass
class Rollout:
    """Episodes of one update: B sets, G episodes a set, T learned decisions."""

    view: Any  # leaves (B, ...): the geometry of the sets
    glance: Any  # leaves (B, T, G, ...): the geometry of the decisions
    action: jax.Array  # (B, T, G) int32
    log_prob: jax.Array  # (B, T, G) of the action when it was taken
    advantage: jax.Array  # (B, T, G)
    target: jax.Array  # (B, T, G) return, reward units
    counted: jax.Array  # (B, T, G) 1 where the policy chose, 0 for a random start


def _schedule(config: PPOConfig) -> optax.Schedule:
    steps = config.num_epochs * config.num_minibatches
    return optax.warmup_cosine_decay_schedule(
        init_value=config.learning_rate / 10,
        peak_value=config.learning_rate,
        warmup_steps=max(config.warmup_updates, 1) * steps,
        decay_steps=max(config.num_updates, config.warmup_updates + 1) * steps,
        end_value=config.final_learning_rate,
    )


def learning_rate(config: PPOConfig, update: int) -> float:
    """The learning rate after an update."""
    return float(_schedule(config)(update * config.num_epochs * config.num_minibatches))


def optimiser(config: PPOConfig) -> optax.GradientTransformation:
    """Adam under a warmed-up cosine schedule, gradients clipped by global norm."""
    return optax.chain(
        _clip_by_global_norm(config.max_grad_norm),
        optax.adam(_schedule(config), eps=1e-5),
    )


def _clip_by_global_norm(limit: float) -> optax.GradientTransformation:
    """``optax.clip_by_global_norm``, but as one factor for every gradient.

    optax divides each gradient by the norm; XLA fuses a division into neither of Adam's
    moments and writes the clipped gradients to memory first.
    """

    def clip(grads: Any, state: Any, params: Any = None) -> tuple[Any, Any]:
        norm = jnp.sqrt(sum(jnp.vdot(grad, grad) for grad in jax.tree.leaves(grads)))
        factor = jnp.minimum(1.0, limit / jnp.maximum(norm, 1e-30))
        return jax.tree.map(lambda grad: grad * factor, grads), state

    return optax.GradientTransformation(lambda params: optax.EmptyState(), clip)


def init(config: PPOConfig, task: Task, network: Network) -> TrainState:
    """The state before the first update, from the seed alone."""
    return _init(config, task, network)


# One program: op by op it would be two hundred small ones, seconds to compile.
@functools.partial(jax.jit, static_argnames=("config", "task", "network"))
def _init(config: PPOConfig, task: Task, network: Network) -> TrainState:
    key_params, key_train = jax.random.split(jax.random.key(config.seed))
    env = task.environment
    params = network.init(
        key_params,
        jnp.zeros((1, env.num_candidates, env.num_inputs)),
        jnp.ones((1, env.num_candidates), bool),
        jnp.full((1, env.num_selected), -1, jnp.int32),
        jnp.ones((1, env.num_candidates), bool),
    )["params"]
    return TrainState(
        params=params,
        average=jax.tree.map(jnp.copy, params),
        opt_state=optimiser(config).init(params),
        key=key_train,
        num_updates=jnp.zeros((), jnp.int32),
    )


def advantages(
    rewards: jax.Array, values: jax.Array, discount: float, gae_lambda: float
) -> jax.Array:
    """Generalised advantage estimates of complete episodes.

    Args:
        rewards: (T, ...) reward of each decision.
        values: (T, ...) value before each decision; after the last it is 0.
    """
    following = jnp.concatenate([values[1:], jnp.zeros_like(values[:1])])
    deltas = rewards + discount * following - values

    def back(carry: jax.Array, delta: jax.Array) -> tuple[jax.Array, jax.Array]:
        carry = delta + discount * gae_lambda * carry
        return carry, carry

    return jax.lax.scan(back, jnp.zeros_like(deltas[0]), deltas, reverse=True)[1]


def _play(
    config: PPOConfig,
    task: Task,
    network: Network,
    params: Any,
    key: jax.Array,
    mesh: Mesh | None = None,
) -> tuple[Rollout, dict[str, jax.Array]]:
    """Draw fresh sets and play every episode of one update."""
    env = task.environment
    repeats = config.episodes_per_set
    num_sets = config.episodes_per_update // repeats
    draw = scenarios.mixture(env, task.shapes, task.masked)
    key_sets, key_actions, key_starts = jax.random.split(key, 3)
    sets = jax.vmap(lambda key: environment.reset(key, env, draw))(
        jax.random.split(key_sets, num_sets)
    )
    sets = devices.by_set(sets, mesh)
    view = environment.look(network, sets)
    memory = networks.encode(network, params, view)
    # Every episode of a set shares its candidates, their geometry and their memory.
    states = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf[None], (repeats, *leaf.shape)), sets
    )
    decode = jax.vmap(lambda glance: networks.decode(network, params, memory, glance))
    advance = jax.vmap(
        jax.vmap(lambda state, action: environment.step(state, action, env))
    )
    key_share, key_length = jax.random.split(key_starts)
    shape = (repeats, num_sets)
    begun = jax.random.uniform(key_share, shape) < task.random_starts
    length = jax.random.randint(key_length, shape, 1, max(env.num_selected - 1, 2))
    length = jnp.where(begun, length, 0)

    learned = env.num_selected - network.num_unlearned
    out: list[dict[str, Any]] = []
    final = jnp.zeros(shape)
    for step, key_step in enumerate(jax.random.split(key_actions, env.num_selected)):
        key_policy, key_random = jax.random.split(key_step)
        glance = jax.vmap(
            lambda chosen, free, count=step: network.look_at(view, chosen, free, count)
        )(states.chosen, states.available)
        logits, value = decode(glance) if step < learned else network.finish(glance)
        action = jax.random.categorical(key_policy, logits)
        if task.random_starts > 0.0:
            blind = networks.mask_logits(jnp.zeros_like(logits), states.available)
            action = jnp.where(
                step < length, jax.random.categorical(key_random, blind), action
            )
        # What was paid already is not to come: the value is of the rest.
        paid = env.reward_scale * states.paid * float(env.reward_gain)
        states, reward, _ = advance(states, action)
        final = final + reward
        log_probs = jax.nn.log_softmax(logits)
        log_prob = jnp.take_along_axis(log_probs, action[..., None], axis=-1)[..., 0]
        record = {
            "action": action.astype(jnp.int32),
            "log_prob": log_prob,
            "value": value * (env.reward_scale * env.num_outputs) - paid,
            "paid": paid,
            "reward": reward,
            "counted": (step >= length).astype(logits.dtype),
            "entropy": -(jnp.exp(log_probs) * log_probs).sum(-1),
        }
        out.append(record | ({"glance": glance} if step < learned else {}))
    value, reward, paid = (
        jnp.stack([r[name] for r in out]) for name in ("value", "reward", "paid")
    )
    advantage = advantages(reward, value, config.discount, config.gae_lambda)
    target = advantage + value + paid
    own = (length == 0).astype(final.dtype)
    if repeats > 1:
        # On the first decision the set's other episodes are the better baseline: those
        # that the policy began itself.
        counts = own.sum(0, keepdims=True) - own
        others = (target[0] * own).sum(0, keepdims=True) - target[0] * own
        baseline = jnp.where(counts > 0, others / jnp.maximum(counts, 1.0), value[0])
        advantage = advantage.at[0].set(target[0] - baseline)
    # What is not learned is dropped here: the last choices made by volume alone.
    out, advantage, target = out[:learned], advantage[:learned], target[:learned]
    counted = jnp.stack([r["counted"] for r in out])
    entropy = jnp.stack([r["entropy"] for r in out])
    # A random start is given, not chosen; from its end the episode counts as any other.
    weight = counted
    axes = (1, 2) if config.normalise_per_decision else (0, 1, 2)
    number = jnp.maximum(weight.sum(axes, keepdims=True), 1.0)
    mean = (advantage * weight).sum(axes, keepdims=True) / number
    centred = advantage - mean
    scale = jnp.sqrt((centred**2 * weight).sum(axes, keepdims=True) / number)
    advantage = jnp.clip(
        centred / (scale + 1e-6), -config.advantage_limit, config.advantage_limit
    )

    def by_set(leaf: jax.Array) -> jax.Array:
        return jnp.moveaxis(leaf, 2, 0)  # (T, G, B, ...) -> (B, T, G, ...)

    def stacked(name: str) -> Any:
        return jax.tree.map(
            lambda *leaves: by_set(jnp.stack(leaves)), *[r[name] for r in out]
        )

    rollout = Rollout(
        view=view,
        glance=stacked("glance"),
        action=stacked("action"),
        log_prob=stacked("log_prob"),
        advantage=by_set(advantage),
        target=by_set(target),
        counted=by_set(counted),
    )
    log_det = (states.paid * own).sum() / jnp.maximum(own.sum(), 1.0)
    metrics = {
        "rewards": final.reshape(-1),
        "reward_mean": final.mean(),
        "reward_std": final.std(),
        "log_det_mean": log_det,
        "entropy": (entropy * counted).sum() / jnp.maximum(counted.sum(), 1.0),
    }
    return rollout, metrics


def _loss(
    params: Any,
    batch: Rollout,
    entropy_bonus: jax.Array,
    config: PPOConfig,
    task: Task,
    network: Network,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Clipped surrogate, squared value error and entropy bonus of whole episodes."""
    env = task.environment
    memory = networks.encode(network, params, batch.view)
    decode = jax.vmap(
        jax.vmap(
            lambda glance: networks.decode(network, params, memory, glance),
            in_axes=1,
            out_axes=1,
        ),
        in_axes=1,
        out_axes=1,
    )
    logits, value = decode(batch.glance)
    value = value * (env.reward_scale * env.num_outputs)
    log_probs = jax.nn.log_softmax(logits)
    log_prob = jnp.take_along_axis(log_probs, batch.action[..., None], axis=-1)
    log_ratio = log_prob[..., 0] - batch.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - config.clip_range, 1.0 + config.clip_range)
    number = jnp.maximum(batch.counted.sum(), 1.0)

    def mean(array: jax.Array) -> jax.Array:
        return (array * batch.counted).sum() / number

    surrogate = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
    policy_loss = -mean(surrogate)
    limit = config.value_error_limit
    error = jnp.clip(value - batch.target, -limit, limit)
    value_loss = mean(error**2)
    entropy = mean(-(jnp.exp(log_probs) * log_probs).sum(-1))
    loss = policy_loss + config.value_coefficient * value_loss - entropy_bonus * entropy
    metrics = {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "kl": mean(ratio - 1.0 - log_ratio),
    }
    return loss, metrics


@functools.partial(
    jax.jit,
    static_argnames=("config", "task", "network", "mesh"),
    donate_argnames=("state",),
)
def update(
    state: TrainState,
    config: PPOConfig,
    task: Task,
    network: Network,
    mesh: Mesh | None = None,
) -> tuple[TrainState, dict[str, jax.Array]]:
    """One update: play, then epochs of minibatches.

    Over a mesh every device plays and learns from its share of the candidate sets. What
    was played is gathered once, so that a minibatch is any of the sets, as on a single
    device, and is cut without further communication.

    Args:
        state: from ``init``; given up.
        config, task, network: what is trained, and how.
        mesh: from ``devices.make_mesh``; None for one device.

    Returns:
        The next state, and metrics: scalars, and ``rewards`` (episodes_per_update,).
    """
    key, key_play, key_epochs = jax.random.split(state.key, 3)
    rollout, metrics = _play(config, task, network, state.params, key_play, mesh)
    rollout = devices.everywhere(rollout, mesh)
    progress = jnp.minimum(state.num_updates / config.num_updates, 1.0)
    bonus = config.entropy_start + progress * (
        config.entropy_end - config.entropy_start
    )

    def loss(params: Any, batch: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
        return _loss(params, batch, bonus, config, task, network)

    state, losses = learn(state, config, rollout, loss, key_epochs, mesh)
    state = dataclasses.replace(state, key=key)
    return devices.everywhere((state, metrics | losses), mesh)


def learn(
    state: TrainState,
    config: PPOConfig,
    data: Any,
    loss: Callable[[Any, Any], tuple[jax.Array, dict[str, jax.Array]]],
    key: jax.Array,
    mesh: Mesh | None = None,
) -> tuple[TrainState, dict[str, jax.Array]]:
    """Epochs of minibatches over what an update has gathered.

    Args:
        state: before the update.
        config: the optimisation.
        data: arrays with one leading row a candidate set.
        loss: (parameters, rows of data) -> loss and metrics.
        key: orders the minibatches.
        mesh: shares each minibatch among devices.

    Returns:
        The state after the update, its key as it was; the mean of each metric.
    """
    optimise = optimiser(config)
    num_sets = len(jax.tree.leaves(data)[0])
    size = num_sets // config.num_minibatches

    def minibatch(carry: Any, index: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        params, average, opt_state = carry
        batch = devices.by_set(jax.tree.map(lambda leaf: leaf[index], data), mesh)
        grads, metrics = jax.grad(loss, has_aux=True)(params, batch)
        changes, opt_state = optimise.update(grads, opt_state, params)
        params = optax.apply_updates(params, changes)
        decay = config.average_decay
        average = jax.tree.map(
            lambda old, new: decay * old + (1.0 - decay) * new, average, params
        )
        return (params, average, opt_state), metrics

    def epoch(carry: Any, key: jax.Array) -> tuple[Any, dict[str, jax.Array]]:
        order = jax.random.permutation(key, num_sets)
        return jax.lax.scan(
            minibatch, carry, order.reshape(config.num_minibatches, size)
        )

    carry = (state.params, state.average, state.opt_state)
    carry, metrics = jax.lax.scan(
        epoch, carry, jax.random.split(key, config.num_epochs)
    )
    params, average, opt_state = carry
    state = dataclasses.replace(
        state,
        params=params,
        average=average,
        opt_state=opt_state,
        num_updates=state.num_updates + 1,
    )
    return state, {name: value.mean() for name, value in metrics.items()}
