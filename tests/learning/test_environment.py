"""The environment: rules, reward, masks and the paper's observation."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.information import regression
from jaxcal.learning.environments import selection as environment
from jaxcal.learning.environments.selection import SelectionConfig

# One program each: op by op they would be hundreds.
step = jax.jit(environment.step, static_argnames="config")
reset = jax.jit(environment.reset, static_argnames="config")
observe = jax.jit(environment.observe, static_argnames="config")


def play(config, state, actions):
    rewards, dones = [], []
    for action in actions:
        state, reward, done = step(state, jnp.int32(action), config)
        rewards.append(float(reward))
        dones.append(bool(done))
    return state, rewards, dones


def test_reward_is_log_det_of_the_full_12x12_after_the_fourth_choice(key):
    config = SelectionConfig()
    state = reset(key, config)
    picks = [3, 17, 29, 41]
    final, rewards, dones = play(config, state, picks)
    chosen = np.asarray(state.candidates, np.float64)[picks]
    matrix = np.kron(np.c_[chosen, np.ones(4)], np.eye(3))
    expected = np.linalg.slogdet(matrix.T @ matrix)[1] / 10
    assert rewards[:3] == [0.0, 0.0, 0.0]
    assert rewards[3] == pytest.approx(expected, abs=1e-4)
    assert dones == [False, False, False, True]
    assert final.chosen.tolist() == picks


def test_reward_comes_after_every_fourth_choice_and_at_the_end(key):
    config = SelectionConfig(num_candidates=20, num_selected=10)
    state = reset(key, config)
    _, rewards, _ = play(config, state, range(10))
    assert [i for i, reward in enumerate(rewards) if reward != 0.0] == [3, 7, 9]
    points = np.asarray(state.candidates)
    for count in (4, 8, 10):
        expected = regression.log_det_information(points[:count]) / 10
        assert rewards[count - 1] == pytest.approx(expected, abs=1e-4)


def test_paying_the_gain_adds_up_to_the_final_log_det(key):
    config = SelectionConfig(num_candidates=20, num_selected=10, reward_gain=True)
    state = reset(key, config)
    _, rewards, _ = play(config, state, range(10))
    expected = regression.log_det_information(np.asarray(state.candidates)[:10]) / 10
    assert sum(rewards) == pytest.approx(expected, abs=1e-4)


def test_step_never_offers_a_chosen_posture_again(key):
    config = SelectionConfig(num_candidates=9, num_selected=5)
    state = reset(key, config)
    for action in (4, 0, 8, 2, 6):
        assert bool(state.available[action])
        state, _, _ = step(state, jnp.int32(action), config)
        assert not bool(state.available[action])
    assert int(state.available.sum()) == 4


def test_every_episode_draws_fresh_candidates(key):
    config = SelectionConfig()
    seen = set()
    state = reset(key, config)
    reset_again = jax.jit(environment.reset, static_argnames="config")
    for _ in range(20):
        seen.add(float(state.candidates[0, 0]))
        state = reset_again(state.key, config)
    assert len(seen) == 20


def test_the_observation_is_the_papers_210_numbers(key):
    config = SelectionConfig()
    state = reset(key, config)
    assert config.observation_size == 210
    before = observe(state, config)
    assert before.shape == (210,)
    assert np.asarray(before[200:206]).tolist() == [0.0] * 6
    state, *_ = play(config, state, [5, 9])
    after = np.asarray(observe(state, config))
    points = np.asarray(state.candidates)
    np.testing.assert_array_equal(after[:150], points.ravel())
    np.testing.assert_array_equal(after[150:200], np.asarray(state.available, float))
    np.testing.assert_allclose(after[200:203], points[[5, 9]].mean(0), atol=1e-6)
    np.testing.assert_allclose(after[203:206], points[[5, 9]].std(0), atol=1e-6)
    assert after[206] == pytest.approx(0.5)
    z = np.c_[points[[5, 9]], np.ones(2)]
    gram = z.T @ z + 0.01 * np.eye(4)
    assert after[207] == pytest.approx(np.linalg.slogdet(gram)[1] / 10, abs=1e-4)
    assert after[208] == pytest.approx(np.trace(gram) / 16, abs=1e-5)


def test_thousands_of_episodes_step_at_once_and_compile_once(key):
    config = SelectionConfig()
    traces = 0

    def counted(state, action):
        nonlocal traces
        traces += 1
        return environment.step(state, action, config)

    batched = jax.jit(jax.vmap(counted))
    state = jax.vmap(lambda key: environment.reset(key, config))(
        jax.random.split(key, 4096)
    )
    for action in range(4):
        state, reward, done = batched(state, jnp.full(4096, action))
    assert traces == 1
    assert bool(done.all()) and bool((reward != 0).all())


def test_candidates_come_from_a_pool_once_each(key, rng):
    config = SelectionConfig(num_candidates=30)
    pool = rng.normal(size=(40, 3)).astype(np.float32)
    points, _ = environment.given(config, pool[None])(key)
    rows = {tuple(row) for row in np.asarray(points)}
    assert len(rows) == 30 and rows <= {tuple(row) for row in pool}


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"num_selected": 3}, "num_selected"),
        ({"num_selected": 50}, "num_selected"),
        ({"num_inputs": 0}, "num_inputs"),
        ({"reward_scale": 0.0}, "reward_scale"),
    ],
)
def test_a_bad_configuration_is_named(values, named):
    with pytest.raises(ValueError, match=named):
        SelectionConfig(**values)


def test_too_few_candidates_are_named():
    config = SelectionConfig()
    with pytest.raises(
        ValueError, match="num_candidates = 50 available candidates, got 10"
    ):
        environment.given(config, np.zeros((1, 10, 3)))
    free = np.ones((2, 50), bool)
    free[1, 3:] = False
    with pytest.raises(
        ValueError, match="num_selected = 4 available candidates, got 3"
    ):
        environment.given(config, np.zeros((2, 50, 3)), free)


@pytest.mark.parametrize("shape", environment.SHAPES)
def test_every_shape_is_full_rank_and_masks_as_asked(shape, key):
    config = SelectionConfig()
    draw = jax.jit(environment.mixture(config, (shape,), masked=0.3))
    for one in jax.random.split(key, 5):
        points, available = draw(one)
        kept = np.asarray(points)[np.asarray(available)]
        assert points.shape == (50, 3) and 35 <= len(kept) <= 50
        assert np.isfinite(regression.log_det_information(kept))
        if shape == "grid":
            assert len(np.unique(np.asarray(points), axis=0)) == 50


def test_unknown_shapes_are_refused():
    with pytest.raises(ValueError, match="torus"):
        environment.mixture(SelectionConfig(), ("torus",))
