"""x from y: ``Calibration.inverse`` against formulas, brute force and simulation."""

import numpy as np
import pytest
from scipy import stats

import jaxcal
from jaxcal.calibration import Source
from jaxcal.models import Affine, Polynomial


def _line(rng, count=10, slope=2.0, noise=0.3, repeats=1):
    x = np.linspace(0.0, 10.0, count)
    y = 1.0 + slope * x + rng.normal(0.0, noise, count)
    return x, y, jaxcal.identify(x[:, None], y[:, None])


@pytest.mark.parametrize("repeats", [1, 3])
def test_a_straight_line_has_fiellers_interval(repeats):
    """Draper and Smith's formula of inverse estimation, from sums of the data."""
    x, y, calibration = _line(np.random.default_rng(1))
    reading = 9.3
    n, mean = len(x), x.mean()
    sxx = ((x - mean) ** 2).sum()
    slope = ((x - mean) * y).sum() / sxx
    offset = y.mean() - slope * mean
    s = np.sqrt(((y - offset - slope * x) ** 2).sum() / (n - 2))
    t = stats.t.ppf(0.975, n - 2)
    guess = (reading - offset) / slope
    g = t**2 * s**2 / (slope**2 * sxx)
    middle = mean + (guess - mean) / (1 - g)
    half = (
        t * s / slope / (1 - g)
        * np.sqrt((guess - mean) ** 2 / sxx + (1 - g) * (1 / repeats + 1 / n))
    )  # fmt: skip
    answer = calibration.inverse(reading, repeats)
    np.testing.assert_allclose(answer.commands, [guess])
    np.testing.assert_allclose(answer.interval, [[middle - half, middle + half]])
    delta = s / slope * np.sqrt(1 / repeats + 1 / n + (guess - mean) ** 2 / sxx)
    np.testing.assert_allclose(answer.std, [delta])
    assert answer.method == ("Fieller",)


def test_where_the_slope_may_be_zero_the_interval_is_deltas_and_says_so():
    _, _, calibration = _line(np.random.default_rng(3), 5, 0.05, 0.3)
    answer = calibration.inverse([[1.2]])
    assert answer.method == ("delta",) and "delta" in str(answer)
    half = stats.t.ppf(0.975, 3) * answer.std[0, 0]
    np.testing.assert_allclose(np.ptp(answer.interval), 2 * half)


@pytest.mark.parametrize("repeats", [1, 4])
def test_intervals_of_a_line_hold_the_command_as_often_as_promised(repeats):
    rng, hits, trials = np.random.default_rng(5), 0, 600
    for _ in range(trials):
        _, _, calibration = _line(rng, 6)
        command = rng.uniform(0.0, 10.0)
        reading = 1.0 + 2.0 * command + rng.normal(0.0, 0.3, repeats).mean()
        low, high = calibration.inverse(reading, repeats).interval[0]
        hits += low <= command <= high
    assert 0.93 < hits / trials < 0.97


def _parabola(rng):
    """A calibration of y = x^2, a command and a reading there."""
    x = np.linspace(-2.0, 2.0, 12)
    y = x**2 + rng.normal(0.0, 0.1, len(x))
    calibration = jaxcal.identify(x[:, None], y[:, None], model=Polynomial(2, 1, 1))
    command = rng.uniform(-2.0, 2.0)
    return calibration, command, command**2 + rng.normal(0.0, 0.1)


@pytest.mark.parametrize("seed", range(4))
def test_where_the_curve_bends_the_pieces_are_those_of_a_fine_grid(seed):
    calibration, _, reading = _parabola(np.random.default_rng(seed))
    pieces = calibration.inverse(reading).pieces[0]
    grid = np.linspace(-3.0, 3.0, 6001)[:, None]
    low, high = calibration.predict_interval(grid, new_measurement=True)
    inside = ((low <= reading) & (reading <= high))[:, 0]
    mine = ((pieces[:, 0] <= grid) & (grid <= pieces[:, 1])).any(axis=1)
    assert inside.any() and (inside != mine).sum() <= 2 * len(pieces)


