"""The run that trains a policy of postures: its validation, and its warm start.

That is imitation: a lesson is a batch of candidate sets with the postures that a
teacher, such as the exact solver, would choose. The loss of a decision is minus the log
of the probability that the policy gives to *any* of the wanted ones that is not chosen
yet; that of the largest logit is then chosen. Where postures are given, the wanted are
those and their best completion.
"""

from __future__ import annotations

import dataclasses
import functools
import pathlib
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from jaxcal.learning.core.network import (
    Network,
    build,
    decode,
    encode,
    log_softmax,
    mask_logits,
)
from jaxcal.learning.core.postures import Postures
from jaxcal.learning.core.ppo import Learner, Metrics, TrainState
from jaxcal.learning.policies import scorer
from jaxcal.learning.training import checkpoint
from jaxcal.learning.training.presets import TrainConfig
from jaxcal.learning.training.run import Recipe, run

MEASURED = ("ratio_to_exact", "hit_rate")


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
    given: jax.Array  # (B, T) int32; the first `length` are chosen beforehand
    length: jax.Array  # (B,) int32, how many are given
    wanted: jax.Array  # (B, M) bool, the given and the teacher's
    best: jax.Array  # (B,) float32 log det(Z.T Z) of the wanted


def draw(learner: Postures, teacher: Teacher, key: jax.Array) -> Lesson:
    """A lesson of ``episodes_per_update`` sets, determined by the key."""
    task: Any = learner.task  # an ``environments.Task``
    num_sets = learner.config.episodes_per_update
    key_sets, key_share, key_length, key_given = jax.random.split(key, 4)
    points, free = map(np.asarray, _drawn(key_sets, num_sets, task))
    learned = task.num_decisions - learner.network.num_unlearned
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
def _drawn(key: jax.Array, num_sets: int, task: Any) -> tuple[jax.Array, jax.Array]:
    sets = jax.vmap(task.reset)(jax.random.split(key, num_sets))
    return sets.candidates, sets.available


@struct.dataclass
class Attempt:
    """A lesson as played by the policy: B sets, T learned decisions."""

    features: Any  # leaves (B, ...): of the candidate sets
    decisions: Any  # leaves (B, T, ...): of the decisions
    wanted: jax.Array  # (B, T, M) bool, the wanted that are not chosen yet
    weight: jax.Array  # (B, T) 0 where the choice is given; mean 1
    best: jax.Array  # (B,) log det(Z.T Z) of what is wanted


@dataclasses.dataclass(frozen=True)
class Imitation(Postures):
    """The learner of what a teacher chooses; it is given a ``Lesson``."""

    def rollout(  # type: ignore[override]  # of a lesson
        self, params: Any, rollout_state: Any, lesson: Lesson
    ) -> tuple[Attempt, Any, Metrics]:
        """Play the lesson: each choice is the policy's likeliest wanted posture."""
        task, network = self.task, self.network
        features = network.candidate_features(lesson.candidates, lesson.available)
        memory = encode(network, params, features)
        m, learned = lesson.available.shape[-1], task.num_decisions
        learned -= network.num_unlearned

        def decide(state: Any, count: jax.Array) -> tuple[Any, tuple[Any, ...]]:
            chosen, free, wanted = state
            seen = network.decision_features(features, chosen, free, count)
            logits, _ = decode(network, params, memory, seen)
            likeliest = jnp.argmax(mask_logits(logits, wanted), axis=-1)
            given = jax.lax.dynamic_index_in_dim(lesson.given, count, 1, keepdims=False)
            action = jnp.where(count < lesson.length, given, likeliest)
            chosen = chosen.at[:, count].set(action.astype(jnp.int32))
            taken = jax.nn.one_hot(action, m, dtype=bool)
            after = chosen, free & ~taken, wanted & ~taken
            return after, (seen, wanted, count >= lesson.length)

        chosen = jnp.full((len(lesson.best), task.num_decisions), -1, jnp.int32)
        begun = chosen, lesson.available, lesson.wanted
        _, played = jax.lax.scan(decide, begun, jnp.arange(learned))
        decisions, wanted, counts = jax.tree.map(lambda x: x.swapaxes(0, 1), played)
        counted = counts.astype(memory.dtype)
        attempt = Attempt(
            features=features,
            decisions=decisions,
            wanted=wanted,
            weight=counted / jnp.maximum(counted.mean(), 1e-6),
            best=lesson.best,
        )
        return attempt, rollout_state, {}

    def loss(  # type: ignore[override]  # of an attempt
        self, params: Any, experience: Attempt, update_index: jax.Array
    ) -> tuple[jax.Array, Metrics]:
        """Cross-entropy to the wanted postures, and the value's error; metrics are
        named as those of PPO."""
        attempt, config, network = experience, self.config, self.network
        memory = encode(network, params, attempt.features)
        decide = functools.partial(decode, network, params, memory)
        of_each = jax.vmap(decide, in_axes=1, out_axes=1)
        logits, value = of_each(attempt.decisions)  # (B, T, M), (B, T)
        log_probs = log_softmax(logits)
        wanted_log_probs = mask_logits(log_probs, attempt.wanted)

        def mean(array: jax.Array) -> jax.Array:
            return (array * attempt.weight).mean()

        error = self.task.value_scale * (value - attempt.best[:, None])
        square = 2.0 * optax.losses.huber_loss(error, delta=config.value_error_limit)
        metrics = {
            "policy_loss": -mean(jax.nn.logsumexp(wanted_log_probs, axis=-1)),
            "value_loss": mean(square),
            "entropy": mean(-(jnp.exp(log_probs) * log_probs).sum(-1)),
        }
        value_loss = config.value_coefficient * metrics["value_loss"]
        return metrics["policy_loss"] + value_loss, metrics


