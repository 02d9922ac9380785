"""PPO over sessions: play, advantages, minibatch epochs."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.policy.config import LENGTH
from jaxcal.adaptive.policy.features import Seen, see
from jaxcal.adaptive.policy.network import Network
from jaxcal.adaptive.rules import Scored
from jaxcal.adaptive.session import Task
from jaxcal.learning.training import update
from jaxcal.learning.training.config import PPOConfig
from jaxcal.learning.training.optimiser import Metrics
from jaxcal.learning.training.update import Update

__all__ = ["updater"]


@struct.dataclass
class Steps:
    """B streams of T choices; a session that ends is followed by a new one."""

    seen: Seen  # leaves (B, T, ...)
    action: jax.Array  # (B, T) int32 in the shortlist
    log_prob: jax.Array  # (B, T)
    advantage: jax.Array  # (B, T)
    target: jax.Array  # (B, T)


def updater(config: PPOConfig, per_group: int, width: int) -> Update:
    """An update: (state, given up; task; base rule) -> the next state and metrics.

    ``config.episodes_per_update`` are choices: streams of ``LENGTH``.
    """
    network = Network(width)
    streams = config.episodes_per_update // LENGTH

    def draw(key: jax.Array, task: Task, base: Scored) -> Any:
        return jax.random.split(key, streams), task, base

    def gather(params: Any, given: Any, key: jax.Array) -> tuple[Steps, Metrics]:
        keys, task, base = given
        played = jax.vmap(
            lambda key: _stream(params, network, task, base, per_group, key)
        )(keys)
        seen, action, log_prob, value, reward, ended, entropy = played[:-2]
        chance, elsewhere = played[-2:]
        advantage = _advantages(
            reward, value, ended, chance, elsewhere, config.discount, config.gae_lambda
        )
        metrics = {
            "reward_mean": reward.sum() / jnp.maximum(ended.sum(), 1.0),
            "choices": 1.0 / jnp.maximum(ended.mean(), 1e-6),
            "entropy": entropy.mean(),
        }
        seen, action, log_prob = jax.tree.map(
            lambda leaf: leaf[:, :-1], (seen, action, log_prob)
        )
        scale = advantage.std() + 1e-6
        normal = (advantage - advantage.mean()) / scale
        target = advantage + value[:, :-1]
        return Steps(seen, action, log_prob, normal, target), metrics

    def loss(params: Any, batch: Steps, done: jax.Array) -> tuple[jax.Array, Metrics]:
        logits, value = _apply(network, params, batch.seen)
        log_probs = jax.nn.log_softmax(logits)
        taken = jnp.take_along_axis(log_probs, batch.action[..., None], -1)[..., 0]
        log_ratio = taken - batch.log_prob
        ratio = jnp.exp(log_ratio)
        clipped = jnp.clip(ratio, 1 - config.clip_range, 1 + config.clip_range)
        gain = jnp.minimum(ratio * batch.advantage, clipped * batch.advantage)
        policy = -gain.mean()
        error = ((value - batch.target) ** 2).mean()
        entropy = -(jnp.exp(log_probs) * log_probs).sum(-1).mean()
        progress = jnp.minimum(done / config.num_updates, 1.0)
        bonus = config.entropy_start + progress * (
            config.entropy_end - config.entropy_start
        )
        whole = policy + config.value_coefficient * error - bonus * entropy
        kl = (ratio - 1.0 - log_ratio).mean()
        return whole, {"policy_loss": policy, "value_loss": error, "kl": kl}

    return update.jitted(config, None, draw=draw, gather=gather, loss=loss)


def _apply(network: Network, params: Any, seen: Seen) -> tuple[jax.Array, jax.Array]:
    result: Any = network.apply(params, seen)
    return result


def _advantages(
    reward: jax.Array,
    value: jax.Array,
    ended: jax.Array,
    chance: jax.Array,
    elsewhere: jax.Array,
    discount: float,
    lam: float,
) -> jax.Array:
    """(B, T) generalised advantage estimates of the first T choices.

    What follows a choice counts in expectation over its outcomes, not as it happened:
    the randomness of the outcome, most of the variance, is left out. The expectation of
    the estimates is the same.

    Args:
        reward, value, ended: (B, T + 1); the last value closes the cut.
        chance: (B, T + 1) of the outcome that happened.
        elsewhere: (B, T + 1) values after the other outcomes, times their chances.
        discount, lam: of later rewards, of later differences.
    """
    on = (1.0 - ended)[:, :-1]
    follow = chance[:, :-1] * on * value[:, 1:] + elsewhere[:, :-1]
    deltas = reward[:, :-1] + discount * follow - value[:, :-1]

    def back(carry: jax.Array, now: Any) -> tuple[jax.Array, jax.Array]:
        delta, on = now
        carry = delta + lam * discount * on * carry
        return carry, carry

    start = jnp.zeros_like(reward[:, 0])
    return jax.lax.scan(back, start, (deltas.T, on.T), reverse=True)[1].T


def _stream(
    params: Any, network: Network, task: Any, base: Scored, per_group: int, key: Any
) -> Any:
    """Sessions one after another, played by sampling; leaves (T + 1, ...)."""

    def begin(key: jax.Array) -> Any:
        key_truth, key_begin = jax.random.split(key)
        return task.draw(key_truth), *task.begin(key_begin)

    def step(carry: Any, key: jax.Array) -> tuple[Any, Any]:
        truth, belief, session = carry
        keys = jax.random.split(key, 7)
        options = task.options(belief, session, keys[0])
        seen = see(task, belief, session, options, keys[1], base, per_group)
        logits, value = _apply(network, params, seen)
        action = jax.random.categorical(keys[2], logits).astype(jnp.int32)
        log_probs = jax.nn.log_softmax(logits)
        design = jax.tree.map(lambda leaf: leaf[seen.index[action]], options.designs)
        # By draws of its own: those of ``seen`` chose it, so theirs is too large.
        gain = belief.gain(task, design, keys[6])
        outcome = task.measure(truth, design, keys[3])

        def after(outcome: jax.Array) -> tuple[Any, Any, jax.Array]:
            then = belief.update(task, design, outcome, keys[4])
            left = task.spend(session, design, outcome)
            return then, left, left.over | (left.made >= task.horizon)

        def value_after(outcome: jax.Array) -> jax.Array:
            then, left, ended = after(outcome)
            options = task.options(then, left, keys[0])
            seen = see(task, then, left, options, keys[1], base, per_group)
            return jnp.where(ended, 0.0, _apply(network, params, seen)[1])

        chance, elsewhere = jnp.float32(1.0), jnp.float32(0.0)
        if isinstance(task, GridTask):  # all outcomes are known, and few
            outcomes, p = belief.outcomes(task, design, keys[1])
            others = (outcome + outcomes[1:]) % len(outcomes)
            chance, elsewhere = p[outcome], p[others] @ jax.vmap(value_after)(others)
        belief, session, ended = after(outcome)
        carry = jax.tree.map(
            lambda new, old: jnp.where(ended, new, old),
            begin(keys[5]), (truth, belief, session),
        )  # fmt: skip
        entropy = -(jnp.exp(log_probs) * log_probs).sum()
        return carry, (
            seen, action, log_probs[action], value, gain,
            ended.astype(jnp.float32), entropy, chance, elsewhere,
        )  # fmt: skip

    key_begin, key_steps = jax.random.split(key)
    keys = jax.random.split(key_steps, LENGTH + 1)
    return jax.lax.scan(step, begin(key_begin), keys)[1]
