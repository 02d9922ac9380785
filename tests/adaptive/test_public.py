"""Public and own tasks of continuous unknowns: what is refused, commands, docs."""

import json
import math
import pathlib
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from scipy import integrate, stats

from benchmarks.tasks.location import location_finding
from jaxcal.adaptive.loop import next_measurement
from jaxcal.adaptive.particles import ParticleTask
from jaxcal.adaptive.tasks import registry
from jaxcal.commands import evaluate as evaluate_command
from jaxcal.commands import train as train_command

ROOT = pathlib.Path(__file__).parents[2]
DOCS, TASKS = ROOT / "docs", ROOT / "benchmarks" / "tasks"
LOCATION = str(TASKS / "location.py")


@struct.dataclass
class Counts:
    """0, 1 or 2 of two, each with a probability that the design shifts."""

    fee: Any = 0.0
    whole: Any = 1.0  # what the probabilities sum to
    most: Any = 2.0  # of the outcomes

    dim = 1

    @property
    def support(self):
        return jnp.arange(3.0)

    def unknowns(self, z):
        return z[0]

    def predict(self, unknowns, design):
        return jax.nn.sigmoid(unknowns - design)

    def log_prob(self, p, outcome):
        ways = jnp.where(outcome == 1.0, 2.0, 1.0)
        found = jnp.log(ways) + outcome * jnp.log(p) + (2 - outcome) * jnp.log1p(-p)
        return jnp.where(outcome <= self.most, found, -jnp.inf) + jnp.log(self.whole)

    def sample(self, p, key):
        return (jax.random.uniform(key, (2,)) < p).sum().astype(jnp.float32)

    def propose(self, unknowns, session, key, count):
        return jnp.linspace(-1.0, 1.0, count)

    def cost(self, session, design):
        return jnp.asarray(self.fee)


def counts(**change):
    return ParticleTask.make(
        Counts(**change), 3, particles=50, candidates=4, contrasts=20, moves=1
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fee": -1.0}, r"model.cost must be at least 0, got \(-1,"),
        ({"whole": 0.9}, "sum to 1 over model.support, got 0.9"),
        ({"most": 0.0}, "must be finite for what model.sample draws, got -inf for"),
    ],
)
def test_a_model_that_cannot_be_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        counts(**change)


def test_answers_that_cannot_be_are_named():
    task = counts()
    proposal = next_measurement(task, [(0.5, 1.0)])
    assert proposal.number == 1 and 0.0 < proposal.gain < math.log(3)
    with pytest.raises(ValueError, match=r"history\[1\]: outcome must be one of the 3"):
        next_measurement(task, [(0.5, 1.0), (0.5, 0.5)])
    with pytest.raises(ValueError, match=r"history\[0\]: outcome must have shape \(\)"):
        next_measurement(task, [(0.5, [1.0])])
    never = task.replace(model=Counts(most=1.0))
    with pytest.raises(ValueError, match=r"\[0\]: outcome 2.0 is impossible"):
        next_measurement(never, [(0.5, 2.0)])


def mean_signal(sources, at):
    """(N,) means of the log signal of N pairs of sources, by the text of the paper."""
    squared = ((sources - at) ** 2).sum(axis=-1)
    return np.log(0.1 + (1.0 / (1e-4 + squared)).sum(axis=-1))


@pytest.mark.slow
def test_location_finding_is_that_of_a_second_implementation():
    """Likelihood and gain; the outcome's entropy by quadrature, float64."""
    task = location_finding(particles=600, candidates=4, contrasts=600)

    def likelihood_of(z, design, outcome):
        signals = task.model.predict(task.model.unknowns(z), design)
        return task.model.log_prob(signals, outcome)

    @jax.jit
    def first(key):
        keys = jax.random.split(key, 4)
        belief, session = task.begin(keys[0])
        options = task.options(belief, session, keys[1])
        gains = belief.gains(task, options, keys[2])
        outcomes = jax.vmap(task.measure, (0, 0, None))(
            belief.z[:4], options.designs, keys[3]
        )
        likelihood = jax.vmap(likelihood_of)(belief.z[:4], options.designs, outcomes)
        return belief.z, options.designs, gains, outcomes, likelihood

    found = first(jax.random.key(0))
    z, designs, gains, outcomes, likelihood = (np.asarray(x, np.float64) for x in found)
    sources = z.reshape(-1, 2, 2)
    grid = np.linspace(-5.0, 12.0, 4001)
    for number, design in enumerate(designs):
        means = mean_signal(sources, design)
        wanted = stats.norm.logpdf(outcomes[number], means[number], 0.5)
        assert likelihood[number] == pytest.approx(wanted, abs=2e-3)
        p = stats.norm.pdf(grid[:, None], means, 0.5).mean(axis=1)
        entropy = -integrate.trapezoid(p * np.log(p + 1e-300), grid)
        wanted = entropy - stats.norm(scale=0.5).entropy()
        # One outcome is drawn of each of 600: a standard error of about 0.03.
        assert gains[number] == pytest.approx(wanted, abs=0.12)


