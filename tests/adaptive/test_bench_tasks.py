"""Backlash, dead zone and transmission error, against the mechanism played."""

import pathlib

import jax
import numpy as np
import pytest
from tasks.backlash import Bins, backlash, backlash_bins, dead_zone, dead_zone_bins
from tasks.transmission import transmission_error

from jaxcal.adaptive.episodes import compare, play
from jaxcal.adaptive.grid import GridBelief
from jaxcal.adaptive.loop import estimates, next_measurement, run
from jaxcal.adaptive.rules import Gain, Random
from jaxcal.adaptive.tasks import registry

TASKS = pathlib.Path(__file__).parents[2] / "examples" / "tasks"
SMALL = {"cells": 10, "offset_cells": 4, "bin_width": 0.1, "outliers": 0.0}


def play_operator(path, width):
    """Where a joint with play stands after its drive went along a path."""
    drive = joint = path[0]
    for target in path[1:]:
        for at in np.linspace(drive, target, 200):
            joint = min(max(joint, at - width / 2), at + width / 2)
        drive = target
    return joint


def test_backlash_is_the_play_operator_with_noise():
    task = backlash(1.0, 0.1, sigma=0.07, **SMALL)
    bins = backlash_bins(1.0, 0.1, 0.1)
    rng = np.random.default_rng(0)
    designs, theta = np.asarray(task.designs), np.asarray(task.theta)
    table = np.asarray(task.likelihood)
    for _ in range(25):
        a, s = rng.integers(len(designs)), rng.integers(len(theta))
        (posture, direction), (width, offset) = designs[a], theta[s]
        path = [-9.0 * direction, 3.0 * direction, 0.0, posture * direction]
        joint = play_operator(path, width)
        read = joint + offset - direction * posture + rng.normal(0, 0.07, 4000)
        seen = np.bincount([bins.outcome(r) for r in read], minlength=bins.count) / 4000
        expected = table[a, :, s]
        error = np.sqrt(expected * (1 - expected) / 4000)
        assert (np.abs(seen - expected) < 5.0 * error + 2e-3).all()


def test_dead_zone_is_the_mechanism_with_noise():
    task = dead_zone(sigma=0.07, outliers=0.0, cells=10, offset_cells=5)
    bins = dead_zone_bins(1.0, 1.0, 0.05)
    rng = np.random.default_rng(1)
    commands, theta = np.asarray(task.designs)[:, 0], np.asarray(task.theta)
    table = np.asarray(task.likelihood)
    for _ in range(20):
        a, s = rng.integers(len(commands)), rng.integers(len(theta))
        width, centre = theta[s]
        u, low, high = commands[a], centre - width / 2, centre + width / 2
        joint = u - high if u > high else u - low if u < low else 0.0
        read = joint + rng.normal(0, 0.07, 4000)
        seen = np.bincount([bins.outcome(r) for r in read], minlength=bins.count) / 4000
        expected = table[a, :, s]
        error = np.sqrt(expected * (1 - expected) / 4000)
        assert (np.abs(seen - expected) < 5.0 * error + 2e-3).all()


def test_bins_sum_to_one_and_know_their_readings():
    bins = Bins(-1.0, 1.0, 8)
    table = bins.likelihood([[-30.0, 0.1, 5.0]], 0.01, outliers=0.08)
    np.testing.assert_allclose(table.sum(axis=1), 1.0)
    assert [bins.outcome(r) for r in (-30.0, 0.1, 5.0)] == [0, 4, 7]
    assert table[0].argmax(axis=0).tolist() == [0, 4, 7]
    assert table.min() == pytest.approx(0.01)
    with pytest.raises(ValueError, match="sigma"):
        bins.likelihood([[0.0]], 0.0)
    with pytest.raises(ValueError, match="low under high"):
        Bins(1.0, 1.0, 3)


