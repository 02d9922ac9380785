"""The mission in one file equals the product's functions, number for number."""

from __future__ import annotations

import ast
import dataclasses
import pathlib
import sys

import jax
import jax.numpy as jnp
import mission
import numpy as np
import pytest

import jaxcal
from jaxcal.learning.config import EpisodesConfig
from jaxcal.learning.core import ppo
from jaxcal.learning.environments import selection

ROOT = pathlib.Path(__file__).parents[2]

SIZES = selection.SelectionConfig()


@pytest.fixture(autouse=True)
def plain_broadcasting():
    """The file is written as NumPy's users write."""
    with jax.numpy_rank_promotion("allow"):
        yield


def test_it_is_short_and_imports_what_it_says():
    text = (ROOT / "examples" / "mission.py").read_text()
    assert len(text.splitlines()) <= 300
    tree = ast.parse(text)
    named = {
        *(a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names),
        *(n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)),
    }
    others = {name.partition(".")[0] for name in named} - sys.stdlib_module_names
    assert others == {"flax", "jax", "numpy", "optax", "pymodbus"}


def test_its_episodes_are_those_of_the_environment(rng):
    ours = jax.vmap(mission.reset)(jax.random.split(jax.random.key(0), 20))
    every = jnp.ones(mission.M, bool)
    theirs = jax.vmap(lambda poses, key: selection.start(poses, every, SIZES, key))(
        ours.poses, jax.random.split(jax.random.key(1), 20)
    )
    look = jax.vmap(lambda state: selection.observe(state, SIZES))
    step = jax.vmap(lambda state, action: selection.step(state, action, SIZES))
    for _ in range(mission.K):
        np.testing.assert_allclose(
            jax.vmap(mission.observe)(ours), look(theirs), atol=2e-5
        )
        action = jnp.asarray([rng.choice(np.flatnonzero(a)) for a in ours.available])
        ours, paid, over = jax.vmap(mission.step)(ours, action)
        theirs, reward, done = step(theirs, action)
        np.testing.assert_allclose(paid, reward, rtol=1e-4, atol=1e-4)
        np.testing.assert_array_equal(over, done)
        np.testing.assert_array_equal(ours.available, theirs.available)
    z = np.c_[ours.poses[0][ours.chosen[0]], np.ones(4)].astype(np.float64)
    log_det = 3 * np.linalg.slogdet(z.T @ z)[1]
    assert paid[0] == pytest.approx(0.1 * log_det, abs=1e-3)


def test_its_advantages_and_its_loss_are_those_of_ppo(rng):
    config = dataclasses.replace(
        EpisodesConfig(), discount=1.0, gae_lambda=mission.LAMBDA,
        clip_range=mission.CLIP, value_coefficient=mission.VALUE_WEIGHT,
        entropy_start=mission.ENTROPY_WEIGHT, entropy_end=mission.ENTROPY_WEIGHT,
        value_error_limit=1e6,
    )  # fmt: skip
    reward, value = jnp.asarray(rng.normal(size=(2, mission.K, 7)), jnp.float32)
    later = jnp.concatenate([value[1:], jnp.zeros_like(value[:1])])
    ends = jnp.ones_like(value).at[-1].set(0.0)
    found = mission.advantages(reward, value)
    wanted = ppo.advantages(config, reward, value, later, ends)
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)

    logits = jnp.asarray(rng.normal(size=(6, 2, 5)), jnp.float32)
    value, target, advantage = jnp.asarray(rng.normal(size=(3, 6, 2)), jnp.float32)
    action = jnp.asarray(rng.integers(5, size=(6, 2)))
    before = -jnp.abs(jnp.asarray(rng.normal(size=(6, 2)), jnp.float32)) - 1.0
    batch = ppo.Batch(None, action, before, advantage, target)

    def theirs(logits, value):
        return ppo.surrogate(config, logits, value, batch, jnp.int32(0))[0]

    def ours(logits, value):
        return mission.surrogate(logits, value, action, before, advantage, target)

    for function in (lambda f: f(logits, value), lambda f: jax.grad(f)(logits, value)):
        np.testing.assert_allclose(function(ours), function(theirs), rtol=2e-5)


def test_its_parameters_are_those_that_identify_finds(rng):
    u, y = rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    a, b = mission.identify(u, y)
    fit = jaxcal.identify(u, y, noise=jaxcal.Noise(std=0.1))
    np.testing.assert_allclose(a, fit.matrix, atol=1e-9)
    np.testing.assert_allclose(b, fit.bias, atol=1e-9)


@pytest.mark.slow
def test_four_moves_of_the_simulated_device_give_its_own_numbers():
    pytest.importorskip("pymodbus")
    commands = 20.0 * np.array(
        [[1, 1, -1], [-1, 0.4, -1], [0.7, -1, 0.5], [-1, 1, 0.8]]
    )
    a, b = mission.identify(commands, mission.measure(commands))
    truth = [[0.43, 0.012, -0.008], [-0.010, 0.71, 0.015], [0.006, -0.014, 0.87]]
    np.testing.assert_allclose(a, truth, atol=2e-3)  # readings have .02 deg of noise
    np.testing.assert_allclose(b, [3.1, -5.8, 2.41], atol=0.05)


@pytest.mark.slow
def test_a_minute_of_training_leaves_random_choices_far_behind():
    policy, params = mission.train(jax.random.key(1), updates=60)
    rng = np.random.default_rng(1)
    sets = rng.random((10, mission.M, mission.N))
    shares = [
        mission.share_of_optimum(poses, mission.choose(policy, params, poses))
        for poses in sets
    ]
    assert np.mean(shares) > 0.3  # random: 1/2,400
