"""Streams: sessions go on across updates, are cut anywhere, and are counted whole."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.learning import Step, Streams, StreamsConfig, make_train
from jaxcal.learning.core import ppo
from jaxcal.learning.training import checkpoint
from jaxcal.learning.training.run import DivergedError, Recipe, run

SHORT = StreamsConfig(
    num_updates=4,
    decisions_per_update=64,
    stream_length=8,
    num_minibatches=2,
    warmup_updates=1,
)


class Walk(NamedTuple):
    """A session of ``Late``."""

    made: jax.Array  # () decisions
    sum: jax.Array  # () of the actions, 0 or 1
    key: jax.Array  # () a typed key, as environments of others carry one


@dataclasses.dataclass(frozen=True)
class Late:
    """Each decision is 0 or 1; what pays is the last ones' being 1."""

    horizon: int = 13
    pays_from: int = 0

    def reset(self, task, key):
        return Walk(jnp.zeros(()), jnp.zeros(()), key)

    def observe(self, task, state, key):
        return jnp.stack(
            [state.made / self.horizon, jnp.ones(()), jax.random.uniform(key)]
        )

    def step(self, task, state, observation, action, key):
        pays = (state.made >= self.pays_from) * action * task
        after = Walk(
            state.made + 1.0, state.sum + action, jax.random.split(state.key)[0]
        )
        return Step.known(after, pays, after.made >= self.horizon)


class Linear(nn.Module):
    """Logits of two actions and a value, linear and in a hidden layer."""

    @nn.compact
    def __call__(self, seen):
        hidden = jnp.concatenate([seen, nn.tanh(nn.Dense(16)(seen))], axis=-1)
        return nn.Dense(2)(hidden), nn.Dense(1)(hidden)[..., 0]


def leaves(tree):
    """Arrays of numpy, of typed keys their data."""
    return [
        np.asarray(jax.random.key_data(x))
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key)
        else np.asarray(x)
        for x in jax.tree.leaves(tree)
    ]


def streams(config=SHORT, **environment):
    return Streams(config, Late(**environment), Linear())


PLAYED = streams(dataclasses.replace(SHORT, gae_lambda=0.0, decisions_per_update=32))
play = jax.jit(PLAYED.rollout)  # op by op it would be hundreds of programs