def test_a_loop_finds_the_width_of_a_played_mechanism():
    task = backlash(sigma=0.01, bin_width=0.02)
    bins = backlash_bins(1.0, 0.1, 0.02)
    rng = np.random.default_rng(3)
    width, offset = 0.437, -0.036

    def measure(proposal):
        posture, direction = proposal.coordinates
        path = [-9.0 * direction, 9.0 * direction, 0.0, direction * posture]
        joint = play_operator(path, width) + offset + rng.normal(0.0, 0.01)
        return bins.outcome(joint - direction * posture)

    finished = run(task, Gain(), measure, uses=10)
    found = estimates(task, finished.belief)
    assert found["width"].low < width < found["width"].high
    assert found["offset"].low < offset < found["offset"].high
    assert found["width"].width < 0.06


def test_intervals_of_the_prior_are_its_quantiles():
    task = backlash(sigma=0.05, **SMALL)
    prior = estimates(task, next_measurement(task).belief, level=0.5)
    assert prior["width"].mean == pytest.approx(0.5)
    assert prior["width"].low == pytest.approx(0.25)
    assert prior["width"].high == pytest.approx(0.75)
    assert prior["offset"].low == pytest.approx(-0.05, abs=1e-6)
    with pytest.raises(ValueError, match="level"):
        estimates(task, next_measurement(task).belief, level=1.0)


def test_intervals_hold_as_often_as_they_say():
    """Truths anywhere in their cells; posteriors by the definition, float64."""
    task = backlash(sigma=0.05, measurements=4, **SMALL)
    episodes = play(task, Gain(), jax.random.split(jax.random.key(0), 400))
    table = np.asarray(task.likelihood, np.float64)
    designs, outcomes = np.asarray(episodes.designs), np.asarray(episodes.outcomes)
    rng = np.random.default_rng(4)
    widths = np.asarray(task.theta)[np.asarray(episodes.truth), 0]
    held = 0
    for row, width in enumerate(widths + rng.uniform(-0.05, 0.05, 400)):
        weights = np.asarray(task.prior) * table[designs[row], outcomes[row]].prod(0)
        found = estimates(task, GridBelief(weights / weights.sum()), level=0.8)["width"]
        held += found.low < width < found.high
    assert held / 400 == pytest.approx(0.8, abs=4.0 * (0.8 * 0.2 / 400) ** 0.5)


@pytest.mark.parametrize(
    "task",
    [
        backlash(sigma=0.05, measurements=4, **SMALL),
        dead_zone(cells=8, offset_cells=4, num_postures=9, measurements=4),
        transmission_error(cells=8, phases=4, num_postures=13, measurements=4),
    ],
    ids=["backlash", "dead zone", "transmission"],
)
def test_three_estimators_agree(task):
    found = compare(task, {"gain": Gain(), "random": Random()}, 768, batch=768)
    for other in (found.entropy_drop, found.log_ratio):
        difference = other - found.gain
        error = difference.std(axis=1, ddof=1) / np.sqrt(768)
        assert (np.abs(difference.mean(axis=1)) < 4.0 * error).all()
    mean, error = found.paired("gain", "random")
    assert mean > 2.0 * error


def test_transmission_error_is_a_sine():
    task = transmission_error(sigma=0.02, num_bins=60)
    theta, at = np.asarray(task.theta), np.asarray(task.designs)[:, 0]
    s, a = 333, 17
    frequency, amplitude, phase = theta[s]
    expected = amplitude * np.sin(2 * np.pi * frequency * at[a] + phase)
    centres = -1.04 + 2.08 * (np.arange(60) + 0.5) / 60
    p = np.asarray(task.likelihood)[a, :, s]
    assert p @ centres == pytest.approx(expected, abs=5e-3)


pytestmark = pytest.mark.slow  # minutes together


def test_each_is_a_file_that_commands_take():
    for name in ("backlash", "dead_zone", "transmission"):
        entry = registry.load(str(TASKS / f"{name}.py"))
        assert entry.about and len(entry.make().designs)
    with pytest.raises(ValueError, match=r"one of knee, or .* examples/tasks do, got"):
        registry.load("backlash")
