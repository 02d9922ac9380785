"""Imitation: what a lesson holds, its loss against numpy, that it teaches, resuming."""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.learning.config import EpisodesConfig, NetworkConfig
from jaxcal.learning.core import network as networks
from jaxcal.learning.core import ppo
from jaxcal.learning.core.network import build
from jaxcal.learning.core.postures import Postures
from jaxcal.learning.environments.selection import SelectionConfig
from jaxcal.learning.environments.task import Task
from jaxcal.learning.training import postures as imitation
from jaxcal.learning.training import postures as training
from jaxcal.learning.training.presets import TrainConfig
from jaxcal.learning.training.run import compiled_update

PPO = EpisodesConfig(
    num_episodes=64 * 4,
    episodes_per_update=64,
    episodes_per_set=4,
    num_minibatches=2,
    warmup_updates=1,
)
TASK = Task(
    SelectionConfig(11, 5, 1, 1, reward_gain=True),
    masked=0.3,
    random_starts=0.5,
)
NETWORK = build(NetworkConfig(width=8, encoder_rounds=1))
LEARNER = Postures(PPO, TASK, NETWORK)
CONFIG = TrainConfig(
    network=NetworkConfig(width=8, encoder_rounds=1),
    ppo=PPO,
    tasks=(TASK,),
    imitation=0.5,
    seed=3,
)


def key_of(index):
    """The key of a lesson, as a run derives it."""
    return jax.random.fold_in(jax.random.split(jax.random.key(3), 3)[2], index)


def brute_force(candidates, available, given, k):
    """The best completion of the given postures, by trying them all."""
    indices, best = [], []
    for points, free, begun in zip(candidates, available, given, strict=True):
        z = np.column_stack([points.astype(float), np.ones(len(points))])
        rest = [i for i in np.flatnonzero(free) if i not in set(begun)]
        tries = [
            [*begun, *more] for more in itertools.combinations(rest, k - len(begun))
        ]
        values = [np.linalg.slogdet(z[t].T @ z[t])[1] for t in tries]
        indices.append(tries[int(np.argmax(values))])
        best.append(max(values))
    return np.array(indices), np.array(best)


@pytest.fixture(scope="module")
def lesson():
    return imitation.draw(LEARNER, brute_force, key_of(5))


def test_a_lesson_holds_the_best_completion_of_what_is_given(lesson):
    lengths = np.asarray(lesson.length)
    assert set(lengths) == {
        0,
        1,
        2,
    }  # three decisions are learned, one at least is left
    for row in range(len(lengths)):
        given = set(np.asarray(lesson.given)[row, : lengths[row]].tolist())
        wanted = set(np.flatnonzero(lesson.wanted[row]).tolist())
        assert len(given) == lengths[row]
        assert given <= wanted <= set(np.flatnonzero(lesson.available[row]).tolist())
        assert len(wanted) == 5
        z = np.column_stack([np.asarray(lesson.candidates[row], float), np.ones(11)])
        chosen = z[sorted(wanted)]
        value = np.linalg.slogdet(chosen.T @ chosen)[1]
        assert abs(value - float(lesson.best[row])) < 1e-5


def test_a_lesson_is_the_same_whenever_it_is_asked_for(lesson):
    again = imitation.draw(LEARNER, brute_force, key_of(5))
    other = imitation.draw(LEARNER, brute_force, key_of(6))
    for one, two in zip(jax.tree.leaves(lesson), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, two)
    assert not np.array_equal(lesson.candidates, other.candidates)


@pytest.mark.slow
def test_lessons_share_no_key_with_the_weights_and_the_updates():
    # In JAX 0.10 fold_in(key, i) is split(key)[i]: streams must be split apart first.
    key = jax.random.key(3)
    np.testing.assert_array_equal(
        jax.random.key_data(jax.random.split(key)[1]),
        jax.random.key_data(jax.random.fold_in(key, 1)),
    )
    weights, updates, _ = jax.random.split(key, 3)
    begun = jax.jit(lambda key: ppo.begin(PPO, LEARNER, key))(key)
    order, rows = jax.random.split(updates)
    assert np.array_equal(begun.key, jax.random.key_data(order))
    for index in range(3):
        drawn = imitation.draw(LEARNER, brute_force, key_of(index))
        for used in (weights, updates, order, rows):
            sets, _ = imitation._drawn(jax.random.split(used, 4)[0], 64, TASK)
            assert not np.array_equal(sets, drawn.candidates)


@jax.jit
def measured(params, lesson):
    learner = imitation.Imitation(*vars(LEARNER).values())
    keys = jax.random.split(jax.random.key(0), len(lesson.best))
    attempt, _, _ = learner.rollout(params, learner.begin(keys, lesson), lesson)
    return learner.loss(params, attempt, jnp.int32(0))


