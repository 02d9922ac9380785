"""Postures: episodes of K choices among M candidates, as PPO plays and scores them.

A row is a fresh candidate set and several whole episodes on it: they share its
geometry, its encoding and its first decision, and are each other's baseline. All are
equally long, so they are played step by step; the network's last, unlearned choices are
made by its look-ahead.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.learning.core.network import Network, decode, encode, initial, mask_logits
from jaxcal.learning.core.ppo import (
    Batch,
    Metrics,
    PPOConfig,
    advantages,
    normalised,
    surrogate,
)
from jaxcal.learning.settings import require, setting

__all__ = ["Episode", "EpisodesConfig", "Postures"]


@dataclasses.dataclass(frozen=True)
class EpisodesConfig(PPOConfig):
    """How much is played, in episodes."""

    num_episodes: int = setting(200_000, "training budget")
    episodes_per_update: int = setting(2048, "fresh episodes in an update")
    episodes_per_set: int = setting(
        8, "episodes on the same candidates, which share a baseline"
    )
    normalise_per_decision: bool = setting(
        True, "advantages: own mean and scale for each decision of an episode"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = ("num_episodes", "episodes_per_update", "episodes_per_set")
        require(self, "at least 1", lambda v: v >= 1, *counts)
        whole = self.episodes_per_set * self.num_minibatches
        if self.episodes_per_update % whole:
            raise ValueError(
                "episodes_per_update must be a multiple of episodes_per_set x "
                f"num_minibatches = {whole}, got {self.episodes_per_update}"
            )

    @property
    def num_updates(self) -> int:
        """Updates that cover the budget, rounded up."""
        return -(-self.num_episodes // self.episodes_per_update)

    @property
    def rows_per_update(self) -> int:
        """Candidate sets of an update."""
        return self.episodes_per_update // self.episodes_per_set


class Episode(Protocol):
    """The environment: one episode, as pure functions. Hashable.

    A state is a tree of arrays; three of its leaves are ``candidates`` (M, n),
    ``available`` (M,) bool and ``chosen`` (K,) int, -1 where nothing is chosen yet.
    """

    @property
    def random_starts(self) -> float:
        """Share of episodes begun with random choices."""

    @property
    def num_decisions(self) -> int:
        """K, choices of an episode."""

    @property
    def value_scale(self) -> float:
        """Reward for a unit of the network's value."""

    def reset(self, key: jax.Array) -> Any:
        """The state of a new episode."""

    def step(self, state: Any, action: jax.Array) -> tuple[Any, jax.Array, jax.Array]:
        """The next state, () reward, () bool done."""

    def paid(self, state: Any) -> jax.Array:
        """() reward received already of what the network's value predicts."""

    def outcome(self, state: Any) -> jax.Array:
        """() what a finished episode is judged by."""


@struct.dataclass
class Seen:
    """What the network is shown of a set: T learned decisions of G episodes."""

    features: Any  # leaves (...): of the candidate set
    first: Any  # leaves (...): of the first decision, which the episodes share
    later: Any  # leaves (T - 1, G, ...): of the others; None where T is 1


