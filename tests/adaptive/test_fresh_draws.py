"""What an option is credited with is not what made it win.

The largest of some noisy estimates is too large. Here every option tells exactly as
much as any other, so the mean of what is credited must be that.
"""

import csv
import math
import textwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.adaptive.episodes import play
from jaxcal.adaptive.loop import next_measurement
from jaxcal.adaptive.rules import Gain
from jaxcal.adaptive.tasks import registry
from jaxcal.commands import train as train_command

EXACT = 0.5 * math.log(1.0 + 1.0 / 2.0**2)  # nats of y = x . z + noise, |x| = 1, sd 2
FILE = '''
import jax
import jax.numpy as jnp
from flax import struct
from jaxcal.adaptive.particles import ParticleTask
from jaxcal.adaptive.tasks import Entry
from jaxcal.adaptive.tasks.registry import FREE

@struct.dataclass
class Direction:
    """One reading of six unknowns along a direction of unit length."""

    dim = 6
    support = None

    def unknowns(self, z):
        return z

    def predict(self, unknowns, design):
        return (unknowns * design).sum()

    def log_prob(self, prediction, outcome):
        return jax.scipy.stats.norm.logpdf(outcome, prediction, 2.0)

    def sample(self, prediction, key):
        return prediction + 2.0 * jax.random.normal(key)

    def propose(self, unknowns, session, key, count):
        way = jax.random.normal(key, (count, 6))
        return way / jnp.linalg.norm(way, axis=-1, keepdims=True)

    def cost(self, session, design):
        return jnp.zeros(())

def direction():
    return ParticleTask.make(
        Direction(), 1, particles=200, candidates=12, contrasts=100, moves=1
    )

ENTRY = Entry(direction, rules=FREE)
'''


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    found = tmp_path_factory.mktemp("task") / "direction.py"
    found.write_text(textwrap.dedent(FILE))
    return found


@pytest.fixture(scope="module")
def task(path):
    return registry.load(str(path)).make()


def has_exact_mean(values):
    """Whether a mean is what an option tells, known well enough to say so."""
    values = np.asarray(values, np.float64)
    error = values.std(ddof=1) / len(values) ** 0.5
    # The estimates that win are 0.06 too large.
    return error < 0.01 and abs(values.mean() - EXACT) < 4.0 * error


def test_the_estimates_that_win_are_too_large(task):
    """The bias that the other tests look for is there."""

    @jax.jit
    def largest(key):
        keys = jax.random.split(key, 3)
        belief, session = task.begin(keys[0])
        options = task.options(belief, session, keys[1])
        return belief.gains(task, options, keys[2]).max()

    won = jnp.stack([largest(key) for key in jax.random.split(jax.random.key(0), 64)])
    assert won.mean() > EXACT + 0.04
    assert not has_exact_mean(won)


@pytest.mark.slow
def test_play_credits_what_an_option_tells(task):
    played = play(task, Gain(), jax.random.split(jax.random.key(1), 256))
    assert has_exact_mean(played.gain)


def test_a_proposal_states_what_it_tells(task):
    gains = [next_measurement(task, seed=seed).gain for seed in range(64)]
    assert has_exact_mean(gains)


@pytest.mark.slow
def test_brax_is_rewarded_with_what_an_option_tells(task):
    pytest.importorskip("brax")
    from jaxcal.adaptive.brax_env import SequentialEnv

    env = SequentialEnv(task, registry.FREE["state"], 6)

    @jax.jit
    @jax.vmap
    def reward(key):  # the first of the shortlist is the one of the largest gain
        return env.step(env.reset(key), jnp.int32(0)).reward

    assert has_exact_mean(reward(jax.random.split(jax.random.PRNGKey(2), 256)))


@pytest.mark.slow
def test_ppo_is_rewarded_with_what_an_option_tells(path, tmp_path):
    sizes = ["--with", "num_minibatches=2", "num_epochs=1", "--width", "8"]
    flags = ["--task", str(path), *sizes, "--out", str(tmp_path), "--updates", "1"]
    assert train_command.main(flags, "train.py") == 0
    (row,) = csv.DictReader((tmp_path / "metrics.csv").open())
    assert float(row["choices"]) == 1.0
    # 4,096 sessions of one choice each; the standard error is below 0.001.
    assert float(row["reward_mean"]) == pytest.approx(EXACT, abs=0.005)
