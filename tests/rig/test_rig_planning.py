"""What a session visits, and in which order; nothing moves."""

import itertools
import warnings

import numpy as np
import pytest
from harness import (
    changed,
    fast_config,
    fast_text,
    measured_text,
)

import jaxcal
from rig.config import example_text, parse_config
from rig.identification.conclusion import held_out_errors
from rig.procedures.plan import (
    choose,
    draw,
    draw_held_out,
    travel_order,
)
from rig.procedures.verify import _command


@pytest.mark.slow
def test_the_shipped_policy_makes_the_default_choice():
    """Not its stand-in: a session without a configuration selects with the policy."""
    config = parse_config(example_text("simulate"))
    candidates = config.to_deg(draw(config, config.session.candidates))
    choice = choose(config, candidates)
    assert (choice.method, choice.note, choice.proven) == ("policy", "", True)
    alone = jaxcal.select(candidates, 4, method="policy")
    assert sorted(choice.indices) == sorted(alone.indices.tolist())
    assert choice.efficiency > 0.95


def test_without_a_checkpoint_the_choice_is_the_exact_optimum(tmp_path, monkeypatch):
    from jaxcal.learning.runtime import weights

    config = parse_config(example_text("simulate"))
    candidates = config.to_deg(draw(config, config.session.candidates))
    monkeypatch.setattr(weights, "shipped", lambda: tmp_path / "none.npz")
    choice = choose(config, candidates)
    assert (choice.method, choice.efficiency) == ("exact", 1.0)
    assert "no policy could be used" in choice.note


def test_the_policys_place_is_taken_by_exact_when_it_is_missing_or_poor(monkeypatch):
    config = parse_config(fast_text(session=""))
    candidates = config.to_deg(draw(config, config.session.candidates))
    real = jaxcal.select

    def poor(points, k, method="policy", **options):
        if method != "policy":
            return real(points, k, method=method, **options)
        return real(points, k, method="random", **options)

    def absent(points, k, method="policy", **options):
        if method == "policy":
            raise FileNotFoundError("no checkpoint\nanywhere")
        return real(points, k, method=method, **options)

    best = float(real(candidates, 4, method="exact").log_det)
    for stand_in, part in ((poor, "D-efficiency of"), (absent, "no checkpoint")):
        monkeypatch.setattr(jaxcal, "select", stand_in)
        choice = choose(config, candidates)
        assert choice.log_det == pytest.approx(best)
        assert part in choice.note and "\n" not in choice.note


@pytest.mark.parametrize(
    "method",
    [
        "auto", "exact", "greedy", "random",
        pytest.param("exchange", marks=pytest.mark.slow),  # compiles for ten seconds
    ],
)  # fmt: skip
def test_every_method_of_a_session_makes_a_choice(method):
    text = f'\n[session]\nmethod = "{method}"\nmin_efficiency = 0.01\nseed = 3\n'
    config = parse_config(fast_text(session=text))
    degrees = config.to_deg(draw(config, config.session.candidates))
    best = jaxcal.select(degrees, 4, method="exact")
    choice = choose(config, degrees)
    assert choice.method == ("exact" if method == "auto" else method)
    assert choice.log_det <= best.log_det + 1e-9
    if method in ("auto", "exact"):
        assert choice.log_det == pytest.approx(best.log_det)
    assert ("proved" in choice.note) == (method == "auto")


@pytest.mark.parametrize("least", [0.5, 1.0])
def test_auto_answers_within_the_efficiency_asked_for(least):
    text = f'\n[session]\nmethod = "auto"\nmin_efficiency = {least}\n'
    config = parse_config(fast_text(session=text))
    degrees = config.to_deg(draw(config, config.session.candidates))
    best = jaxcal.select(degrees, 4, method="exact")
    choice = choose(config, degrees)
    assert choice.efficiency >= least - 1e-9
    assert choice.best_log_det == pytest.approx(best.log_det)


def test_travel_order_takes_the_least_time(rng):
    speeds = {"pitch": 10.0, "yaw": 20.0, "roll": 5.0}
    plain = fast_config()
    axes = (
        changed(axis, speed_deg_s=speeds[axis.name], accel_deg_s2=50.0)
        for axis in plain.axes
    )
    config = changed(plain, axes=tuple(axes))
    points = rng.uniform(-20, 20, size=(12, 3))

    def seconds(order, points=points):
        """Trapezoid profiles, the slowest axis sets the time; written apart."""
        path = np.vstack([np.zeros(3), points[list(order)]])
        ways, total = np.abs(np.diff(path, axis=0)), 0.0
        for way in ways:
            total += max(
                d / v + v / 50.0 if d > v * v / 50.0 else 2 * np.sqrt(d / 50.0)
                for d, v in zip(way, speeds.values(), strict=True)
            )
        return total

    order = travel_order(config, points, np.zeros(3))
    assert sorted(order) == list(range(12))
    assert seconds(order) < seconds(range(12))
    few = points[:5]
    best = min(seconds(o, few) for o in itertools.permutations(range(5)))
    found = travel_order(config, few, np.zeros(3))
    assert seconds(found, few) == pytest.approx(best)
    for count in (14, 201):  # above 12 improved, above 200 as given
        many = travel_order(config, rng.uniform(-20, 20, (count, 3)), np.zeros(3))
        assert sorted(many) == list(range(count))
    assert travel_order(config, np.empty((0, 3)), np.zeros(3)) == []


def test_targets_that_are_drawn_and_not_visited_are_not_warned_of(rng):
    """Most are out of what the machine reaches: eighteen lines of one session."""
    config = parse_config(example_text("simulate"))
    u = rng.uniform(-20, 20, (6, 3))
    calibration = jaxcal.identify(u, 0.3 * u + [3.1, -5.8, 2.4])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        held = draw_held_out(config, calibration, 4)
    assert len(held) == 4
    for target, command in held:
        reached = 0.3 * config.to_deg(command) + [3.1, -5.8, 2.4]
        np.testing.assert_allclose(reached, config.to_deg(target), atol=0.01)


def test_of_more_numbers_than_axes_targets_are_what_the_calibration_says(rng):
    """Two translations, three gauges: there is no measurement that equals a command."""
    axes = {"x": "translation", "y": "translation"}
    names = measured_text(axes).replace("['x', 'y']", "['a', 'b', 'c']")
    config = parse_config(names)
    matrix, bias = np.array([[1.0, 0.1], [0.0, 0.9], [0.5, -0.3]]), np.arange(3.0)
    u = rng.uniform(-20, 20, (6, 2))
    calibration = jaxcal.identify(u, u @ matrix.T + bias)
    held = draw_held_out(config, calibration, 3)
    assert len(held) == 3
    off = np.array([0.0, 0.02, 0.0])
    records = {
        f"{role}:{i}": {
            "commanded_deg": config.to_deg(pulses).tolist(),
            "measured_deg": (matrix @ config.to_deg(pulses) + bias + off).tolist(),
        }
        for i, pair in enumerate(held)
        for role, pulses in zip(("before", "after"), pair, strict=True)
    }
    _, errors = held_out_errors(config, held, records, calibration)
    assert errors["after"]["max"] == pytest.approx(0.02, abs=2e-3)
    near = matrix @ [3.0, -4.0] + bias + np.cross(*matrix.T)  # nothing reaches it
    command = _command(config, calibration, near)
    np.testing.assert_allclose(command, [3.0, -4.0], atol=1e-9)