class Infinite(type(NETWORK)):
    """The network, masked by minus infinity."""

    def decode(self, memory, decision):
        logits, value = super().decode(memory, decision)
        return jnp.where(logits <= -1e9, -jnp.inf, logits), value


def test_a_mask_of_minus_infinity_is_taken(lesson):
    params = LEARNER.init(jax.random.key(1))
    keys = jax.random.split(jax.random.key(0), len(lesson.best))

    def of(network):
        learner = imitation.Imitation(PPO, TASK, network)

        @jax.jit
        def gradients(params):
            attempt, _, _ = learner.rollout(params, learner.begin(keys, lesson), lesson)
            return jax.grad(learner.loss, has_aux=True)(params, attempt, jnp.int32(0))

        return gradients(params)

    found = of(Infinite(NETWORK.config))
    assert np.isfinite(found[1]["entropy"])
    for one, other in zip(*map(jax.tree.leaves, (of(NETWORK), found)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_the_loss_is_that_of_the_definition(lesson):
    params = LEARNER.init(jax.random.key(1))  # with key 0 two logits are a tie
    total, metrics = measured(params, lesson)
    features = NETWORK.candidate_features(lesson.candidates, lesson.available)
    memory = networks.encode(NETWORK, params, features)
    surprise, error, number = 0.0, 0.0, 0
    chosen = np.full((64, 5), -1)
    free, wanted = np.array(lesson.available), np.array(lesson.wanted)
    rows = np.arange(64)
    for count in range(3):
        decision = NETWORK.decision_features(
            features, jnp.asarray(chosen), jnp.asarray(free), count
        )
        logits, value = networks.decode(NETWORK, params, memory, decision)
        weights = np.exp(np.asarray(logits, float))
        share = weights / weights.sum(-1, keepdims=True)
        counted = count >= np.asarray(lesson.length)
        surprise -= np.log((share * wanted).sum(-1))[counted].sum()
        gap = 0.1 * (np.asarray(value) - np.asarray(lesson.best))
        error += (gap**2)[counted].sum()
        number += counted.sum()
        best = (share * wanted).argmax(-1)
        action = np.where(counted, best, np.asarray(lesson.given)[:, count])
        chosen[:, count] = action
        free[rows, action] = wanted[rows, action] = False
    np.testing.assert_allclose(metrics["policy_loss"], surprise / number, rtol=1e-4)
    np.testing.assert_allclose(metrics["value_loss"], error / number, rtol=1e-3)
    np.testing.assert_allclose(
        total, (surprise + PPO.value_coefficient * error) / number, rtol=1e-3
    )


@pytest.mark.slow
def test_the_order_of_the_candidates_does_not_matter(lesson, rng):
    params = LEARNER.init(jax.random.key(0))
    order = rng.permutation(11)
    where = np.argsort(order)
    turned = dataclasses.replace(
        lesson,
        candidates=lesson.candidates[:, order],
        available=lesson.available[:, order],
        wanted=lesson.wanted[:, order],
        given=jnp.asarray(where)[lesson.given],
    )
    one, _ = measured(params, lesson)
    two, _ = measured(params, turned)
    np.testing.assert_allclose(one, two, rtol=1e-4)


@pytest.mark.slow
def test_lessons_teach():
    config = dataclasses.replace(PPO, num_episodes=64 * 40, learning_rate=5e-3)
    # Without the look-ahead it has to be learned what to choose.
    network = build(NetworkConfig(width=8, encoder_rounds=1, lookahead=1))
    learner = Postures(config, Task(SelectionConfig(num_candidates=8)), network)
    state = ppo.begin(config, learner, jax.random.key(3))
    update = compiled_update(config, imitation.Imitation(*vars(learner).values()))
    losses = []
    for index in range(config.num_updates):
        shown = imitation.draw(learner, brute_force, key_of(index))
        state, metrics = update(state, shown)
        losses.append(float(metrics["policy_loss"]))
    assert np.mean(losses[-5:]) < 0.85 * np.mean(losses[:5])


@pytest.mark.slow
def test_resume_across_the_end_of_imitation_is_bit_for_bit(tmp_path):
    whole = training.train(CONFIG, tmp_path / "whole", teacher=brute_force)
    for last in (1, 3, 4):
        parts = training.train(
            CONFIG,
            tmp_path / "parts",
            resume=last > 1,
            num_updates=last,
            teacher=brute_force,
        )
    for one, two in zip(
        jax.tree.leaves(whole),
        jax.tree.leaves(parts),
        strict=True,
    ):
        np.testing.assert_array_equal(np.asarray(one), np.asarray(two))


def test_a_missing_teacher_is_told(tmp_path):
    with pytest.raises(ValueError, match=r"teacher is missing: 2 updates"):
        training.train(CONFIG, tmp_path)
