"""Postures and tasks under gymnax's interface: its wrappers, and loops of others."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("gymnax")
from gymnax.environments import environment, spaces
from gymnax.wrappers import gym, purerl

from jaxcal.learning import PosturesEnv, SelectionConfig
from jaxcal.learning.environments.functional import renewed

SMALL = SelectionConfig(num_candidates=8)


def task_env() -> Any:
    from jaxcal.adaptive.environment import TaskEnv
    from jaxcal.adaptive.tasks.knee import STATE_RULE, knee

    return TaskEnv(knee(cells=4, sigma=0.05, seconds=(5.0, 9.0)), STATE_RULE, 2)


def test_it_has_every_member_of_gymnax_own_environment():
    named = {name for name in dir(environment.Environment) if name[0] != "_"}
    gradients = {name for name in named if "transition_gradient" in name}
    assert named - gradients <= set(dir(PosturesEnv))


@pytest.mark.parametrize("make", [lambda: PosturesEnv(SMALL), task_env])
def test_a_state_says_whether_its_episode_has_ended(make):
    env = make()
    step, ends = jax.jit(env.step_env), 0
    for seed in range(3):
        _, state = env.reset_env(jax.random.key(seed))
        for key in jax.random.split(jax.random.key(seed), env.longest):
            assert not env.is_terminated(state) and env.discount(state) == 1.0
            action = env.available(state).argmax()
            obs, state, _, terminated, _ = step(key, state, action)
            np.testing.assert_allclose(env.get_obs(state), obs, rtol=1e-5)
            assert bool(env.is_terminal(state)) == bool(terminated)
            if terminated:
                ends += 1
                assert env.discount(state) == 0.0
                break
    assert ends == 3


def test_its_spaces_are_finite_and_hold_what_it_gives():
    env = PosturesEnv(SMALL)
    assert isinstance(env.action_space(), spaces.Discrete)
    space = env.observation_space(env.default_params)
    assert np.isfinite(space.low).all() and np.isfinite(space.high).all()
    obs, state = env.reset(jax.random.key(0))
    for action in range(6):  # a Python int
        assert bool(space.contains(obs))
        assert bool(env.state_space().contains(state))
        obs, state, *_ = env.step(jax.random.key(action), state, action)


@pytest.mark.slow
@pytest.mark.parametrize("make", [lambda: PosturesEnv(SMALL), task_env])
def test_its_wrappers_log_whole_episodes(make):
    env = make()
    logged = purerl.LogWrapper(purerl.FlattenObservationWrapper(env))
    params, ends = env.default_params, env.longest
    keys = jax.random.split(jax.random.key(0), 5)
    _, state = jax.vmap(logged.reset, in_axes=(0, None))(keys, params)
    total = jnp.zeros(5)
    for step in range(2 * ends):
        action = jax.vmap(env.available)(state.env_state).argmax(axis=1)
        keys = jax.random.split(jax.random.key(step), 5)
        obs, state, reward, terminated, truncated, info = jax.vmap(
            logged.step, in_axes=(0, 0, 0, None)
        )(keys, state, action, params)
        total += reward
        over = np.asarray(info["returned_episode"])
        np.testing.assert_array_equal(over, np.asarray(terminated | truncated))
        logs = info["returned_episode_returns"]
        np.testing.assert_allclose(logs[over], total[over], rtol=1e-6)
        total = jnp.where(over, 0.0, total)
        again = jax.vmap(env.observation)(state.env_state)
        np.testing.assert_allclose(obs, again, rtol=1e-5, atol=1e-6)
    assert bool(info["returned_episode_valid"].all())


def test_what_ended_is_in_the_info_and_parameters_cut_an_episode_off():
    env = PosturesEnv(SMALL)
    _, state = env.reset(jax.random.key(1))
    brief = env.default_params.replace(max_steps_in_episode=2)
    obs, state, _, terminated, truncated, _ = env.step(state.key, state, 0, brief)
    assert not terminated and not truncated
    before = state.candidates
    obs, state, _, terminated, truncated, info = env.step(state.key, state, 1, brief)
    assert truncated and not terminated and int(state.count) == 0
    assert bool(info["truncated"]) and info["action_mask"].all()
    np.testing.assert_array_equal(info["final_observation"][:24], before.ravel())
    assert not np.array_equal(obs[:24], before.ravel())


def test_a_batch_begins_anew_only_where_it_ended_and_then_alone():
    begun: list[Any] = []

    def begin(key):
        jax.debug.callback(lambda: begun.append(1))
        return jax.random.uniform(key, (2,))

    keys = jax.random.split(jax.random.key(0), 3)
    after = jnp.full((3, 2), 7.0)
    whole = jax.jit(jax.vmap(lambda d, k, a: renewed(begin, d, k, a)))
    out = whole(jnp.zeros(3, bool), keys, after)
    jax.effects_barrier()
    assert not begun and (out == 7.0).all()
    out = whole(jnp.array([False, True, False]), keys, after)
    jax.effects_barrier()
    assert begun and (out[0] == 7.0).all() and (out[2] == 7.0).all()
    np.testing.assert_array_equal(out[1], jax.random.uniform(keys[1], (2,)))


@pytest.mark.slow
def test_its_adapters_to_gymnasium_take_it():
    single = gym.GymnaxToGymWrapper(PosturesEnv(SMALL))
    obs, _ = single.reset(seed=0)
    assert obs in single.observation_space
    many = gym.GymnaxToVectorGymWrapper(PosturesEnv(SMALL), num_envs=3)
    many.reset(seed=0)
    assert many.step(np.zeros(3, int))[0].shape == (3, many.observation_space.shape[1])


@pytest.mark.slow
def test_a_training_of_rejax_learns():
    rejax = pytest.importorskip("rejax", reason="the extra loops is not installed")

    class FiveValues(purerl.GymnaxWrapper):
        """What rejax 0.1.3 was written for: one flag of the end."""

        def __getattr__(self, name):
            if name == "_env" or name.startswith("__"):  # while it is copied
                raise AttributeError(name)
            return getattr(self._env, name)

        def step(self, *args):
            obs, state, reward, terminated, truncated, info = self._env.step(*args)
            return obs, state, reward, terminated | truncated, info

    config = {
        "total_timesteps": 100_000, "eval_freq": 100_000, "num_envs": 256,
        "num_steps": 4, "num_minibatches": 8, "gamma": 1.0, "learning_rate": 1e-3,
    }  # fmt: skip
    algo = rejax.PPO.create(env=FiveValues(PosturesEnv(SMALL)), **config)
    _, (lengths, returns) = jax.jit(algo.train)(jax.random.key(0))
    assert (lengths == 4).all()
    assert returns[-1].mean() > returns[0].mean() + 0.3
