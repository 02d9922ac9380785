"""Learning from a teacher that knows the best postures: the warm start before PPO.

A lesson is a batch of candidate sets with the postures that a teacher, such as the
exact solver, would choose. The loss of a decision is minus the log of the probability
that the policy gives to *any* posture of the wanted ones that is not chosen yet: their
order does not matter, and the policy's own favourite among them is chosen next.
Episodes that begin with given postures want the best completion of those.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.sharding import Mesh

from jaxcal.learning.environments import scenarios
from jaxcal.learning.policies import networks
from jaxcal.learning.policies.networks import Network
from jaxcal.learning.runtime import devices
from jaxcal.learning.training import ppo
from jaxcal.learning.training.ppo import PPOConfig, Task, TrainState

__all__ = [
    "Attempt",
    "Lesson",
    "Lessons",
    "Teacher",
    "draw",
    "follow",
    "loss",
    "update",
]

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
    config: PPOConfig, task: Task, network: Network, teacher: Teacher, index: int
) -> Lesson:
    """The lesson of update ``index``: the same whenever it is asked for."""
    env = task.environment
    num_sets = config.episodes_per_update
    key = jax.random.fold_in(jax.random.key(config.seed), index)
    key_sets, key_share, key_length, key_given = jax.random.split(key, 4)
    candidates, available = _drawn(key_sets, num_sets, task)
    learned = env.num_selected - network.num_unlearned
    begun = jax.random.uniform(key_share, (num_sets,)) < task.random_starts
    length = jax.random.randint(key_length, (num_sets,), 1, max(learned, 2))
    lengths = np.asarray(jnp.where(begun, length, 0))
    rank = jax.random.uniform(key_given, available.shape)
    order = np.asarray(jnp.argsort(jnp.where(available, rank, 2.0), axis=-1))
    given = order[:, :learned].astype(np.int32)
    points, free = np.asarray(candidates), np.asarray(available)
    wanted = np.zeros(free.shape, bool)
    best = np.zeros(num_sets, np.float32)
    for count in np.unique(lengths):
        rows = np.flatnonzero(lengths == count)
        indices, values = teacher(
            points[rows], free[rows], given[rows, :count], env.num_selected
        )
        wanted[rows[:, None], indices] = True
        best[rows] = values
    leaves = (points, free, given, lengths.astype(np.int32), wanted, best)
    return Lesson(*(jnp.asarray(leaf) for leaf in leaves))


@functools.partial(jax.jit, static_argnames=("num_sets", "task"))
def _drawn(key: jax.Array, num_sets: int, task: Task) -> tuple[jax.Array, jax.Array]:
    source = scenarios.mixture(task.environment, task.shapes, task.masked)
    return jax.vmap(source)(jax.random.split(key, num_sets))


class Lessons:
    """Lessons in order, the next one prepared while this one is learned."""

    def __init__(self, prepare: Callable[[int], Lesson], last: int) -> None:
        self._prepare, self._last = prepare, last
        self._pool = ThreadPoolExecutor(1)
        self._next: tuple[int, Future[Lesson]] | None = None

    def at(self, index: int) -> Lesson:
        """The lesson of update ``index``."""
        if self._next is None or self._next[0] != index:
            self._next = (index, self._pool.submit(self._prepare, index))
        lesson = self._next[1].result()
        if index + 1 < self._last:
            following = self._pool.submit(self._prepare, index + 1)
            self._next = (index + 1, following)
        return lesson

    def close(self) -> None:
        """Forget what was being prepared."""
        self._pool.shutdown(wait=False, cancel_futures=True)


@struct.dataclass
class Attempt:
    """Lessons followed by the policy: B sets, T learned decisions."""

    view: Any  # leaves (B, ...): the geometry of the sets
    glance: Any  # leaves (B, T, ...): the geometry of the decisions
    wanted: jax.Array  # (B, T, M) bool, what would be right
    counted: jax.Array  # (B, T) 1 where the policy has the choice, 0 where it is given
    best: jax.Array  # (B,) log det(Z.T Z) of what is wanted


def follow(lesson: Lesson, task: Task, network: Network, params: Any) -> Attempt:
    """Go through a lesson, each time choosing what the policy likes of the wanted."""
    env = task.environment
    view = network.look(lesson.candidates, lesson.available)
    memory = networks.encode(network, params, view)
    chosen = jnp.full((len(lesson.best), env.num_selected), -1, jnp.int32)
    free, wanted = lesson.available, lesson.wanted
    glances, wants, counts = [], [], []
    for count in range(env.num_selected - network.num_unlearned):
        glance = network.look_at(view, chosen, free, count)
        logits, _ = networks.decode(network, params, memory, glance)
        glances.append(glance)
        wants.append(wanted)
        counts.append((count >= lesson.length).astype(logits.dtype))
        favourite = jnp.argmax(networks.mask_logits(logits, wanted), axis=-1)
        action = jnp.where(count < lesson.length, lesson.given[:, count], favourite)
        chosen = chosen.at[:, count].set(action.astype(jnp.int32))
        taken = jax.nn.one_hot(action, env.num_candidates, dtype=bool)
        free, wanted = free & ~taken, wanted & ~taken
    return Attempt(
        view=view,
        glance=jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=1), *glances),
        wanted=jnp.stack(wants, axis=1),
        counted=jnp.stack(counts, axis=1),
        best=lesson.best,
    )


def loss(
    params: Any, attempt: Attempt, config: PPOConfig, task: Task, network: Network
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Cross-entropy to the wanted postures, and the value's error, of an attempt.

    Returns:
        The loss, and metrics named as those of ``ppo.update``.
    """
    env = task.environment
    memory = networks.encode(network, params, attempt.view)
    decode = jax.vmap(
        lambda glance: networks.decode(network, params, memory, glance),
        in_axes=1,
        out_axes=1,
    )
    logits, value = decode(attempt.glance)
    log_probs = jax.nn.log_softmax(logits)
    hopes = networks.mask_logits(log_probs, attempt.wanted)
    number = jnp.maximum(attempt.counted.sum(), 1.0)

    def mean(array: jax.Array) -> jax.Array:
        return (array * attempt.counted).sum() / number

    scale = env.reward_scale * env.num_outputs
    limit = config.value_error_limit
    error = jnp.clip(scale * (value - attempt.best[:, None]), -limit, limit)
    metrics = {
        "policy_loss": -mean(jax.nn.logsumexp(hopes, axis=-1)),
        "value_loss": mean(error**2),
        "entropy": mean(-(jnp.exp(log_probs) * log_probs).sum(-1)),
    }
    total = metrics["policy_loss"] + config.value_coefficient * metrics["value_loss"]
    return total, metrics


@functools.partial(
    jax.jit,
    static_argnames=("config", "task", "network", "mesh"),
    donate_argnames=("state",),
)
def update(
    state: TrainState,
    lesson: Lesson,
    config: PPOConfig,
    task: Task,
    network: Network,
    mesh: Mesh | None = None,
) -> tuple[TrainState, dict[str, jax.Array]]:
    """Epochs of minibatches over one lesson; see ``ppo.update``."""
    key, key_epochs = jax.random.split(state.key)
    attempt = follow(devices.by_set(lesson, mesh), task, network, state.params)
    attempt = devices.everywhere(attempt, mesh)

    def of_batch(params: Any, batch: Attempt) -> tuple[jax.Array, dict[str, jax.Array]]:
        return loss(params, batch, config, task, network)

    state, metrics = ppo.learn(state, config, attempt, of_batch, key_epochs, mesh)
    state = dataclasses.replace(state, key=key)
    return devices.everywhere((state, metrics), mesh)
