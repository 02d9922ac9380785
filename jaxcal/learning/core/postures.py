"""Postures: episodes of K choices among M candidates, as PPO plays and scores them.

Every update draws fresh candidate sets and plays several whole episodes on each, so the
episodes of a set share its geometry, its encoding and its first decision, and are each
other's baseline. All episodes are equally long: they are played step by step, with the
network's last, unlearned choices made by its look-ahead.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.learning.core.network import (
    Network,
    decode,
    encode,
    initial,
    mask_logits,
)
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
    imitation: float = setting(
        0.0, "share of the updates, the first, that imitate the solvers"
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
        require(self, "in [0, 1]", lambda v: 0.0 <= v <= 1.0, "imitation")

    @property
    def num_updates(self) -> int:
        """Updates that cover the budget, rounded up."""
        return -(-self.num_episodes // self.episodes_per_update)

    @property
    def num_imitated(self) -> int:
        """Updates that imitate, before the others."""
        return round(self.imitation * self.num_updates)

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
    """What the network is shown of B sets: T learned decisions of G episodes each."""

    features: Any  # leaves (B, ...): of the candidate sets
    first: Any  # leaves (B, ...): of the first decision, which a set's episodes share
    later: Any  # leaves (B, T - 1, G, ...): of the others; None where T is 1


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

    def draw(self, key: jax.Array) -> Any:
        """States of new episodes, one a set, each with candidates of its own."""
        key_sets, _, _ = jax.random.split(key, 3)
        keys = jax.random.split(key_sets, self.config.rows_per_update)
        return jax.vmap(self.task.reset)(keys)

    def gather(self, params: Any, rows: Any, key: jax.Array) -> tuple[Batch, Metrics]:
        """Play ``episodes_per_set`` episodes on every set.

        Returns:
            What was played, rows (B,) of decisions (T, G); metrics: scalars, and
            ``rewards`` (episodes_per_update,).
        """
        config, task, network = self.config, self.task, self.network
        repeats = config.episodes_per_set
        _, key_actions, key_starts = jax.random.split(key, 3)
        features = network.candidate_features(rows.candidates, rows.available)
        memory = encode(network, params, features)

        def of_every_episode(leaf: jax.Array) -> jax.Array:
            return jnp.broadcast_to(leaf[None], (repeats, *leaf.shape))

        states = jax.tree.map(of_every_episode, rows)
        # The rules are those of one episode.
        advance = jax.vmap(jax.vmap(task.step))
        paid_of, outcome_of = (
            jax.vmap(jax.vmap(task.paid)),
            jax.vmap(jax.vmap(task.outcome)),
        )
        length = _start_lengths(task, (repeats, len(rows.available)), key_starts)
        learned = task.num_decisions - network.num_unlearned
        seen: list[Any] = []
        out: list[Metrics] = []
        final = jnp.zeros(length.shape)
        for step, key_step in enumerate(
            jax.random.split(key_actions, task.num_decisions)
        ):
            key_policy, key_random = jax.random.split(key_step)

            def view(states: Any, step: int = step) -> tuple[Any, jax.Array, jax.Array]:
                decision = network.decision_features(
                    features, states.chosen, states.available, step
                )
                if step < learned:
                    return decision, *decode(network, params, memory, decision)
                return decision, *network.lookahead_logits(decision)

            if step == 0:  # one decision for all episodes of a set
                decision, *scored = view(rows)
                logits, value = (of_every_episode(leaf) for leaf in scored)
            else:
                decision, logits, value = jax.vmap(view)(states)
            if step < learned:
                seen.append(decision)
            action = jax.random.categorical(key_policy, logits)
            if task.random_starts > 0.0:
                blind = mask_logits(jnp.zeros_like(logits), states.available)
                action = jnp.where(
                    step < length, jax.random.categorical(key_random, blind), action
                )
            # What was paid already is not to come: the value is of the rest.
            paid = paid_of(states)
            states, reward, _ = advance(states, action)
            final = final + reward
            log_probs = jax.nn.log_softmax(logits)
            log_prob = jnp.take_along_axis(log_probs, action[..., None], axis=-1)[
                ..., 0
            ]
            out.append(
                {
                    "action": action.astype(jnp.int32),
                    "log_prob": log_prob,
                    "value": value * task.value_scale - paid,
                    "paid": paid,
                    "reward": reward,
                    "counted": (step >= length).astype(logits.dtype),
                    "entropy": -(jnp.exp(log_probs) * log_probs).sum(-1),
                }
            )
        played = {name: jnp.stack([each[name] for each in out]) for name in out[0]}
        own = (length == 0).astype(final.dtype)
        advantage, target = _advantages_and_targets(config, played, own)
        # The last choices, made by the look-ahead alone, are not learned from.
        counted, entropy = played["counted"][:learned], played["entropy"][:learned]
        axes = (1, 2) if config.normalise_per_decision else (0, 1, 2)
        advantage = normalised(config, advantage[:learned], counted, axes)

        def by_set(leaf: jax.Array) -> jax.Array:
            return jnp.moveaxis(leaf[:learned], 2, 0)  # (T, G, B) -> (B, T, G)

        def stacked(*leaves: jax.Array) -> jax.Array:
            return jnp.moveaxis(jnp.stack(leaves), 2, 0)

        later = jax.tree.map(stacked, *seen[1:]) if learned > 1 else None
        batch = Batch(
            seen=Seen(features, seen[0], later),
            action=by_set(played["action"]),
            log_prob=by_set(played["log_prob"]),
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
        return batch, metrics

    def loss(
        self, params: Any, experience: Batch, done: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """PPO's, of whole episodes."""
        logits, value = self.score(params, experience)
        return surrogate(self.config, logits, value, experience, done)

    def score(self, params: Any, batch: Batch) -> tuple[jax.Array, jax.Array]:
        """(B, T, G, M) logits and (B, T, G) values in reward units.

        A set is encoded once, and so is its first decision.
        """
        memory = encode(self.network, params, batch.seen.features)
        shared = decode(self.network, params, memory, batch.seen.first)
        logits, value = (
            jnp.repeat(x[:, None, None], batch.action.shape[-1], axis=2) for x in shared
        )
        if batch.seen.later is not None:
            more = decode(self.network, params, memory, batch.seen.later, axes=2)
            logits = jnp.concatenate([logits, more[0]], axis=1)
            value = jnp.concatenate([value, more[1]], axis=1)
        return logits, value * self.task.value_scale


