"""The environment under brax: the adapter, fresh episodes, and brax's own PPO."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.learning.environments import selection as environment
from jaxcal.learning.environments.selection import SelectionConfig
from jaxcal.learning.training import checkpoint, presets

brax_env = pytest.importorskip("jaxcal.learning.brax")


def test_the_adapter_plays_the_same_episode():
    config = SelectionConfig()
    env = brax_env.SelectionEnv(config)
    key = jax.random.PRNGKey(0)
    # One program each: op by op they would be hundreds.
    step = jax.jit(env.step)
    plainly = jax.jit(lambda plain, action: environment.step(plain, action, config))
    observe = jax.jit(lambda plain: environment.observe(plain, config))
    state = jax.jit(env.reset)(key)
    plain = jax.jit(lambda key: environment.reset(key, config))(key)
    assert state.obs.shape == (env.observation_size,) == (210,)
    assert env.action_size == 50
    for action in (4, 8, 15, 16):
        state = step(state, jnp.int32(action))
        plain, reward, done = plainly(plain, jnp.int32(action))
        np.testing.assert_allclose(state.obs, observe(plain), atol=1e-6)
        assert float(state.reward) == pytest.approx(float(reward), abs=1e-6)
        assert bool(state.done) == bool(done)


def test_reset_after_done_draws_new_candidates_and_nothing_is_truncated():
    config = SelectionConfig(num_candidates=8)
    with jax.numpy_rank_promotion("allow"):
        env = brax_env.wrap_fresh(brax_env.SelectionEnv(config), config.num_selected, 1)
        state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(1), 3))
        step = jax.jit(env.step)
        seen = set()
        for episode in range(6):
            seen.add(np.asarray(state.obs[:, :24]).tobytes())
            for action in range(4):
                state = step(state, jnp.full(3, action))
                assert not np.asarray(state.info["truncation"]).any()
            assert np.asarray(state.done).all(), episode
    assert len(seen) == 6


@pytest.mark.parametrize("least", [-1e9, -np.inf])
def test_the_distribution_of_masked_logits_is_that_of_the_others(least):
    from brax.training.distribution import IdentityPostprocessor

    free, action = jnp.array([0.3, -1.0, 0.8]), jnp.int32(2)
    kind = brax_env._MaskedCategorical(4, IdentityPostprocessor(), 0, False)
    made = kind.create_dist(jnp.append(free, least))
    shares = np.exp(free) / np.exp(free).sum()
    assert made.entropy() == pytest.approx(-(shares * np.log(shares)).sum(), rel=1e-6)
    assert made.log_prob(action) == pytest.approx(np.log(shares[2]), rel=1e-6)


def test_braxs_trainer_has_its_folder_alone(tmp_path, monkeypatch):
    from jaxcal.learning.training import brax_ppo
    from jaxcal.learning.training.run import locked

    config = brax_ppo.adapted(presets.load("compact"))
    shapes = jax.eval_shape(config.learners[0].init, jax.random.key(0))
    params = jax.tree.map(lambda leaf: np.ones(leaf.shape, leaf.dtype), shapes)

    def second(*_, **__):  # begun while the first trains
        with pytest.raises(BlockingIOError, match="another training is writing to"):
            with locked(tmp_path):
                pass
        return None, (None, {"params": {"network": params}}), None

    monkeypatch.setattr(brax_env, "train", second)
    with locked(tmp_path), pytest.raises(BlockingIOError):
        brax_ppo.train(config, tmp_path, print)
    brax_ppo.train(config, tmp_path, print)
    assert checkpoint.load(tmp_path).meta["trainer"] == "brax"


@pytest.mark.slow
@pytest.mark.trains
def test_a_script_of_a_brax_user_trains_postures_and_a_task():
    """As the example has it; random postures reach -1.9, the optimum is -0.35."""
    import brax_ppo

    before, after = brax_ppo.postures(40_000)
    assert before < -1.0 and after > before + 0.5
    before, after = brax_ppo.task(40_000)
    assert before > 0.5 and after > before + 0.03
    assert not hasattr(jax, "device_put_replicated") or jax.__version__ < "0.10"


@pytest.mark.slow
@pytest.mark.trains
def test_braxs_own_ppo_trains_it(tmp_path):
    from jaxcal.learning.training import brax_ppo

    config = brax_ppo.adapted(presets.load("compact"))
    config = presets.with_values(config, {"num_episodes": 20_000})
    lines: list[str] = []
    watched = []  # as a caller of brax reads them while it trains

    def watch(step, make_policy, params):
        watched.append(params[1]["params"]["network"])

    more = {"num_evals": 3, "policy_params_fn": watch}
    brax_ppo.train(config, tmp_path, lines.append, **more)
    values = [float(line.rsplit(" ", 1)[1]) for line in lines if "log det" in line]
    assert values[-1] > values[0] + 3.0  # from random towards the optimum of -1.2
    assert not hasattr(jax, "device_put_replicated") or jax.__version__ < "0.10"
    policy = checkpoint.load(tmp_path)
    assert policy.meta["trainer"] == "brax"
    assert policy.network.config.kind == "paper"
    jax.tree.map(np.testing.assert_array_equal, watched[-1], policy.params)
