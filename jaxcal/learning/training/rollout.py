"""Playing the episodes of one update: what the policy did, and how good it was."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.learning.policies import networks
from jaxcal.learning.policies.networks import Network
from jaxcal.learning.training.config import PPOConfig
from jaxcal.learning.training.rules import Rules

__all__ = ["Rollout", "advantages", "draw", "play"]


@struct.dataclass
class Rollout:
    """Episodes of one update: B sets, G episodes for each, T learned decisions."""

    features: Any  # leaves (B, ...): of the candidate sets
    decisions: Any  # leaves (B, T, G, ...): of the decisions
    action: jax.Array  # (B, T, G) int32
    log_prob: jax.Array  # (B, T, G) of the action when it was taken
    advantage: jax.Array  # (B, T, G)
    target: jax.Array  # (B, T, G) return, reward units
    counted: jax.Array  # (B, T, G) 1 where the policy chose, 0 for a random start


def draw(task: Rules, num_sets: int, key: jax.Array) -> Any:
    """States of (num_sets,) new episodes, each with candidates of its own."""
    return jax.vmap(task.reset)(jax.random.split(key, num_sets))


def play(
    config: PPOConfig,
    task: Rules,
    network: Network,
    params: Any,
    sets: Any,
    key_actions: jax.Array,
    key_starts: jax.Array,
) -> tuple[Rollout, dict[str, jax.Array]]:
    """Play ``episodes_per_set`` episodes on every set.

    Args:
        config, task, network, params: what plays, and by which rules.
        sets: from ``draw``.
        key_actions: spent by the policy's choices.
        key_starts: by the lengths of random starts.

    Returns:
        The rollout; metrics: scalars, and ``rewards`` (episodes_per_update,).
    """
    repeats = config.episodes_per_set
    features = network.candidate_features(sets.candidates, sets.available)
    memory = networks.encode(network, params, features)
    # Every episode of a set shares its candidates, their geometry and their memory.
    states = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf[None], (repeats, *leaf.shape)), sets
    )
    decode = jax.vmap(lambda seen: networks.decode(network, params, memory, seen))
    # The rules are those of one episode.
    advance = jax.vmap(jax.vmap(task.step))
    paid_of = jax.vmap(jax.vmap(task.paid))
    outcome_of = jax.vmap(jax.vmap(task.outcome))
    length = _start_lengths(task, (repeats, len(sets.available)), key_starts)
    learned = task.num_decisions - network.num_unlearned
    out: list[dict[str, Any]] = []
    final = jnp.zeros(length.shape)
    for step, key_step in enumerate(jax.random.split(key_actions, task.num_decisions)):
        key_policy, key_random = jax.random.split(key_step)
        seen = jax.vmap(
            lambda chosen, free, count=step: network.decision_features(
                features, chosen, free, count
            )
        )(states.chosen, states.available)
        logits, value = decode(seen) if step < learned else network.finish(seen)
        action = jax.random.categorical(key_policy, logits)
        if task.random_starts > 0.0:
            blind = networks.mask_logits(jnp.zeros_like(logits), states.available)
            action = jnp.where(
                step < length, jax.random.categorical(key_random, blind), action
            )
        # What was paid already is not to come: the value is of the rest.
        paid = paid_of(states)
        states, reward, _ = advance(states, action)
        final = final + reward
        log_probs = jax.nn.log_softmax(logits)
        log_prob = jnp.take_along_axis(log_probs, action[..., None], axis=-1)[..., 0]
        record = {
            "action": action.astype(jnp.int32),
            "log_prob": log_prob,
            "value": value * task.value_scale - paid,
            "paid": paid,
            "reward": reward,
            "counted": (step >= length).astype(logits.dtype),
            "entropy": -(jnp.exp(log_probs) * log_probs).sum(-1),
        }
        out.append(record | ({"decisions": seen} if step < learned else {}))
    own = (length == 0).astype(final.dtype)
    advantage, target = _judged(config, out, own)
    # What is not learned is dropped: the last choices, made by the look-ahead alone.
    out, target = out[:learned], target[:learned]
    counted = jnp.stack([r["counted"] for r in out])
    advantage = _normalised(config, advantage[:learned], counted)
    entropy = jnp.stack([r["entropy"] for r in out])

    def by_set(leaf: jax.Array) -> jax.Array:
        return jnp.moveaxis(leaf, 2, 0)  # (T, G, B, ...) -> (B, T, G, ...)

    def stacked(name: str) -> Any:
        return jax.tree.map(
            lambda *leaves: by_set(jnp.stack(leaves)), *[r[name] for r in out]
        )

    rollout = Rollout(
        features=features,
        decisions=stacked("decisions"),
        action=stacked("action"),
        log_prob=stacked("log_prob"),
        advantage=by_set(advantage),
        target=by_set(target),
        counted=by_set(counted),
    )
    outcome = (outcome_of(states) * own).sum() / jnp.maximum(own.sum(), 1.0)
    metrics = {
        "rewards": final.reshape(-1),
        "reward_mean": final.mean(),
        "reward_std": final.std(),
        "log_det_mean": outcome,
        "entropy": (entropy * counted).sum() / jnp.maximum(counted.sum(), 1.0),
    }
    return rollout, metrics


def _start_lengths(task: Rules, shape: tuple[int, int], key: jax.Array) -> jax.Array:
    """``shape`` numbers of random choices that each episode begins with; mostly 0."""
    key_share, key_length = jax.random.split(key)
    begun = jax.random.uniform(key_share, shape) < task.random_starts
    length = jax.random.randint(key_length, shape, 1, max(task.num_decisions - 1, 2))
    return jnp.where(begun, length, 0)


def _judged(
    config: PPOConfig, out: list[dict[str, Any]], own: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Advantages and value targets of every decision, (K, G, B) each.

    Args:
        config: discount, lambda, episodes for each set.
        out: K records with value, reward and paid (G, B).
        own: (G, B) 1 where the policy made the first choice itself.
    """
    value, reward, paid = (
        jnp.stack([r[name] for r in out]) for name in ("value", "reward", "paid")
    )
    advantage = advantages(reward, value, config.discount, config.gae_lambda)
    target = advantage + value + paid
    if config.episodes_per_set > 1:
        # On the first decision the set's other episodes are the better baseline: those
        # that the policy began itself.
        counts = own.sum(0, keepdims=True) - own
        others = (target[0] * own).sum(0, keepdims=True) - target[0] * own
        baseline = jnp.where(counts > 0, others / jnp.maximum(counts, 1.0), value[0])
        advantage = advantage.at[0].set(target[0] - baseline)
    return advantage, target


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


def _normalised(
    config: PPOConfig, advantage: jax.Array, counted: jax.Array
) -> jax.Array:
    """(T, G, B) with mean 0 and scale 1 over what counts, outliers clipped.

    A random start is given, not chosen; from its end the episode counts as any other.
    """
    axes = (1, 2) if config.normalise_per_decision else (0, 1, 2)
    number = jnp.maximum(counted.sum(axes, keepdims=True), 1.0)
    mean = (advantage * counted).sum(axes, keepdims=True) / number
    centred = advantage - mean
    scale = jnp.sqrt((centred**2 * counted).sum(axes, keepdims=True) / number)
    limit = config.advantage_limit
    return jnp.clip(centred / (scale + 1e-6), -limit, limit)
