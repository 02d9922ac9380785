"""Particle beliefs, bounds and the public tasks, against exact and plain answers."""

import inspect
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from scipy import integrate, special, stats

from benchmarks.sequential.bounds import sace, spce
from benchmarks.tasks.ces import CES, ces
from benchmarks.tasks.hyperbolic import Hyperbolic
from benchmarks.tasks.location import LocationFinding
from benchmarks.tasks.prey import make_prey
from jaxcal.adaptive.episodes import compare, play
from jaxcal.adaptive.particles import ParticleTask, systematic
from jaxcal.adaptive.rules import SHARES, Gain, GainRate, Random


@struct.dataclass
class Line:
    """y = x . z + noise: the information of any designs has a closed form."""

    sigma: Any = 0.3

    dim = 2
    support = None

    def unknowns(self, z):
        return z

    def predict(self, unknowns, design):
        return (unknowns * design).sum()

    def log_prob(self, prediction, outcome):
        error = (outcome - prediction) / self.sigma
        return -0.5 * error**2 - jnp.log(self.sigma) - 0.5 * math.log(2 * math.pi)

    def sample(self, prediction, key):
        return prediction + self.sigma * jax.random.normal(key)

    def propose(self, unknowns, session, key, count):
        return jax.random.normal(key, (count, 2))

    def cost(self, session, design):
        return jnp.abs(design).sum()


@struct.dataclass
class Step:
    """One unknown, a threshold; an answer is 1 above it, seldom wrong."""

    dim = 1

    @property
    def support(self):
        return jnp.arange(2.0)

    def unknowns(self, z):
        return z[0]

    def predict(self, unknowns, design):
        return 0.05 + 0.9 * jax.scipy.stats.norm.cdf((design - unknowns) / 0.2)

    def log_prob(self, prediction, outcome):
        return jnp.log(jnp.where(outcome > 0.5, prediction, 1.0 - prediction))

    def sample(self, prediction, key):
        return (jax.random.uniform(key) < prediction).astype(jnp.float32)

    def propose(self, unknowns, session, key, count):
        return jnp.linspace(-2.0, 2.0, count)

    def cost(self, session, design):
        return jnp.zeros(())


def line(**change):
    sizes = {"particles": 400, "candidates": 6, "contrasts": 60, "moves": 3}
    return ParticleTask.make(Line(), 5, **sizes | change)


def step(**change):
    sizes = {"particles": 600, "candidates": 9, "contrasts": 400, "moves": 3}
    return ParticleTask.make(Step(), 8, **sizes | change)


def chance(z, design):
    return 0.05 + 0.9 * stats.norm.cdf((design - z) / 0.2)


@pytest.fixture(scope="module")
def lines():
    task = line(contrasts=400)  # the bias of contrasts goes as one over their number
    return task, play(task, Gain(), jax.random.split(jax.random.key(0), 64))


def closed_form(designs, sigma=0.3):
    """(B,) nats of B sets of designs (T, 2)."""
    x = np.asarray(designs, np.float64)
    information = np.eye(2) + np.einsum("bti,btj->bij", x, x) / sigma**2
    return 0.5 * np.linalg.slogdet(information)[1]


@jax.jit
def replay(task, designs, outcomes, key):
    """The belief after T measurements."""
    key_begin, key_steps = jax.random.split(key)

    def one(belief, now):
        design, outcome, key = now
        return belief.update(task, design, outcome, key), None

    keys = jax.random.split(key_steps, len(outcomes))
    begun, _ = task.begin(key_begin)
    return jax.lax.scan(one, begun, (designs, outcomes, keys))[0]


@jax.jit
def first_gains(task, key):
    """The first options of a session, and their gains."""
    keys = jax.random.split(key, 3)
    belief, session = task.begin(keys[0])
    options = task.options(belief, session, keys[1])
    return options.designs, belief.gains(task, options, keys[2])


