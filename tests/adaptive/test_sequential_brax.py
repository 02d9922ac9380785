"""A task of sequential measurement under brax's wrappers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.adaptive.tasks.knee import STATE_RULE, knee

pytest.importorskip("brax")
from jaxcal.adaptive.brax_env import SequentialEnv
from jaxcal.learning.brax import wrap_fresh

SMALL = {"cells": 4, "sigma": 0.05, "seconds": (5.0, 9.0)}


@pytest.mark.slow
def test_the_adapter_plays_sessions_and_draws_new_ones():
    task = knee(**SMALL)
    with jax.numpy_rank_promotion("allow"):
        env = wrap_fresh(SequentialEnv(task, STATE_RULE, 2), task.horizon, 1)
        state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(1), 8))
        assert state.obs.shape == (8, env.observation_size)
        step = jax.jit(env.step)
        begun, ended = set(), 0
        for _ in range(12):
            session = state.pipeline_state.session
            new = np.asarray(session.made) == 0
            begun |= set(np.asarray(session.seconds)[new].tolist())
            before = np.asarray(state.pipeline_state.belief.weights)
            state = step(state, jnp.zeros(8, jnp.int32))
            done = np.asarray(state.done) > 0
            after = np.asarray(state.pipeline_state.belief.weights)
            prior = np.broadcast_to(np.asarray(task.prior), after.shape)
            np.testing.assert_array_equal(after[done], prior[done])
            # 0 where a joint is known to float32's last digit.
            reward = np.asarray(state.reward)
            assert (reward >= 0.0).all() and reward.max() > 0.01
            changed = np.abs(after - before).max(axis=1) > 0.0
            assert changed[~done].all()
            ended += int(done.sum())
        # Every session that began had a budget of its own.
        assert ended >= 8 and len(begun) == 8 + ended - int(done.sum())