def _start_lengths(task: Episode, shape: tuple[int, int], key: jax.Array) -> jax.Array:
    """``shape`` numbers of random choices that each episode begins with; mostly 0."""
    key_share, key_length = jax.random.split(key)
    begun = jax.random.uniform(key_share, shape) < task.random_starts
    length = jax.random.randint(key_length, shape, 1, max(task.num_decisions - 1, 2))
    return jnp.where(begun, length, 0)


def _advantages_and_targets(
    config: EpisodesConfig, played: Metrics, own: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Advantages and value targets of every decision, (K, G, B) each.

    Args:
        config: discount, lambda, episodes for each set.
        played: (K, G, B) values, rewards, and what was paid before.
        own: (G, B) 1 where the policy made the first choice itself.
    """
    value, paid = played["value"], played["paid"]
    following = jnp.concatenate([value[1:], jnp.zeros_like(value[:1])])
    goes_on = jnp.ones_like(value).at[-1].set(0.0)
    advantage = advantages(config, played["reward"], value, following, goes_on)
    target = advantage + value + paid
    if config.episodes_per_set > 1:
        # On the first decision the set's other episodes are the better baseline: those
        # that the policy began itself.
        counts = own.sum(0, keepdims=True) - own
        others = (target[0] * own).sum(0, keepdims=True) - target[0] * own
        baseline = jnp.where(counts > 0, others / jnp.maximum(counts, 1.0), value[0])
        advantage = advantage.at[0].set(target[0] - baseline)
    return advantage, target
