"""Environments for loops of one's own: resets, masks, and what they pay."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.adaptive.environment import TaskEnv
from jaxcal.adaptive.rules import Gain
from jaxcal.adaptive.tasks.knee import STATE_RULE, knee
from jaxcal.learning import PosturesEnv
from jaxcal.learning.environments.functional import renewed
from jaxcal.learning.environments.selection import SelectionConfig


def play(env, batch, steps, seed=0):
    """Observations, masks before, actions, rewards, done of a random policy, (S, B)."""
    key = jax.random.key(seed)
    obs, state = jax.jit(jax.vmap(env.reset))(jax.random.split(key, batch))
    mask = jax.vmap(env.available)(state)
    step = jax.jit(jax.vmap(env.step))
    kept = []
    for _ in range(steps):
        key, key_action, key_step = jax.random.split(key, 3)
        action = jax.random.categorical(key_action, jnp.where(mask, 0.0, -1e9))
        before = np.asarray(obs), np.asarray(mask), np.asarray(action)
        obs, state, reward, done, _, info = step(
            jax.random.split(key_step, batch), state, action
        )
        mask = info["action_mask"]
        kept.append((*before, np.asarray(reward), np.asarray(done), info))
    return kept


def test_postures_pay_the_log_det_of_what_is_chosen_and_begin_anew():
    env = PosturesEnv(SelectionConfig(num_candidates=9))
    assert env.num_actions == 9 and env.observation_size == 4 * 9 + 10
    kept = play(env, 3, 8)
    assert [bool(row[4].all()) for row in kept] == [False] * 3 + [True] + [
        False
    ] * 3 + [True]
    for first in (0, 4):
        for episode in range(3):
            sets = kept[first][0][episode, :27].reshape(9, 3).astype(np.float64)
            chosen = [kept[first + t][2][episode] for t in range(4)]
            assert len(set(chosen)) == 4
            z = np.column_stack([sets[chosen], np.ones(4)])
            paid = 0.3 * np.linalg.slogdet(z.T @ z)[1]
            assert kept[first + 3][3][episode] == pytest.approx(paid, abs=1e-3)
            last = kept[first + 3][5]
            assert last["log_det"][episode] == pytest.approx(10 * paid, abs=1e-2)
            assert last["action_mask"][episode].all()  # of the episode that begins
    assert not np.array_equal(kept[0][0], kept[4][0])


@pytest.mark.parametrize("maps", [0, 1, 2, 3])
def test_nothing_begins_while_none_is_done_under_any_number_of_maps(maps):
    begun = []

    def begin(key):
        jax.debug.callback(begun.append, jnp.zeros(()))
        return {"a": jax.random.uniform(key), "b": jax.random.uniform(key, (2, 3))}

    shape = (2, 3, 4)[:maps]
    keys = jax.random.split(jax.random.key(0), shape)
    after = {"a": jnp.full(shape, 7.0), "b": jnp.full((*shape, 2, 3), 8.0)}
    step = functools.partial(renewed, begin)
    fresh = begin
    for _ in shape:
        step, fresh = jax.vmap(step), jax.vmap(fresh)
    fresh = fresh(keys)
    for done in (np.zeros(shape, bool), np.arange(np.prod(shape)).reshape(shape) == 0):
        begun.clear()
        out = jax.block_until_ready(jax.jit(step)(done, keys, after))
        jax.effects_barrier()
        assert bool(begun) == done.any()
        for name, leaf in out.items():
            over = np.expand_dims(done, tuple(range(maps, leaf.ndim)))
            np.testing.assert_array_equal(
                leaf, np.where(over, fresh[name], after[name])
            )


def test_a_rule_without_a_price_is_refused():
    with pytest.raises(ValueError, match=r"^base must be a rule with a price.*Gain$"):
        TaskEnv(knee(cells=4), Gain())


@pytest.mark.slow
def test_sessions_of_a_task_end_and_begin_anew():
    env = TaskEnv(knee(cells=4, sigma=0.05, seconds=(5.0, 9.0)), STATE_RULE, 2)
    kept = play(env, 4, 12)
    assert kept[0][0].shape == (4, env.observation_size)
    assert all(mask[np.arange(4), action].all() for _, mask, action, *_ in kept)
    rewards = np.stack([row[3] for row in kept])
    assert (rewards >= -1e-6).all() and rewards.max() > 0.01
    assert np.stack([row[4] for row in kept]).any()
    assert {"action_mask", "gain", "final_observation"} <= kept[0][5].keys()