@pytest.mark.slow
def test_two_updates_of_a_length_play_what_one_of_twice_the_length_does():
    short = PLAYED
    longer = dataclasses.replace(
        short.config, stream_length=16, decisions_per_update=64
    )
    long = dataclasses.replace(short, config=longer)
    params = short.init(jax.random.key(0), 1.0)
    begun = short.begin(jax.random.split(jax.random.key(1), 4), 1.0)
    first, middle, _ = play(params, begun, 1.0)
    second, end, _ = play(params, middle, 1.0)
    whole, last, _ = jax.jit(long.rollout)(params, begun, 1.0)
    for name in ("observations", "action", "log_prob", "target"):
        parts = [getattr(batch, name) for batch in (first, second)]
        np.testing.assert_allclose(
            np.concatenate(parts, axis=1), getattr(whole, name), atol=1e-6
        )
    for one, other in zip(leaves(end), leaves(last), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_metrics_are_means_over_the_sessions_that_ended():
    """By hand from the actions: 13 decisions a session, 8 of them an update."""
    params = PLAYED.init(jax.random.key(0), 1.0)
    rollout_state = PLAYED.begin(jax.random.split(jax.random.key(1), 4), 1.0)
    actions, found = [], []
    for _ in range(4):
        batch, rollout_state, metrics = play(params, rollout_state, 1.0)
        actions.append(np.asarray(batch.action))
        found.append({name: float(value) for name, value in metrics.items()})
    played = np.concatenate(actions, axis=1)
    assert np.isnan(found[0]["reward_mean"]) and np.isnan(found[2]["choices"])
    for update, session in ((1, played[:, :13]), (3, played[:, 13:26])):
        assert found[update]["choices"] == 13.0
        expected = session.sum(axis=1).mean()
        assert found[update]["reward_mean"] == pytest.approx(expected, rel=1e-6)


@dataclasses.dataclass(frozen=True)
class Config:
    """What a run needs of a configuration."""

    ppo: StreamsConfig = SHORT
    environment: Late = Late()
    seed: int = 3
    num_seeds: int = 1
    validate_every: float = 15.0
    save_every: float = 60.0

    @property
    def learners(self):
        return (Streams(self.ppo, self.environment, Linear()),)

    def as_meta(self):
        return {"num_seeds": self.num_seeds}


def recipe(config, task):
    return Recipe(config, (task,), "probe", (), (), None)


@pytest.mark.slow
def test_a_run_resumes_bit_for_bit_in_the_middle_of_sessions(tmp_path):
    task = jnp.float32(1.0)
    whole = run(recipe(Config(), task), tmp_path / "whole")
    for last in (1, 3, 4):
        parts = run(
            recipe(Config(), task),
            tmp_path / "parts",
            resume=last > 1,
            num_updates=last,
        )
    assert {float(x) for x in whole.rollout_state.choices} == {32.0 - 26.0}
    state, _ = checkpoint.restore(tmp_path / "parts", whole, "probe")
    for other in (parts, state):
        for a, b in zip(leaves(whole), leaves(other), strict=True):
            np.testing.assert_array_equal(a, b)


def test_a_run_that_diverges_keeps_its_last_finite_weights(tmp_path):
    """From its 17th decision on, of the third update, it pays infinity."""

    @dataclasses.dataclass(frozen=True)
    class Breaks(Late):
        horizon: int = 1000

        def step(self, task, state, observation, action, key):
            step = super().step(task, state, observation, action, key)
            return step.replace(
                reward=jnp.where(state.made < 16.0, step.reward, jnp.inf)
            )

    ppo = dataclasses.replace(SHORT, num_updates=20)
    config, task = Config(ppo, Breaks()), jnp.float32(1.0)
    says = "loss is nan in 5 consecutive updates, the last of them 7. The weights"
    with pytest.raises(DivergedError, match=says):
        run(recipe(config, task), tmp_path)
    state, meta = checkpoint.restore(tmp_path, recipe(config, task).init(), "probe")
    made = meta["progress"]["updates"]
    assert made == int(state.num_updates) and 7 <= made <= 20
    assert all(
        np.isfinite(x).all() for x in jax.tree.leaves((state.params, state.average))
    )
    rows = np.genfromtxt(tmp_path / "metrics.csv", delimiter=",", names=True)
    assert list(np.isnan(rows["policy_loss"])) == [False] * 2 + [True] * (made - 2)


def test_one_bad_batch_is_skipped_and_the_run_goes_on(tmp_path):
    """What is played goes on behind it, so the same batch does not come again."""

    @dataclasses.dataclass(frozen=True)
    class Once(Late):
        """Pays nan in the sessions of one update."""

        def step(self, task, state, observation, action, key):
            step = super().step(task, state, observation, action, key)
            bad = jax.random.uniform(key) < task
            return step.replace(reward=jnp.where(bad, jnp.nan, step.reward))

    config = Config(dataclasses.replace(SHORT, num_updates=24), environment=Once())
    reports = []
    state = run(recipe(config, jnp.float32(0.004)), tmp_path, report=reports.append)
    assert int(state.num_updates) == 24
    rows = np.genfromtxt(tmp_path / "metrics.csv", delimiter=",", names=True)
    skipped = np.isnan(rows["policy_loss"])
    assert 0 < skipped.sum() == reports[-1].skipped and not skipped.all()
    made = np.flatnonzero(~skipped)
    assert made[-1] > np.flatnonzero(skipped)[0]  # after the first that was skipped


def test_a_folder_is_written_by_one_training_at_a_time(tmp_path):
    said = []

    def second(report):
        with pytest.raises(BlockingIOError, match="another training is writing to"):
            run(recipe(Config(), jnp.float32(1.0)), tmp_path)
        said.append(report)

    run(recipe(Config(), jnp.float32(1.0)), tmp_path, report=second)
    assert said


def test_a_damaged_checkpoint_is_put_aside_and_the_one_before_it_goes_on(tmp_path):
    made = recipe(Config(), jnp.float32(1.0))
    run(made, tmp_path, num_updates=2)
    whole = run(made, tmp_path, num_updates=3, resume=True)
    for path in (tmp_path / "checkpoint" / "3" / "state").rglob("*"):
        if path.is_file():
            path.write_bytes(b"")
    with pytest.warns(UserWarning, match=r"3 cannot be resumed.*is now damaged-3.*2$"):
        again = run(made, tmp_path, num_updates=3, resume=True)
    for a, b in zip(leaves(whole), leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    state, _ = checkpoint.restore(tmp_path, made.init(), "probe")
    assert int(state.num_updates) == 3  # written anew


def test_values_that_are_not_traced_are_refused():
    with pytest.raises(
        ValueError, match=r"values must be of learning_rate.*got num_epochs"
    ):
        make_train(streams())(jax.random.key(0), 1.0, num_epochs=2)


@pytest.mark.slow
def test_rates_and_entropy_map_in_one_program():
    train = make_train(streams())
    rates = jnp.array([1e-3, 1e-2])
    many, _ = jax.jit(
        jax.vmap(
            lambda r, e: train(jax.random.key(0), 1.0, learning_rate=r, entropy_start=e)
        )
    )(rates, jnp.array([0.0, 0.1]))
    own = dataclasses.replace(SHORT, learning_rate=1e-2, entropy_start=0.1)
    alone, _ = jax.jit(make_train(streams(own)))(jax.random.key(0), 1.0)
    for a, b in zip(*map(jax.tree.leaves, (many.params, alone.params)), strict=True):
        np.testing.assert_allclose(a[1], b, atol=1e-5)


@pytest.mark.slow
def test_a_session_of_sixty_decisions_is_learned_to_its_end():
    """What is paid lies past decision 32, the length of a stream."""
    config = StreamsConfig(
        num_updates=60, decisions_per_update=2048, learning_rate=1e-2
    )
    learner = Streams(config, Late(horizon=60, pays_from=40), Linear())
    _, metrics = jax.jit(make_train(learner))(jax.random.key(0), 1.0)
    rewards = np.asarray(metrics["reward_mean"])
    assert np.nanmean(rewards[:6]) < 13.0 and np.nanmean(rewards[-6:]) > 19.0
    assert ppo.explained_variance(jnp.arange(3.0), jnp.zeros(3)) == 0.0


@pytest.mark.slow
def test_cartpole_is_balanced_for_its_whole_horizon():
    import cartpole

    found = cartpole.study(False)
    assert np.nanmean(found[:, :3]) < 60.0 and np.nanmean(found[:, -5:]) > 450.0