@pytest.mark.slow
def test_the_pieces_hold_the_command_as_often_as_promised():
    rng, hits, trials, unions = np.random.default_rng(7), 0, 400, 0
    for _ in range(trials):
        calibration, command, reading = _parabola(rng)
        pieces = calibration.inverse(reading).pieces[0]
        hits += bool(((pieces[:, 0] <= command) & (command <= pieces[:, 1])).any())
        unions += len(pieces) == 2
    assert abs(hits / trials - 0.95) < 4 * np.sqrt(0.95 * 0.05 / trials)
    assert unions > trials / 2


@pytest.mark.filterwarnings("ignore:.*far outside the measurements")
@pytest.mark.slow
def test_several_inputs_have_first_order_uncertainty_that_holds():
    rng, trials = np.random.default_rng(9), 300
    matrix, bias = np.array([[2.0, 0.3], [-0.4, 1.5]]), np.array([1.0, -2.0])
    hits = np.zeros(2)
    for _ in range(trials):
        u = rng.uniform(-1.0, 1.0, (12, 2))
        y = u @ matrix.T + bias + rng.normal(0.0, 0.02, (12, 2))
        calibration = jaxcal.identify(u, y, common_noise=True)
        command = rng.uniform(-1.0, 1.0, 2)
        reading = matrix @ command + bias + rng.normal(0.0, 0.02, 2)
        answer = calibration.inverse(reading)
        low, high = answer.interval.T
        hits += (low <= command) & (command <= high)
        assert answer.method == ("delta",)
    assert (np.abs(hits / trials - 0.95) < 4 * np.sqrt(0.95 * 0.05 / trials)).all()


def test_the_budget_of_a_command_adds_up_and_a_shared_offset_cancels():
    _, _, calibration = _line(np.random.default_rng(11))
    answer = calibration.inverse([[7.0]], 2)
    budget = calibration.budget(readings=[[7.0]], repeats=2)
    np.testing.assert_allclose(budget.combined, answer.std[0])
    np.testing.assert_allclose(budget.dof, [8.0])
    offset = calibration.budget(readings=[[7.0]], sources=[Source("zero", 0.5)])
    assert offset.contributions[0, -1] == 0.0
    scale = calibration.budget(readings=[[7.0]], sources=[Source("s", scale=0.1)])
    assert scale.contributions[0, -1] < 1e-9  # of the readings, and of the slope


def test_what_cannot_be_inverted_is_refused():
    _, _, calibration = _line(np.random.default_rng(13))
    with pytest.raises(ValueError, match="repeats must be at least 1"):
        calibration.inverse(3.0, 0)
    u = np.random.default_rng(0).uniform(-1, 1, (9, 2))
    two = jaxcal.identify(
        u, u @ [[1.0], [2.0]] + 0.01 * u[:, :1] ** 2, model=Affine(2, 1)
    )
    with pytest.raises(ValueError, match="as many inputs as outputs, got 2 and 1"):
        two.inverse(3.0)
    x = np.linspace(-2.0, 2.0, 9)[:, None]
    wave = 0.01 * np.sin(9 * x)
    bent = jaxcal.identify(x, x**2 + wave, model=Polynomial(2, 1, 1))
    with pytest.raises(ValueError, match="of a command between -3 and 3"):
        bent.inverse(-5.0)


def test_readings_of_a_frame_are_read_by_the_names_of_the_outputs():
    pandas = pytest.importorskip("pandas")
    rng = np.random.default_rng(0)
    u = rng.uniform(-5.0, 5.0, (12, 2))
    y = u @ [[1.1, 0.2], [-0.1, 0.9]] + 0.01 * rng.normal(size=(12, 2))
    calibration = jaxcal.identify(
        pandas.DataFrame(u, columns=["pitch", "roll"]),
        pandas.DataFrame(y, columns=["y_pitch", "y_roll"]),
    )
    by_name = calibration.inverse(pandas.DataFrame({"y_roll": [1.0], "y_pitch": [2.0]}))
    np.testing.assert_allclose(
        by_name.commands, calibration.inverse([[2.0, 1.0]]).commands
    )
