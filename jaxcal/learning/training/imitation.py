"""Learning from a teacher that knows the best postures: the warm start before PPO.

A lesson is a batch of candidate sets with the postures that a teacher, such as the
exact solver, would choose. The loss of a decision is minus the log of the probability
that the policy gives to *any* posture of the wanted ones that is not chosen yet: their
order does not matter, and the policy's own favourite among them is chosen next.
Episodes that begin with given postures want the best completion of those.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh

from jaxcal.learning.policies import networks
from jaxcal.learning.policies.networks import Network
from jaxcal.learning.training import rollout, update
from jaxcal.learning.training.config import PPOConfig
from jaxcal.learning.training.optimiser import Keys, Metrics
from jaxcal.learning.training.rules import Rules
from jaxcal.learning.training.update import Update

__all__ = ["Lesson", "Lessons", "Teacher", "draw", "follow", "loss", "updater"]

Teacher = Callable[
    [np.ndarray, np.ndarray, np.ndarray, int], tuple[np.ndarray, np.ndarray]
]
"""candidates (B, M, n), available (B, M), given (B, c), k -> indices (B, k), (B,) log
det(Z.T Z)."""


@struct.dataclass
class Lesson:
    """Candidate sets, and what a teacher chooses of them."""

    candidates: jax.Array  # (B, M, n) float32
    available: jax.Array  # (B, M) bool, given postures included
    given: jax.Array  # (B, T) int32, postures chosen beforehand, the first `length`
    length: jax.Array  # (B,) int32, how many are given
    wanted: jax.Array  # (B, M) bool, the given and the teacher's
    best: jax.Array  # (B,) float32 log det(Z.T Z) of the wanted


def draw(
    config: PPOConfig, task: Rules, network: Network, teacher: Teacher, index: int
) -> Lesson:
    """The lesson of update ``index``: the same whenever it is asked for."""
    num_sets = config.episodes_per_update
    key = jax.random.fold_in(Keys.of(config.seed).lessons, index)
    key_sets, key_share, key_length, key_given = jax.random.split(key, 4)
    points, free = map(np.asarray, _drawn(key_sets, num_sets, task))
    learned = task.num_decisions - network.num_unlearned
    begun = jax.random.uniform(key_share, (num_sets,)) < task.random_starts
    length = jax.random.randint(key_length, (num_sets,), 1, max(learned, 2))
    lengths = np.asarray(jnp.where(begun, length, 0))
    rank = jax.random.uniform(key_given, free.shape)
    order = np.asarray(jnp.argsort(jnp.where(free, rank, 2.0), axis=-1))
    given = order[:, :learned].astype(np.int32)
    wanted = np.zeros(free.shape, bool)
    best = np.zeros(num_sets, np.float32)
    for count in np.unique(lengths):
        rows = np.flatnonzero(lengths == count)
        indices, values = teacher(
            points[rows], free[rows], given[rows, :count], task.num_decisions
        )
        wanted[rows[:, None], indices] = True
        best[rows] = values
    leaves = (points, free, given, lengths.astype(np.int32), wanted, best)
    return Lesson(*(jnp.asarray(leaf) for leaf in leaves))


@functools.partial(jax.jit, static_argnames=("num_sets", "task"))
def _drawn(key: jax.Array, num_sets: int, task: Rules) -> tuple[jax.Array, jax.Array]:
    sets = rollout.draw(task, num_sets, key)
    return sets.candidates, sets.available


class Lessons:
    """Lessons ``0`` to ``last - 1``, the next prepared while this one is learned."""

    def __init__(self, prepare: Callable[[int], Lesson], last: int) -> None:
        self._prepare, self._last = prepare, last
        self._pool = ThreadPoolExecutor(1)
        self._asked: dict[int, Future[Lesson]] = {}

    def at(self, index: int) -> Lesson:
        """The lesson of update ``index``."""
        for i in range(index, min(index + 2, self._last)):
            if i not in self._asked:
                self._asked[i] = self._pool.submit(self._prepare, i)
        return self._asked.pop(index).result()

    def close(self) -> None:
        """Forget what was being prepared."""
        self._pool.shutdown(wait=False, cancel_futures=True)


@struct.dataclass
class Attempt:
    """Lessons followed by the policy: B sets, T learned decisions."""

    features: Any  # leaves (B, ...): of the candidate sets
    decisions: Any  # leaves (B, T, ...): of the decisions
    wanted: jax.Array  # (B, T, M) bool, what would be right
    counted: jax.Array  # (B, T) 1 where the policy has the choice, 0 where it is given
    best: jax.Array  # (B,) log det(Z.T Z) of what is wanted


def follow(lesson: Lesson, task: Rules, network: Network, params: Any) -> Attempt:
    """Go through a lesson, each time choosing what the policy likes of the wanted."""
    features = network.candidate_features(lesson.candidates, lesson.available)
    memory = networks.encode(network, params, features)
    chosen = jnp.full((len(lesson.best), task.num_decisions), -1, jnp.int32)
    free, wanted = lesson.available, lesson.wanted
    decisions, wants, counts = [], [], []
    for count in range(task.num_decisions - network.num_unlearned):
        seen = network.decision_features(features, chosen, free, count)
        logits, _ = networks.decode(network, params, memory, seen)
        decisions.append(seen)
        wants.append(wanted)
        counts.append((count >= lesson.length).astype(logits.dtype))
        favourite = jnp.argmax(networks.mask_logits(logits, wanted), axis=-1)
        action = jnp.where(count < lesson.length, lesson.given[:, count], favourite)
        chosen = chosen.at[:, count].set(action.astype(jnp.int32))
        taken = jax.nn.one_hot(action, free.shape[-1], dtype=bool)
        free, wanted = free & ~taken, wanted & ~taken
    return Attempt(
        features=features,
        decisions=jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=1), *decisions),
        wanted=jnp.stack(wants, axis=1),
        counted=jnp.stack(counts, axis=1),
        best=lesson.best,
    )


def loss(
    params: Any, attempt: Attempt, config: PPOConfig, task: Rules, network: Network
) -> tuple[jax.Array, Metrics]:
    """Cross-entropy to the wanted postures, and the value's error, of an attempt.

    Returns:
        The loss, and metrics named as those of PPO.
    """
    memory = networks.encode(network, params, attempt.features)
    # (B, T, M), (B, T)
    logits, value = networks.decode(network, params, memory, attempt.decisions, axes=1)
    log_probs = jax.nn.log_softmax(logits)
    hopes = networks.mask_logits(log_probs, attempt.wanted)
    number = jnp.maximum(attempt.counted.sum(), 1.0)

    def mean(array: jax.Array) -> jax.Array:
        return (array * attempt.counted).sum() / number

    limit = config.value_error_limit
    error = task.value_scale * (value - attempt.best[:, None])
    metrics = {
        "policy_loss": -mean(jax.nn.logsumexp(hopes, axis=-1)),
        "value_loss": mean(jnp.clip(error, -limit, limit) ** 2),
        "entropy": mean(-(jnp.exp(log_probs) * log_probs).sum(-1)),
    }
    total = metrics["policy_loss"] + config.value_coefficient * metrics["value_loss"]
    return total, metrics


@functools.lru_cache(maxsize=32)
def updater(
    config: PPOConfig, task: Rules, network: Network, mesh: Mesh | None = None
) -> Update:
    """An update: state, given up, and a ``Lesson`` -> the next state and metrics."""

    def gather(params: Any, lesson: Lesson, key: jax.Array) -> tuple[Attempt, Metrics]:
        return follow(lesson, task, network, params), {}

    return update.jitted(
        config,
        mesh,
        draw=lambda key, lesson: lesson,
        gather=gather,
        loss=lambda params, batch, done: loss(params, batch, config, task, network),
    )