@dataclasses.dataclass(frozen=True)
class Validation:
    """Fixed candidate sets with their proven optimum."""

    candidates: np.ndarray  # (B, M, n)
    best: np.ndarray  # (B,) log det(Z.T Z) of the optimum
    num_outputs: int
    available: np.ndarray | None = None  # (B, M) bool; all when None

    def measure(self, network: Network, params: Any, k: int) -> tuple[float, float]:
        """Mean det S / det S* and the share of optima hit, by greedy decoding."""
        candidates, free = np.asarray(self.candidates, np.float32), self.available
        free = np.ones(candidates.shape[:2], bool) if free is None else free
        indices = scorer.choose(network, params, candidates, free, k=k)
        gap = np.asarray(scorer.log_det_of(candidates, indices)) - self.best
        # float32 values against a float64 optimum: equal to a few units in the last
        # place counts as hit; evaluate.py compares in float64.
        ratio = np.exp(self.num_outputs * np.minimum(gap, 0.0))
        return float(ratio.mean()), float((gap > -2e-5).mean())


def train(
    config: TrainConfig,
    folder: str | pathlib.Path,
    *,
    validation: Validation | None = None,
    teacher: Teacher | None = None,
    num_updates: int | None = None,
    **rest: Any,
) -> TrainState:
    """Train until the budget is spent or ``should_stop`` says so, and save: the last
    state; with several seeds each leaf has a leading axis of them. In a job of several
    processes the first alone touches ``folder``, validates and reports.

    Args:
        config: the run.
        folder: of the run; made where missing.
        validation: fixed sets to measure the averaged weights on.
        teacher: imitated by the first ``config.num_imitated`` updates.
        num_updates: stop after this update instead of at the end of the budget.
        rest: ``num_devices``, ``resume``, ``report`` and ``should_stop`` of
            ``training.run.run``.
    """
    learners = config.learners
    network, k = build(config.network), config.tasks[0].num_decisions
    last = config.ppo.num_updates if num_updates is None else num_updates
    imitated = min(config.num_imitated, last)
    if teacher is None and imitated:
        raise ValueError(f"teacher is missing: {imitated} updates imitate it")
    unlearned = network.num_unlearned
    if (fewest := min(task.num_decisions for task in config.tasks)) <= unlearned:
        raise ValueError(
            f"num_selected must be at least {unlearned + 1}, got {fewest}: the "
            f"look-ahead makes the last {unlearned} choices, so nothing remains to be "
            "learned"
        )

    def lesson(index: int) -> Lesson:
        assert teacher is not None  # checked above
        # The third key; ``ppo.begin`` uses the first two, for weights and updates.
        key = jax.random.split(jax.random.key(config.seed), 3)[2]
        learner = learners[index % len(learners)]
        return draw(learner, teacher, jax.random.fold_in(key, index))

    def imitate(index: int) -> tuple[Learner, Lesson]:
        learner = learners[index % len(learners)]
        imitation = Imitation(learner.config, learner.task, learner.network)
        for i in range(index, min(index + 2, imitated)):  # the next during this update
            if i not in lessons:
                lessons[i] = pool.submit(lesson, i)
        return imitation, lessons.pop(index).result()

    validate = None
    if validation is not None:
        validate = functools.partial(validation.measure, network, k=k)
    recipe = Recipe(
        config=config,
        given=(),
        schema=checkpoint.SCHEMA,
        columns=("reward_std", "log_det_mean"),
        measured=MEASURED,
        validate=validate,
        num_imitated=imitated,
        imitate=imitate,
    )
    pool, lessons = ThreadPoolExecutor(1), dict[int, Future[Lesson]]()
    try:
        return run(recipe, folder, num_updates=last, **rest)
    finally:  # without waiting for a lesson in preparation
        pool.shutdown(wait=False, cancel_futures=True)