@dataclasses.dataclass(frozen=True)
class Postures:
    """The learner of postures."""

    config: EpisodesConfig
    task: Episode
    network: Network

    def init(self, key: jax.Array) -> Any:
        """Parameters before training."""
        m, n = jax.eval_shape(self.task.reset, key).candidates.shape
        return initial(self.network, key, m, n, self.task.num_decisions)

    def gather(self, params: Any, keys: jax.Array) -> tuple[Batch, Metrics]:
        """Play ``episodes_per_set`` episodes on a fresh set for each of the keys (B,).

        Returns:
            What was played, rows of decisions (T, G); metrics: scalars, and ``rewards``
            (B G,).
        """
        batch, outcome = jax.vmap(self._play, in_axes=(None, 0))(params, keys)
        reward, own = outcome["reward"], outcome["own"]  # (B, G)
        log_det = (outcome["log_det"] * own).sum() / jnp.maximum(own.sum(), 1.0)
        metrics = {
            "rewards": reward.ravel(),
            "reward_mean": reward.mean(),
            "reward_std": reward.std(),
            "log_det_mean": log_det,
        }
        return normalised(self.config, batch), metrics

    def loss(
        self, params: Any, experience: Batch, done: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """PPO's, of whole episodes."""
        score = jax.vmap(functools.partial(self._score, params))
        logits, value = score(experience.seen)
        return surrogate(self.config, logits, value, experience, done)

    def _score(self, params: Any, seen: Seen) -> tuple[jax.Array, jax.Array]:
        """(T, G, M) logits and (T, G) values in reward units of a row's decisions.

        The set is encoded once, and so is the first decision.
        """
        memory = encode(self.network, params, seen.features)
        decide = functools.partial(decode, self.network, params, memory)
        shape = (1, self.config.episodes_per_set)
        scored = [jnp.broadcast_to(x, (*shape, *x.shape)) for x in decide(seen.first)]
        if seen.later is not None:
            later = jax.vmap(jax.vmap(decide))(seen.later)
            scored = [jnp.concatenate(x) for x in zip(scored, later, strict=True)]
        logits, value = scored
        return logits, value * self.task.value_scale

    def _play(self, params: Any, key: jax.Array) -> tuple[Batch, Metrics]:
        """One row; what it came to of each episode, (G,)."""
        config, task, network = self.config, self.task, self.network
        num_episodes = config.episodes_per_set
        learned = task.num_decisions - network.num_unlearned
        key_set, key_starts, key_actions = jax.random.split(key, 3)
        start = task.reset(key_set)
        features = network.candidate_features(start.candidates, start.available)
        memory = encode(network, params, features)
        num_random = _random_starts(task, num_episodes, key_starts)

        def score(state: Any, step: int) -> tuple[Any, jax.Array, jax.Array]:
            decision = network.decision_features(
                features, state.chosen, state.available, step
            )
            if step < learned:
                return decision, *decode(network, params, memory, decision)
            return decision, *network.lookahead_logits(decision)

        def act(
            state: Any, logits: jax.Array, key: jax.Array, given: jax.Array
        ) -> tuple[Any, Metrics]:
            key_policy, key_random = jax.random.split(key)
            action = jax.random.categorical(key_policy, logits)
            if task.random_starts > 0.0:
                blind = mask_logits(jnp.zeros_like(logits), state.available)
                random = jax.random.categorical(key_random, blind)
                action = jnp.where(given, random, action)
            after, reward, _ = task.step(state, action)
            return after, {
                "action": action.astype(jnp.int32),
                "log_prob": jax.nn.log_softmax(logits)[action],
                "paid": task.paid(state),
                "reward": reward,
                "counted": 1.0 - given.astype(logits.dtype),
            }

        def of_every_episode(leaf: jax.Array) -> jax.Array:
            return jnp.broadcast_to(leaf, (num_episodes, *leaf.shape))

        states = jax.tree.map(of_every_episode, start)
        seen, played = [], []
        keys = jax.random.split(key_actions, (task.num_decisions, num_episodes))
        for step in range(task.num_decisions):
            if step == 0:  # the same for every episode
                decision, *scored = score(start, step)
                logits, value = map(of_every_episode, scored)
            else:
                of_each = jax.vmap(functools.partial(score, step=step))
                decision, logits, value = of_each(states)
            random = step < num_random
            states, record = jax.vmap(act)(states, logits, keys[step], random)
            seen.append(decision)
            played.append(record | {"value": value * task.value_scale})

        every = _stacked(played)
        own = 1.0 - (num_random > 0)  # the policy made the first choice itself
        advantage, target = _advantages_and_targets(config, every, own)
        # The last choices, made by the look-ahead alone, are not learned from.
        later = _stacked(seen[1:learned]) if learned > 1 else None
        batch = Batch(
            seen=Seen(features, seen[0], later),
            action=every["action"][:learned],
            log_prob=every["log_prob"][:learned],
            advantage=advantage[:learned],
            target=target[:learned],
            counted=every["counted"][:learned],
        )
        log_det = jax.vmap(task.outcome)(states)
        return batch, {"reward": every["reward"].sum(0), "log_det": log_det, "own": own}


def _stacked(trees: list[Any]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def _random_starts(task: Episode, number: int, key: jax.Array) -> jax.Array:
    """(number,) random choices that each episode begins with; mostly 0."""
    key_share, key_length = jax.random.split(key)
    most = max(task.num_decisions - 1, 2)
    begun = jax.random.uniform(key_share, (number,)) < task.random_starts
    length = jax.random.randint(key_length, (number,), 1, most)
    return jnp.where(begun, length, 0)


def _advantages_and_targets(
    config: EpisodesConfig, played: Metrics, own: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Advantages and value targets of every decision, (K, G) each.

    Args:
        config: discount, lambda, episodes for each set.
        played: (K, G) values, rewards, and what was paid before.
        own: (G,) 1 where the policy made the first choice itself.
    """
    # What was paid already is not to come: the baseline is the value of the rest.
    rest = played["value"] - played["paid"]
    following = jnp.concatenate([rest[1:], jnp.zeros_like(rest[:1])])
    goes_on = jnp.ones_like(rest).at[-1].set(0.0)
    advantage = advantages(config, played["reward"], rest, following, goes_on)
    target = advantage + played["value"]
    if config.episodes_per_set > 1:
        # On the first decision the set's other episodes are the better baseline: those
        # that the policy began itself.
        counts = own.sum() - own
        others = (target[0] * own).sum() - target[0] * own
        baseline = jnp.where(counts > 0, others / jnp.maximum(counts, 1.0), rest[0])
        advantage = advantage.at[0].set(target[0] - baseline)
    return advantage, target
