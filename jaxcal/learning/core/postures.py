"""Postures: episodes of K choices among M candidates, as PPO plays and scores them.

A row is a fresh candidate set and G episodes on it. They share its features, encoding
and first decision, whose baseline is the mean return of the others. Of the K choices
the network learns the first T; its look-ahead makes the rest. With ``explore_once`` T =
1: they have ``num_given`` choices in common, learn the next one and go on greedily.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.learning.config import EpisodesConfig
from jaxcal.learning.core import ppo
from jaxcal.learning.core.network import Network, decode, encode, initial
from jaxcal.learning.core.ppo import Batch, Metrics


class Episode(Protocol):
    """The environment: one episode, as pure functions. Hashable. Leaves of a state are
    ``candidates`` (M, n), ``available`` (M,) bool and ``chosen`` (K,) int, -1 where
    nothing is chosen yet."""

    @property
    def num_decisions(self) -> int:
        """K, choices of an episode."""

    @property
    def num_given(self) -> int:
        """Choices that episodes on a set have in common, with ``explore_once``."""

    @property
    def value_scale(self) -> float:
        """Reward per unit of the network's value."""

    def reset(self, key: jax.Array) -> Any:
        """The state of a new episode."""

    def step(self, state: Any, action: jax.Array) -> tuple[Any, jax.Array, jax.Array]:
        """The next state, () reward, () bool done."""

    def paid(self, state: Any) -> jax.Array:
        """() part of the total that the network's value predicts, received so far."""

    def outcome(self, state: Any) -> jax.Array:
        """() score of a finished episode, for the metric ``log_det_mean``."""


@struct.dataclass
class RowInputs:
    """Inputs of the network for one set: T learned decisions of G episodes."""

    features: Any  # leaves (...): candidate features of the set
    decisions: Any  # leaves (1 + (T - 1) G, ...): of the first decision, which the
    # episodes share, then of the others, decision by decision


_RANDOM = 0.3  # share of the given choices that are random, not drawn from the policy

# Bytes of the (M, M) arrays of a look-ahead that are held at a time while it plays.
_ROOM = {"cpu": 2**29, "gpu": 2**33, "tpu": 2**33}


