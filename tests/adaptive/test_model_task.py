"""A model of jaxcal.models measured one by one, against Bayes in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.adaptive import ParticleTask, next_measurement, run
from jaxcal.adaptive.loop import estimates
from jaxcal.models import FromJax, Linear, Noise, Polynomial, Prior

AT = np.linspace(-1.0, 1.0, 5)[:, None]
SETTINGS = np.linspace(1.5, 4.5, 7)[:, None]


def normal_posterior(rows, readings, prior_std, covariance):
    """Mean and covariance of theta ~ N(0, prior_std^2) after linear readings."""
    precision = np.eye(rows.shape[-1]) / prior_std**2
    right = np.zeros(rows.shape[-1])
    for row, reading in zip(rows, readings, strict=True):
        weight = row.T @ np.linalg.inv(covariance)
        precision += weight @ row
        right += weight @ np.atleast_1d(reading)
    return np.linalg.solve(precision, right), np.linalg.inv(precision)


@pytest.mark.slow
def test_a_linear_model_is_known_as_by_bayes_in_closed_form():
    task = ParticleTask.of(
        Polynomial(2, 1), Prior(1.0, mean=0.0), Noise(std=0.3), AT, measurements=4,
        particles=3000, contrasts=1000,
    )  # fmt: skip
    history = [(0, 0.4), (2, -0.2), ([1.0], 0.9)]
    proposal = next_measurement(task, history)
    rows = np.array([np.concatenate([u**0, u, u**2]) for u in AT])[:, None]
    mean, covariance = normal_posterior(
        rows[[0, 2, 4]], [0.4, -0.2, 0.9], 1.0, np.diag([0.09])
    )
    gains = [0.5 * np.log1p((row @ covariance @ row.T).item() / 0.09) for row in rows]
    assert gains[proposal.design] > max(gains) - 0.02
    assert proposal.gain == pytest.approx(gains[proposal.design], abs=0.04)
    found = estimates(task, proposal.belief)
    assert list(found) == list(Polynomial(2, 1).names)
    for number, one in enumerate(found.values()):
        std = covariance[number, number] ** 0.5
        assert one.mean == pytest.approx(mean[number], abs=0.12 * std)
        assert one.width == pytest.approx(2 * 1.96 * std, rel=0.12)


@pytest.mark.slow
def test_the_gain_that_is_told_is_that_of_bayes_whatever_the_seed():
    at, history = np.linspace(-1.0, 1.0, 9)[:, None], [(0, -0.4), (8, 1.9), (4, 0.6)]
    task = ParticleTask.of(
        Polynomial(1, 1), Prior(1.0), Noise(std=0.3), at, measurements=8
    )
    rows = np.array([[[1.0, u]] for u in at[:, 0]])
    spread = normal_posterior(rows[[0, 8, 4]], [0.0] * 3, 1.0, np.diag([0.09]))[1]
    for seed in range(6):  # one draw of the gain has a standard deviation of .08
        proposal = next_measurement(task, history, seed=seed)
        row = rows[proposal.design]
        gain = 0.5 * np.log1p((row @ spread @ row.T).item() / 0.09)
        assert proposal.gain == pytest.approx(gain, abs=0.06)


@pytest.mark.slow
def test_readings_of_two_outputs_count_by_their_covariance():
    covariance = np.array([[0.09, 0.04], [0.04, 0.04]])
    model = Linear("1 + x", 2)
    task = ParticleTask.of(
        model, Prior(1.0, mean=0.0), Noise(covariance=covariance), AT, measurements=3,
        particles=3000,
    )  # fmt: skip
    readings = [[0.4, -0.1], [0.6, 0.3]]
    belief = next_measurement(task, zip([1, 4], readings, strict=True)).belief
    rows = np.array([np.kron(np.eye(2), [1.0, AT[i, 0]]) for i in (1, 4)])
    mean, spread = normal_posterior(rows, readings, 1.0, covariance)
    for number, one in enumerate(estimates(task, belief).values()):
        std = spread[number, number] ** 0.5
        assert one.mean == pytest.approx(mean[number], abs=0.12 * std)
        assert one.width == pytest.approx(2 * 1.96 * std, rel=0.12)
    with pytest.raises(
        ValueError, match=r"history\[0\]: outcome must have shape \(2,\)"
    ):
        next_measurement(task, [(0, 1.0)])


def peak(u, theta):
    centre, height, base = theta
    return base + height / (1.0 + ((u[0] - centre) / 0.15) ** 2)


def drawn(z):
    below = jax.scipy.stats.norm.cdf(z)
    height = -jnp.log1p(-jnp.minimum(below[1], 1.0 - 1e-6))
    return jnp.stack([2.0 + 2.0 * below[0], height, 2.0 * below[2] - 1.0])


class InNumpy:
    """The peak as a model in numpy, one command at a time."""

    names = ("centre", "height", "base")
    nominal = np.array([3.0, 1.0, 0.0])
    num_inputs = num_outputs = 1

    def predict(self, commands, parameters=None):
        return np.array([[float(peak(u, parameters))] for u in commands])

    def jacobian(self, commands, parameters=None):
        raise AssertionError("a particle task asks for predictions only")

    command_jacobian = jacobian


def of_peak(model, **more):
    return ParticleTask.of(
        model, drawn, Noise(std=0.2), SETTINGS, measurements=6, particles=32,
        contrasts=20, moves=1, **more,
    )  # fmt: skip


NAMES = ["centre", "height", "base"]
IN_JAX = FromJax(peak, [3.0, 1.0, 0.0], names=NAMES)


@pytest.mark.slow
def test_a_model_in_numpy_is_measured_as_the_same_in_jax():
    history = [(3, 1.2)]
    found = [next_measurement(of_peak(model), history) for model in (IN_JAX, InNumpy())]
    assert found[0].design == found[1].design
    assert found[0].gain == pytest.approx(float(found[1].gain), abs=1e-4)
    known = [estimates(of_peak(IN_JAX), one.belief)["centre"].mean for one in found]
    assert known[0] == pytest.approx(known[1], abs=1e-3)


@pytest.mark.slow
def test_a_loop_with_a_budget_that_is_killed_goes_on(tmp_path):
    task = of_peak(IN_JAX, seconds=9.0, cost=[1, 2, 3, 1, 2, 3, 1])
    truth = np.array([2.7, 2.0, 0.3])

    def measure(proposal):
        assert proposal.seconds <= float(proposal.session.seconds) + 1e-4
        return float(peak(proposal.coordinates, truth))

    whole = run(task, None, measure)
    kept = tmp_path / "session.jsonl"

    def breaks(proposal):
        if proposal.number == 2:
            raise OSError("the cable")
        return measure(proposal)

    with pytest.raises(OSError, match="the cable"):
        run(task, None, breaks, journal=kept)
    again = run(task, None, measure, journal=kept)
    assert [(int(a), float(y)) for a, y in again.history] == [
        (int(a), float(y)) for a, y in whole.history
    ]
    other = of_peak(FromJax(lambda u, t: peak(u, t) + 0.1, [3.0, 1.0, 0.0], NAMES))
    with pytest.raises(ValueError, match="another task"):
        run(other, None, measure, journal=kept)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"prior": Prior({"centre": 1.0})}, "height, base cannot be drawn"),
        ({"prior": lambda z: z[:2]}, r"prior must return \(3,\) finite parameters"),
        ({"noise": None}, "noise is missing"),
        ({"noise": Noise(std=1.0, command_std=np.inf)}, "command_std must be finite"),
        ({"cost": [1.0, 2.0]}, r"cost must be one number or \(7,\), got \(2,\)"),
        ({"candidates": np.full((2, 1), np.nan)}, "must be finite"),
        ({"measurements": 0}, "horizon must be at least 1"),
    ],
)
def test_what_is_wrong_is_named(change, message):
    given = {
        "model": IN_JAX, "prior": drawn, "noise": Noise(std=0.2),
        "candidates": SETTINGS, "measurements": 3, "particles": 20, "contrasts": 5,
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        ParticleTask.of(**given | change)