def test_particles_are_the_posterior_that_a_grid_has(rng):
    task = step()
    grid = np.linspace(-5, 5, 4001)
    for number in range(6):
        truth = rng.normal()
        designs = rng.normal(size=8)
        outcomes = (rng.random(8) < chance(truth, designs)).astype(float)
        weight = stats.norm.pdf(grid)
        for design, outcome in zip(designs, outcomes, strict=True):
            p = chance(grid, design)
            weight = weight * (p if outcome > 0.5 else 1.0 - p)
        evidence = integrate.trapezoid(weight, grid)
        weight = weight / weight.sum()
        mean = weight @ grid
        sd = math.sqrt(weight @ (grid - mean) ** 2)
        belief = replay(
            task, jnp.asarray(designs), jnp.asarray(outcomes), jax.random.key(number)
        )
        mine = np.exp(np.asarray(belief.log_weight, np.float64))
        z = np.asarray(belief.z[:, 0], np.float64)
        assert mine.sum() == pytest.approx(1.0, abs=1e-4)
        assert mine @ z == pytest.approx(mean, abs=0.25 * sd)
        found = math.sqrt(mine @ (z - mine @ z) ** 2)
        assert found == pytest.approx(sd, rel=0.25)
        assert float(belief.log_evidence) == pytest.approx(math.log(evidence), abs=0.3)


@pytest.mark.slow
def test_gains_of_few_outcomes_are_those_of_the_grid():
    task = step(particles=8000, contrasts=8000)
    designs, found = first_gains(task, jax.random.key(0))
    grid = np.linspace(-5, 5, 2001)
    weight = stats.norm.pdf(grid)
    weight /= weight.sum()
    for design, gain in zip(np.asarray(designs), found, strict=True):
        p = chance(grid, design)
        wanted = stats.entropy([weight @ p, 1 - weight @ p]) - weight @ np.array(
            [stats.entropy([q, 1 - q]) for q in p]
        )
        assert float(gain) == pytest.approx(wanted, abs=0.03)


def test_gains_of_continuous_outcomes_are_those_of_the_closed_form():
    task = line(particles=4000, contrasts=2000)
    designs, found = first_gains(task, jax.random.key(0))
    wanted = closed_form(np.asarray(designs)[:, None])
    np.testing.assert_allclose(found, wanted, atol=0.12)


@pytest.mark.slow
def test_three_estimators_and_the_closed_form_agree(lines):
    _, episodes = lines
    wanted = closed_form(episodes.designs)
    for name in ("gain", "entropy_drop", "log_ratio"):
        gap = np.asarray(getattr(episodes, name), np.float64) - wanted
        assert abs(gap.mean()) < 4.0 * gap.std() / 8.0 + 0.1, name


@pytest.mark.slow
def test_bounds_hold_the_closed_form_between_them(lines):
    task, episodes = lines
    wanted = closed_form(episodes.designs).mean()
    tight = sace(
        task, episodes, jax.random.key(1), contrasts=512, particles=512, moves=4
    )
    wide = spce(task, episodes, jax.random.key(2), 256)
    for bounds in (tight, wide):
        lower, upper = bounds.mean
        # The truths are drawn, so both move together by their common error.
        assert lower - 4.0 * bounds.error[0] < wanted < upper + 4.0 * bounds.error[1]
    assert tight.mean[1] - tight.mean[0] < 0.05
    assert wide.cap == pytest.approx(math.log(257))
    assert (wide.lower <= wide.cap + 1e-5).all()
    gap = tight.lower - np.asarray(episodes.log_ratio)
    assert abs(gap.mean()) < 0.2


def test_contrasts_that_are_not_drawn_whole_are_refused(lines):
    task, episodes = lines
    with pytest.raises(ValueError, match="below 4096 or a multiple of it, got 100000"):
        spce(task, episodes, jax.random.key(0), 100_000)
    assert inspect.signature(spce).parameters["contrasts"].default % 4096 == 0


@pytest.mark.slow
def test_sessions_end_where_the_budget_does():
    task = line(seconds=3.0)
    found = compare(task, {"rate": GainRate(), "random": Random()}, 64)
    assert found.mean("rate")[0] > found.mean("random")[0]
    episodes = play(task, GainRate(), jax.random.split(jax.random.key(0), 64))
    cost = np.abs(np.asarray(episodes.designs)).sum(-1)
    alive = np.asarray(episodes.alive)
    paid = (cost * alive).sum(-1)
    assert (paid <= 3.0).all() and alive[:, 0].all()
    ended = ~alive.all(-1)  # what came next cost more than was left
    assert ended.any()
    after = cost[ended, alive[ended].argmin(-1)]
    assert (after > 3.0 - paid[ended]).all()


def test_systematic_draws_are_as_many_as_the_weights_say(rng):
    weight = rng.dirichlet(np.ones(20))
    index = systematic(jnp.log(jnp.asarray(weight)), 1000, jax.random.key(0))
    count = np.bincount(np.asarray(index), minlength=20)
    assert (np.abs(count - 1000 * weight) <= 1.0 + 1e-2).all()


