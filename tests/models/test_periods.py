"""Readings that wrap: fits, checks and answers do not see where the circle is cut."""

import dataclasses

import numpy as np
import pytest

import jaxcal
from jaxcal.models import (
    Affine,
    FromFunction,
    FromJax,
    Position,
    Reading,
    Sensor,
    SerialChain,
    Several,
)

TRUTH = np.array([1.03, 0.12, 0.07])
NOISE = jaxcal.Noise([1.0, 0.01])


def seen(u, theta):
    """Degrees and distance of a crank's end."""
    x, y = theta[0] * np.cos(u[0]) + theta[1], theta[0] * np.sin(u[0]) + theta[2]
    return [np.degrees(np.arctan2(y, x)), np.hypot(x, y)]


def turned(by):
    """The same from a circle that is cut elsewhere."""

    def f(u, theta):
        angle, far = seen(u, theta)
        return [(angle - by + 180.0) % 360.0 - 180.0, far]

    return FromFunction(f, [1.0, 0.1, 0.1], periods=[360.0, np.inf])


def readings(by, seed):
    rng = np.random.default_rng(seed)
    u = rng.uniform(-np.pi, np.pi, (12, 1))
    u[:5] = np.pi + 0.07 + rng.normal(0.0, 0.02, (5, 1))  # at 180 degrees
    model = turned(by)
    y = model.predict(u, TRUTH) + rng.normal(size=(12, 2)) * NOISE.std
    y[:, 0] = (y[:, 0] + 180.0) % 360.0 - 180.0
    return model, u, y


@pytest.mark.parametrize("seed", range(3))
def test_everything_is_as_if_the_circle_were_cut_elsewhere(seed):
    """Oracle: the same machine turned by 90 degrees, where no reading is near a cut."""
    (cut, u, y), (whole, _, z) = readings(0.0, seed), readings(90.0, seed)
    assert np.ptp(y[:5, 0]) > 300.0 and np.ptp(z[:5, 0]) < 30.0
    np.testing.assert_allclose(cut.jacobian(u), whole.jacobian(u), atol=1e-6)
    one, other = (
        jaxcal.identify(u, read, model=m, noise=NOISE)
        for m, read in ((cut, y), (whole, z))
    )
    np.testing.assert_allclose(one.parameters, other.parameters, atol=1e-6)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-5)
    np.testing.assert_allclose(one.residuals, other.residuals, atol=1e-4)
    assert np.abs(one.residuals[:, 0]).max() < 5.0
    assert one.check(u, y).p_value == pytest.approx(other.check(u, z).p_value, abs=1e-4)
    # Pointing to -179.99 from a command that reads 179: two degrees, not 358.
    goal = np.array([-179.9, 1.0])[:1]
    near = jaxcal.identify(
        u,
        y[:, :1],
        model=FromFunction(lambda v, t: seen(v, t)[:1], TRUTH, periods=360.0),
        noise=jaxcal.Noise(1.0),
        prior=jaxcal.Prior(0.1),
    )
    command = near.command_for(goal, start=[np.radians(179.0)])
    assert np.abs(command - np.radians(180.0)) < np.radians(15.0)


@pytest.mark.filterwarnings("ignore:f is not smooth")
def test_without_the_period_the_same_readings_do_not_fit():
    _, u, y = readings(0.0, 3)
    blind = FromFunction(seen, [1.0, 0.1, 0.1])
    try:
        fit = jaxcal.identify(u, y, model=blind, noise=NOISE)
    except ValueError as error:
        assert "is not the derivative" in str(error)
    else:
        assert np.abs(fit.residuals[:, 0]).max() > 300.0


@dataclasses.dataclass(frozen=True, eq=False)
class Azimuth(Sensor):
    """Where the tip is about the vertical, degrees, by a camera above."""

    kind = "azimuth"
    outputs = ("azimuth",)
    periods = (360.0,)

    def usual_noise(self, length):
        return 0.1

    def read(self, tip, inputs, own):
        x, y = tip.position[:, 0], tip.position[:, 1]
        slopes = np.zeros((len(x), 1, 6))
        slopes[:, 0, :2] = np.degrees(np.column_stack([-y, x]) / (x**2 + y**2)[:, None])
        angles = np.degrees(np.arctan2(y, x))[:, None]
        return Reading(angles, slopes, np.zeros((len(x), 1, 0)))


def test_a_linear_model_is_fitted_to_readings_that_do_not_wrap_about_zero():
    class Table(Affine):
        periods = np.array([360.0])

    u = np.linspace(0.0, 1.0, 15)[:, None]
    found = jaxcal.identify(u, 300.0 * u + 20.0, model=Table(1, 1))
    np.testing.assert_allclose(found.parameters, [300.0, 20.0])


@pytest.mark.parametrize("several", [False, True])
def test_a_sensor_of_ones_own_may_wrap(several):
    arm = SerialChain.from_dh([[300.0, 0, 0, 0], [200.0, 0, 0, 0]])
    rng = np.random.default_rng(4)
    u = np.column_stack([rng.normal(180.0, 0.5, 30), rng.uniform(-2.0, 2.0, 30)])
    one = arm.measured_with(Azimuth())
    theta = one.nominal.copy()
    at = [one.names.index(name) for name in ("theta1", "theta2")]
    theta[at] = 0.3, -0.4
    y = (one.predict(u, theta) + rng.normal(0, 0.1, (30, 1)) + 180.0) % 360.0 - 180.0
    assert np.ptp(y) > 300.0
    free = {name: 0.5 for name in ("theta1", "theta2")}
    if several:
        arm = arm.measured_with(Several((Position(), Azimuth())))
        u, y = arm.together(
            (u[:2], arm.measured_with(Position()).predict(u[:2])), (u, y)
        )
        one = arm
    held = [name for name in one.names if name not in free]
    fit = jaxcal.identify(
        u, y, model=one, prior=jaxcal.Prior(free, fixed=held), loss="gaussian"
    )
    assert np.abs(fit.residuals).max() < (5.0 if several else 0.5)


def test_periods_are_checked():
    one = FromFunction(seen, [1.0, 0.1, 0.1], periods=[360.0, 0.0])
    with pytest.raises(ValueError, match="periods must be positive"):
        one.predict([[0.0]])
    one = FromFunction(seen, [1.0, 0.1, 0.1], periods=[360.0])
    with pytest.raises(ValueError, match=r"periods must be one number or \(2,\)"):
        one.predict([[0.0]])


@pytest.mark.parametrize("kind", [FromFunction, FromJax])
def test_periods_are_not_known_before_the_first_commands(kind):
    one = kind(lambda u, theta: theta * u, [2.0, 3.0], periods=360.0)
    assert one.periods is None
    one.predict([[1.0]])
    np.testing.assert_array_equal(one.periods, [360.0, 360.0])