def _at_once(number: int, m: int, each: int = 1) -> int:
    room = _ROOM.get(jax.default_backend(), 2**33)
    most = max(room // (20 * each * m * min(m, 1024)), 1)
    return max(d for d in range(1, number + 1) if number % d == 0 and d <= most)


def _mapped(function: Callable[..., Any], at_once: int, leaves: Any) -> Any:
    if at_once == len(jax.tree.leaves(leaves)[0]):
        return jax.vmap(function)(leaves)
    return jax.lax.map(function, leaves, batch_size=at_once)


def _single(function: Callable[..., Any], *arguments: Any) -> Callable[[], Any]:
    """``function`` without arguments, whose numbers are float32 with 64 bits on too."""

    def called() -> Any:
        return jax.tree.map(lambda x: x.astype(jnp.float32), function(*arguments))

    return called


def _followed(first: jax.Array, others: jax.Array) -> jax.Array:
    return jnp.concatenate([first, others.reshape(-1, *others.shape[2:])])


@dataclasses.dataclass(frozen=True)
class Postures:
    """The learner of postures."""

    config: EpisodesConfig
    task: Episode
    network: Network

    def init(self, key: jax.Array, *given: Any) -> Any:
        """Parameters before training."""
        m, n = jax.eval_shape(self.task.reset, key).candidates.shape
        return initial(self.network, key, m, n, self.task.num_decisions)

    def begin(self, keys: jax.Array, *given: Any) -> jax.Array:
        """(B, 2) uint32, data of the keys of the rows, of which (B,) are the first."""
        return jax.random.key_data(keys)

    def rollout(
        self, params: Any, rollout_state: jax.Array
    ) -> tuple[Batch, jax.Array, Metrics]:
        """Play ``episodes_per_set`` episodes on a fresh set in each row: rows of
        decisions (T, G), the keys of the next update, metrics with ``rewards`` (B
        G,)."""
        # Of the set, of the actions, of the next update.
        split = jax.vmap(lambda key: jax.random.split(key, 3))
        keys = split(jax.random.wrap_key_data(rollout_state))
        m = jax.eval_shape(self.task.reset, keys[0, 0]).available.shape[0]
        held = _at_once(self.config.episodes_per_set, m)  # episodes of a row at a time
        rows = _at_once(len(keys), m, held)
        if self.config.explore_once and jax.default_backend() == "cpu":
            rows = math.gcd(rows, self.config.slice_rows)  # in a core's cache
        play = functools.partial(self._play, params, held)
        batch, value, reward, log_det = _mapped(play, rows, keys[:, :2])
        metrics = {
            "rewards": reward.ravel(),
            "reward_mean": reward.mean(),
            "reward_std": reward.std(),
            "log_det_mean": log_det.mean(),
            "explained_variance": ppo.explained_variance(batch.target, value),
        }
        after = jax.random.key_data(keys[:, 2])
        return ppo.normalised(self.config, batch), after, metrics

    def loss(
        self, params: Any, experience: Batch, update_index: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """PPO loss of whole episodes."""
        score = jax.vmap(functools.partial(self._score, params))
        scores = score(experience.observations)
        return ppo.surrogate(self.config, *scores, experience, update_index)

    def _score(
        self, params: Any, observations: RowInputs
    ) -> tuple[jax.Array, jax.Array]:
        """(T, G, M) logits and (T, G) values in reward units of a row's decisions."""
        memory = encode(self.network, params, observations.features)
        decide = functools.partial(decode, self.network, params, memory)
        scored = jax.vmap(decide)(observations.decisions)
        episodes = self.config.episodes_per_set

        def of_each(x: jax.Array) -> jax.Array:
            first = jnp.broadcast_to(x[:1], (episodes, *x.shape[1:]))
            whole = jnp.concatenate([first, x[1:]])
            return whole.reshape(-1, episodes, *x.shape[1:])

        logits, value = map(of_each, scored)
        return logits, value * self.task.value_scale

    def _play(self, params: Any, at_once: int, keys: jax.Array) -> tuple[Any, ...]:
        """From keys (2,) of the set and of the actions: a ``Batch`` of one row; its (T,
        G) values; (G,) rewards, (G,) outcomes."""
        task, network = self.task, self.network
        once = self.config.explore_once
        given = task.num_given if once else 0
        decided = task.num_decisions - network.num_unlearned  # by the network
        learned = 1 if once else decided
        start = task.reset(keys[0])
        features = network.candidate_features(start.candidates, start.available)
        memory = encode(network, params, features)

        def score(
            state: Any, count: jax.typing.ArrayLike, learns: Any
        ) -> tuple[Any, jax.Array, jax.Array]:
            decision = network.decision_features(
                features, state.chosen, state.available, count
            )
            by_network = _single(decode, network, params, memory, decision)
            by_lookahead = _single(network.lookahead_logits, decision)
            if isinstance(learns, bool):
                return decision, *(by_network if learns else by_lookahead)()
            return decision, *jax.lax.cond(learns, by_network, by_lookahead)

        def act(
            state: Any, logits: jax.Array, value: jax.Array, noise: jax.Array
        ) -> tuple[Any, Metrics]:
            action = jnp.argmax(logits + noise).astype(jnp.int32)  # of the softmax
            after, reward, _ = task.step(state, action)
            return after, {
                "action": action,
                "log_prob": jax.nn.log_softmax(logits)[action],
                "value": value * task.value_scale,
                "paid": task.paid(state),
                "reward": reward,
            }

        def decide(state: Any, now: Any) -> tuple[Any, tuple[Any, ...]]:
            count, noise = now
            learns: Any = decided > 1
            if 1 < decided < task.num_decisions:
                learns = count < decided
            score_at = functools.partial(score, count=count, learns=learns)
            decision, logits, value = _mapped(score_at, at_once, state)
            state, record = jax.vmap(act)(state, logits, value, noise)
            return state, (decision, record)

        for i in range(given):
            key_random, key_noise = jax.random.split(jax.random.fold_in(keys[0], i))
            _, logits, _ = score(start, i, True)
            random = jax.random.bernoulli(key_random, _RANDOM)
            logits = jnp.where(random & start.available, 0.0, logits)
            noise = jax.random.gumbel(key_noise, logits.shape)
            start = task.step(start, jnp.argmax(logits + noise))[0]
        number = task.num_decisions - given
        shape = number, self.config.episodes_per_set, len(start.available)
        noise = jax.random.gumbel(keys[1], shape)  # at once: compiled once
        if once:
            noise = noise.at[1:].set(0.0)
        # The first decision is the same for every episode.
        first, logits, value = score(start, given, decided > given)
        begin = jax.vmap(act, in_axes=(None, None, None, 0))
        state, record = begin(start, logits, value, noise[0])
        played = jax.tree.map(lambda leaf: leaf[None], record)
        decisions = jax.tree.map(lambda leaf: leaf[None], first)
        if len(noise) > 1:
            # One program for all; the last choices, by the look-ahead, teach nothing.
            now = jnp.arange(given + 1, task.num_decisions), noise[1:]
            state, (others, record) = jax.lax.scan(decide, state, now)
            others = jax.tree.map(lambda leaf: leaf[: max(learned - 1, 0)], others)
            decisions = jax.tree.map(_followed, decisions, others)
            played = jax.tree.map(lambda *x: jnp.concatenate(x), played, record)
        advantage, target = self._advantages_and_targets(played)
        batch = Batch(
            observations=RowInputs(features, decisions),
            action=played["action"][:learned],
            log_prob=played["log_prob"][:learned],
            advantage=advantage[:learned],
            target=target[:learned],
        )
        value, reward = played["value"][:learned], played["reward"].sum(0)
        return batch, value, reward, jax.vmap(task.outcome)(state)

    def _advantages_and_targets(self, played: Metrics) -> tuple[jax.Array, jax.Array]:
        """(K, G) each, of (K, G) values, rewards, and what was paid before."""
        # The baseline is the predicted total minus what was received before.
        rest = played["value"] - played["paid"]
        next_value = jnp.concatenate([rest[1:], jnp.zeros_like(rest[:1])])
        continues = jnp.ones_like(rest).at[-1].set(0.0)
        reward = played["reward"]
        advantage = ppo.advantages(self.config, reward, rest, next_value, continues)
        target = advantage + played["value"]
        others = self.config.episodes_per_set - 1
        if others:
            # The first decision is the same in all: the others' mean is a better one.
            baseline = (target[0].sum() - target[0]) / others
            advantage = advantage.at[0].set(target[0] - baseline)
        return advantage, target