@pytest.mark.slow
def test_signals_of_location_finding_are_drawn_with_their_noise():
    model = LocationFinding()
    keys = jax.random.split(jax.random.key(1), 2000)
    drawn = jax.vmap(lambda k: model.sample(jnp.asarray(1.5), k))(keys)
    assert float(drawn.mean()) == pytest.approx(1.5, abs=0.06)
    assert float(drawn.std()) == pytest.approx(0.5, abs=0.04)


def test_ces_is_that_of_the_text():
    rng = np.random.default_rng(0)
    model = CES()
    for z in rng.normal(size=(6, 4)):
        rho = 0.01 + 0.99 * stats.norm.cdf(z[0])
        first = 1 - math.sqrt(1 - stats.norm.cdf(z[1]))
        second = (1 - first) * stats.norm.cdf(z[2])
        alpha = np.array([first, second, 1 - first - second])
        u = math.exp(1 + 3 * z[3])
        design = rng.uniform(0.01, 100, 6)
        one, two = (
            (alpha * x**rho).sum() ** (1 / rho) for x in (design[:3], design[3:])
        )
        mean = u * (one - two)
        sd = 0.005 * u * (1 + np.linalg.norm(design[:3] - design[3:]))
        found = model.predict(model.unknowns(jnp.asarray(z)), jnp.asarray(design))
        np.testing.assert_allclose(found, [mean, sd], rtol=2e-3, atol=2e-2 * sd)
    cut = special.logit(1 - 2.0**-22)
    for mean, sd in ((0.3, 2.0), (20.0, 3.0), (-14.0, 5.0)):
        prediction = jnp.asarray([mean, sd])
        inside = integrate.quad(
            lambda y, p=prediction: math.exp(float(model.log_prob(p, y))),
            -cut + 1e-4, cut - 1e-4, limit=80,
        )[0]  # fmt: skip
        ends = sum(
            math.exp(float(model.log_prob(prediction, s * 15.25))) for s in (1, -1)
        )
        assert inside + ends == pytest.approx(1.0, abs=1e-3)


def test_marks_at_the_cut_are_as_likely_as_the_tail_says():
    for mean in (40.0, 16.0, 15.0, 10.0, 0.0, -300.0):
        prediction = jnp.asarray([mean, 1.5])
        wanted = stats.norm.logsf(special.logit(1 - 2.0**-22), mean, 1.5)
        found = model_log_prob(prediction, 15.25)
        assert found == pytest.approx(wanted, rel=1e-4, abs=1e-4)
        assert model_log_prob(-prediction * jnp.asarray([1.0, -1.0]), -15.25) == found


def model_log_prob(prediction, outcome):
    return float(CES().log_prob(prediction, jnp.asarray(outcome)))


def test_alpha_of_ces_is_uniform_on_the_simplex():
    z = jax.random.normal(jax.random.key(0), (4000, 4))
    alpha = np.asarray(jax.vmap(CES().unknowns)(z))[:, 1:4]
    np.testing.assert_allclose(alpha.sum(-1), 1.0, atol=1e-5)
    np.testing.assert_allclose(alpha.mean(0), 1 / 3, atol=0.02)
    np.testing.assert_allclose(alpha.var(0), 1 / 18, atol=0.005)


@pytest.mark.slow
def test_a_ces_session_with_a_budget_stays_within_it():
    task = ces(3, budget=30.0, particles=60, candidates=12, contrasts=20, moves=1)
    episodes = play(task, Gain(), jax.random.split(jax.random.key(0), 8))
    way = np.linalg.norm(np.diff(np.asarray(episodes.designs), axis=1), axis=-1)
    assert (way.sum(-1) <= 30.0 + 1e-3).all()


def test_prey_is_that_of_the_differential_equation():
    model = make_prey()
    for z, count in (([0.0, 0.0], 40.0), ([1.5, -1.0], 300.0), ([-1.0, 2.0], 3.0)):
        a, h = (math.exp(-1.4 + 1.35 * v) for v in z)
        solved = integrate.solve_ivp(
            lambda t, n, a=a, h=h: -a * n**2 / (1 + a * h * n**2),
            (0, 24), [count], rtol=1e-9, atol=1e-12, method="LSODA",
        )  # fmt: skip
        eaten = 1 - solved.y[0, -1] / count
        prediction = model.predict(model.unknowns(jnp.asarray(z)), jnp.asarray(count))
        assert math.exp(float(prediction[1])) == pytest.approx(eaten, abs=1e-4)
        p = jax.vmap(lambda y, q=prediction: model.log_prob(q, y))(model.support)
        wanted = stats.binom.logpmf(np.arange(301), int(count), eaten)
        np.testing.assert_allclose(np.exp(p), np.exp(wanted), atol=2e-3)