def test_sums_are_compiled_right():
    """jaxlib 0.10.2, which the requirements exclude, compiles these wrongly.

    The operand is broadcast over an axis that the sum does not run over (JAX issue
    39103): from some size on all designs had one gain.
    """
    unknowns = np.sin(np.arange(2048.0)).reshape(1024, 2)
    designs = np.array([[1.0, 2.0], [-1.0, 0.5]])

    @jax.jit
    def near(unknowns, designs):
        means = (unknowns[None] * designs[:, None]).sum(axis=-1)
        return jnp.exp(-((means[:, :, None] - means[:, None]) ** 2)).sum(axis=2)

    means = designs @ unknowns.T
    right = np.exp(-((means[:, :, None] - means[:, None]) ** 2)).sum(axis=2)
    found = near(jnp.asarray(unknowns), jnp.asarray(designs))
    np.testing.assert_allclose(found, right, rtol=1e-3)


@pytest.fixture(params=["grid", "particles"])
def documented(request, tmp_path):
    """A task of docs/own_task.md, as a file."""
    part = (DOCS / "own_task.md").read_text()
    blocks = re.findall(r"```python\n(.*?)```", part, re.DOTALL)
    block = next(b for b in blocks if f"jaxcal.adaptive.{request.param} " in b)
    path = tmp_path / "own.py"
    path.write_text(block)
    return path


def test_the_documented_task_is_one_file(documented):
    entry = registry.load(str(documented))
    proposal = next_measurement(entry.make(), seconds=8.0, uses=2)
    assert proposal.gain > 0.3
    assert entry.about


@pytest.mark.slow
def test_commands_run_a_task_of_particles(tmp_path, capsys):
    small = ["--with", "measurements=3", "particles=40", "candidates=5", "contrasts=10"]
    arguments = ["--task", LOCATION, *small, "--episodes", "8", "--quiet"]
    document, report = tmp_path / "out.json", tmp_path / "report"
    more = ["--json", str(document), "--report", str(report)]
    methods = ["--methods", "random,gain,shares"]
    assert evaluate_command.main([*arguments, *methods, *more], "evaluate.py") == 0
    found = json.loads(document.read_text())["results"][0]["methods"]
    assert all(found[name]["nats"]["mean"] > 0.0 for name in methods[1].split(","))
    assert (report / "sequential.svg").is_file()
    assert (
        evaluate_command.main([*arguments, "--methods", "static"], "evaluate.py") == 2
    )
    assert "methods must be of random, gain" in capsys.readouterr().err
    out = str(tmp_path / "run")
    sizes = ["--with", "num_minibatches=2", "num_epochs=1", "--width", "8"]
    start = ["--task", LOCATION, *small, *sizes, "--updates", "1", "--out", out]
    assert train_command.main(start, "train.py") == 0
    policy = [*arguments, "--checkpoint", out, "--methods", "gain,policy"]
    assert evaluate_command.main(policy, "evaluate.py") == 0
    assert "policy" in capsys.readouterr().out


@pytest.mark.slow
def test_brax_plays_a_task_of_particles():
    pytest.importorskip("brax")
    from jaxcal.adaptive.brax_env import SequentialEnv
    from jaxcal.learning.brax import wrap_fresh

    task = counts()
    with jax.numpy_rank_promotion("allow"):
        env = wrap_fresh(
            SequentialEnv(task, registry.FREE["state"], 3), task.horizon, 1
        )
        assert env.action_size == 3
        state = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(1), 4))
        step = jax.jit(env.step)
        done = []
        for _ in range(4):
            state = step(state, jnp.zeros(4, jnp.int32))
            done.append(np.asarray(state.done).tolist())
    assert done == [[0.0] * 4, [0.0] * 4, [1.0] * 4, [0.0] * 4]


@pytest.mark.parametrize("name", ["ces", "death", "hyperbolic", "location", "prey"])
def test_public_tasks_are_files_as_a_user_writes_them(name):
    entry = registry.load(str(TASKS / f"{name}.py"))
    assert (
        entry.about
        and "gain" in entry.methods
        and set(entry.rules) == set(registry.FREE)
    )