def test_prey_as_code_is_by_runge_kutta_steps():
    a, h, count = math.exp(-1.4), math.exp(-1.4), 40.0
    left = count
    for _ in range(24):
        one, two, three, four = 0.0, 0.0, 0.0, 0.0
        rate = lambda n: -a * n * n / (1 + a * h * n * n)  # noqa: E731  # as published
        one = rate(left)
        two = rate(left + one / 3)
        three = rate(left + two - one / 3)
        four = rate(left + one - two + three)
        left += (one + 3 * two + 3 * three + four) / 8
    model = make_prey(as_code=True)
    prediction = model.predict(model.unknowns(jnp.zeros(2)), jnp.asarray(count))
    assert math.exp(float(prediction[2])) == pytest.approx(left / count, abs=1e-4)
    # Where a N is large the steps overshoot: nothing is left.
    far = model.predict(jnp.asarray([1.0, -3.0]), jnp.asarray(count))
    assert float(far[2]) == pytest.approx(math.log(1e-6), abs=0.1)


def test_hyperbolic_is_that_of_the_text_and_of_the_code():
    k, alpha, days, money = 0.02, 3.0, 60.0, 40.0
    off = (100 / (1 + k * days) - money) / alpha
    unknowns = jnp.asarray([math.log(k), alpha])
    design = jnp.asarray([math.log(days), money])
    text = Hyperbolic(least_alpha=0.0, steepness=1.0).predict(unknowns, design)
    assert float(text) == pytest.approx(0.01 + 0.98 * stats.norm.cdf(off), abs=1e-5)
    code = Hyperbolic().predict(unknowns, design)
    wanted = 0.01 + 0.98 * (0.5 + 0.5 * special.erf(off))
    assert float(code) == pytest.approx(wanted, abs=1e-5)
    z = jax.random.normal(jax.random.key(0), (4000, 2))
    drawn = np.asarray(jax.vmap(Hyperbolic().unknowns)(z))[:, 1]
    assert stats.kstest(drawn - 1e-3, stats.halfnorm(scale=2).cdf).pvalue > 1e-4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seconds": -1.0}, "seconds must be one number above 0, got -1"),
        ({"particles": 1}, "particles must be"),
        ({"contrasts": 0}, "contrasts must be"),
        ({"moves": 0}, "moves must be"),
    ],
)
def test_a_bad_task_is_one_clear_error(change, message):
    with pytest.raises(ValueError, match=message):
        line(**change)


def test_an_answer_that_no_particle_expects_is_survived():
    """A belief after the next to impossible is finite, and where the answer says."""
    designs, outcomes = jnp.asarray([[1.0, 0.0]]), jnp.asarray([9.0])
    belief = replay(line(moves=12), designs, outcomes, jax.random.key(0))
    z = np.asarray(belief.z)
    assert np.isfinite(z).all() and np.isfinite(np.asarray(belief.log_weight)).all()
    assert z[:, 0].mean() == pytest.approx(9.0 / (1 + 0.09), abs=0.15)


pytestmark = pytest.mark.slow  # minutes together


@jax.jit
def looked(task, key):
    keys = jax.random.split(key, 3)
    belief, session = task.begin(keys[0])
    options = task.options(belief, session, keys[1])
    chosen = SHARES(task, belief, session, options, keys[2])
    return options.designs, belief.gains(task, options, keys[2]), chosen


def test_shares_prices_time_on_particles():
    task = ParticleTask.make(
        Line(), 6, seconds=5.0, particles=200, candidates=32, contrasts=40
    )
    for key in jax.random.split(jax.random.key(3), 4):
        designs, gains, chosen = jax.tree.map(np.asarray, looked(task, key))
        share = np.minimum(np.abs(designs.astype(float)).sum(axis=1) / 5.0, 1.0)
        score = gains.astype(float) / (1.0 / 6.0 + 1.4 * share)
        assert score[chosen] > (1.0 - 1e-5) * score.max()
        assert chosen != gains.argmax()
