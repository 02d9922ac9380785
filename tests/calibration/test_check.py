"""Is a calibration still right: false alarms, power, and what cannot be told."""

from __future__ import annotations

import contacts
import numpy as np
import pytest
from scipy import stats

import jaxcal
from jaxcal.arms.sensors import Socket
from jaxcal.models import SerialChain

from ..models.arms import ur5

ARM = ur5()
RNG = np.random.default_rng(0)
JOINTS = RNG.uniform(-120.0, 120.0, (60, 6))
PRIOR = ARM.default_prior()
TRUTH = ARM.nominal + np.asarray(PRIOR.std) * RNG.normal(size=39) * 0.5
NOISE = 0.05
MEASURED = ARM.predict(JOINTS, TRUTH) + NOISE * RNG.normal(size=(60, 3))
FOUND = jaxcal.identify(JOINTS, MEASURED, model=ARM, noise_std=NOISE)
WHOLE = FOUND.whole  # with the harmonics of its joints


def _new(theta, count, seed):
    rng = np.random.default_rng(seed)
    joints = rng.uniform(-120.0, 120.0, (count, 6))
    return joints, ARM.predict(joints, theta) + NOISE * rng.normal(size=(count, 3))


@pytest.mark.slow
def test_false_alarms_are_five_in_a_hundred():
    alarms = [FOUND.check(*_new(TRUTH, 4, seed)).says == "does not hold"
              for seed in range(400)]  # fmt: skip
    low, high = stats.binom.interval(0.999, 400, 0.05)
    assert low <= sum(alarms) <= high


@pytest.mark.slow
def test_a_drift_of_the_size_it_states_is_seen_four_times_in_five():
    joints, _ = _new(TRUTH, 4, 0)
    rng = np.random.default_rng(1)
    said = FOUND.check(joints, FOUND.predict(joints))
    # The truth is where the calibration says it may be.
    truths = rng.multivariate_normal(FOUND.parameters, FOUND.covariance, 200)
    low, high = stats.binom.interval(0.999, 200, 0.8)
    for name in ("theta2", "a3", "theta5"):
        seen = 0
        for truth in truths:
            drifted = truth.copy()
            drifted[ARM.names.index(name)] += said.drift[name]
            measured = ARM.predict(joints, drifted) + NOISE * rng.normal(size=(4, 3))
            seen += FOUND.check(joints, measured).says == "does not hold"
        assert low <= seen <= high, (name, seen)


def test_the_power_that_is_printed_is_that_of_simulated_changes():
    """Mean over all parameters, each drawn as a change by the tolerance."""
    joints, _ = _new(TRUTH, 3, 0)
    tolerance = 0.12
    said = FOUND.check(joints, FOUND.predict(joints), tolerance=tolerance)
    assert f"(power {said.power:.0%})" in str(said)
    rng = np.random.default_rng(1)
    slopes = WHOLE.jacobian(JOINTS, FOUND.estimate)[..., :39]
    moves = np.sqrt((slopes**2).sum(axis=1).mean(axis=0))
    seen = []
    truths = rng.multivariate_normal(FOUND.estimate, FOUND.joint_covariance, 300)
    for k, truth in enumerate(truths):
        at = [i for i in range(39) if moves[i] > 0.0][k % int((moves > 0.0).sum())]
        drifted = truth.copy()
        drifted[at] += tolerance / moves[at]
        measured = WHOLE.predict(joints, drifted) + NOISE * rng.normal(size=(3, 3))
        seen.append(FOUND.check(joints, measured).says == "does not hold")
    low, high = stats.binom.interval(0.999, 300, said.power)
    assert low <= sum(seen) <= high


def test_a_slip_is_named_with_its_size_where_it_explains_the_readings():
    joints, still = _new(TRUTH, 6, 11)
    for name in ("theta2", "theta3", "theta5"):
        slipped = TRUTH.copy()
        slipped[ARM.names.index(name)] -= 0.1
        told = FOUND.check(joints, still + ARM.predict(joints, slipped)
                           - ARM.predict(joints, TRUTH))  # fmt: skip
        what, _, size, unit = told.slipped.split()
        assert (what, unit) == (name, "deg") and abs(float(size) + 0.1) < 0.03
        assert f"a change of {told.slipped} would explain it" in str(told)
    rough = still + np.random.default_rng(0).normal(0.0, 1.0, still.shape)
    assert FOUND.check(joints, rough).slipped == ""
    assert FOUND.check(joints, still).slipped == ""


def test_what_one_posture_cannot_tell_is_said():
    joints, measured = _new(TRUTH, 1, 3)
    result = FOUND.check(joints, measured, tolerance=0.02)
    assert result.says == "cannot be told" and result.unseen
    assert "inconclusive: too few" in str(result) and "could be hidden in" in str(
        result
    )
    many = FOUND.check(*_new(TRUTH, 40, 5), tolerance=5.0)
    assert many.says == "holds" and not many.unseen
    assert str(many).startswith("the calibration holds (p = ")


def test_three_chosen_postures_see_what_six_random_ones_see():
    candidates = np.random.default_rng(7).uniform(-120.0, 120.0, (200, 6))
    chosen = FOUND.verification(candidates, 3)
    assert len(set(chosen)) == 3
    slopes = ARM.jacobian(JOINTS, FOUND.parameters)
    moves = np.sqrt((slopes**2).sum(axis=1).mean(axis=0))  # of the tip, mm a unit

    def worst(rows):
        """Largest drift of the tip, of one parameter, that is seen with power 0.8."""
        said = FOUND.check(candidates[rows], FOUND.predict(candidates[rows])).drift
        pairs = zip(said.items(), moves, strict=True)
        return max(size * move for (_, size), move in pairs if move > 0.0)

    rng = np.random.default_rng(8)
    six = [worst(rng.choice(200, 6, replace=False)) for _ in range(50)]
    three = [worst(rng.choice(200, 3, replace=False)) for _ in range(50)]
    assert worst(chosen) <= 1.05 * np.median(six)
    assert worst(chosen) <= np.quantile(three, 0.05)


def test_the_affine_device_is_checked_too():
    rng = np.random.default_rng(0)
    commands = rng.uniform(0.0, 1.0, (8, 3))
    found = jaxcal.identify(commands, commands + 0.01 * rng.normal(size=(8, 3)))
    new = rng.uniform(0.0, 1.0, (3, 3))
    assert found.check(new, found.predict(new)).says != "does not hold"
    assert found.check(new, found.predict(new) + 0.2).says == "does not hold"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["panda_1", "kuka_14"])
def test_a_drift_it_states_is_seen_at_real_contacts(name):
    """Of a few contacts the noise is uncertain too, and misfit may not be there."""
    joints, sockets = contacts.load(name)["front"]
    table, seen = np.column_stack([joints, sockets]), []
    for seed in range(4):
        rows = np.random.default_rng(seed).permutation(len(table))
        found = contacts.identify(name, (joints, sockets), rows[:14])
        new = table[rows[14:18]]
        slopes = found.model.jacobian(new, found.parameters)
        drifts = found.check(new, np.zeros((4, 3))).drift
        for at, drift in drifts.items():
            if np.isfinite(drift):
                moved = drift * slopes[..., found.names.index(at)]
                for by in (-1.0, 1.0):
                    seen.append(found.check(new, by * moved).p_value < 0.05)
    assert 0.7 <= np.mean(seen) <= 0.97


def test_contacts_are_checked_as_they_are_fitted():
    joints, sockets = contacts.load("kuka_14")["front"]
    table = np.column_stack([joints, sockets])
    found = contacts.identify("kuka_14", (joints, sockets), np.arange(40))
    once = found.check(table[40:43], np.zeros((3, 3)))
    twice = found.check(table[[40, 41, 42, 41]], np.zeros((4, 3)))
    assert twice == once
    with pytest.raises(ValueError, match="are they radians"):
        found.check(
            np.column_stack([np.radians(joints), sockets])[:3], np.zeros((3, 3))
        )
    with pytest.raises(ValueError, match="are they radians"):
        found.verification(np.column_stack([np.radians(joints), sockets]), 3)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((JOINTS[:2], MEASURED[:3]), "as many rows as commands, got"),
        ((JOINTS[:2], MEASURED[:2, :2]), r"measured must have shape \(2, 3\)"),
        ((JOINTS[:0], MEASURED[:0]), "commands must hold at least one row, got none"),
        ((JOINTS[:2], MEASURED[:2], 0.0), "tolerance must be positive"),
        ((JOINTS[:2], MEASURED[:2], None, True), "placed_anew needs sockets"),
    ],
)
def test_bad_input_is_named(given, message):
    commands, measured, *rest = given
    options = dict(zip(("tolerance", "placed_anew"), rest, strict=False))
    with pytest.raises(ValueError, match=message):
        FOUND.check(commands, measured, **options)


@pytest.mark.parametrize("factor", [1000.0, 0.001, 57.29577951, 0.01745329252])
def test_readings_in_another_unit_are_named(factor):
    rng = np.random.default_rng(5)
    u = rng.uniform(-20.0, 20.0, (30, 3))
    y = u @ np.diag([0.4, 0.7, 0.9]) + 3.0 + rng.normal(0.0, 0.01, (30, 3))
    found = jaxcal.identify(u, y, measured_unit="mm")
    with pytest.raises(
        ValueError, match=r"calibration's unit \(mm\): y_x, y_y, y_z fit"
    ):
        found.check(u[:5], factor * y[:5])
    mixed = y[:5] * [1.0, 1.0, factor]  # of one output alone
    with pytest.raises(ValueError, match=r"calibration's unit \(mm\): y_z fit when"):
        found.check(u[:5], mixed)
    assert " mm (power " in str(found.check(u[:5], y[:5]))
    # Far off, but by no unit: a verdict, not a refusal.
    said = str(found.check(u[:5], y[:5] + 300.0))
    assert said.startswith("the calibration does not hold")
    assert said.endswith("then calibrate again (identify)")
    rng.shuffle(y)
    assert found.check(u[:5], 900.0 * y[:5]).says == "does not hold"


@pytest.mark.parametrize(("outputs", "count"), [(1, 5), (3, 5), (3, 6), (3, 12)])
def test_p_value_and_power_with_few_degrees_of_freedom(outputs, count):
    """The noise of each output came from a few residuals, and the truth is drawn so."""
    rng, draws = np.random.default_rng(10 * outputs + count), 20_000
    commands, again = rng.uniform(-1.0, 1.0, (count, 2)), rng.uniform(-1.0, 1.0, (3, 2))
    noise = 0.1 * np.arange(1, outputs + 1) * rng.normal(size=(count, outputs))
    measured = commands @ rng.normal(size=(2, outputs)) + noise
    calibration = jaxcal.identify(commands, measured)

    design, new = (np.column_stack([u, np.ones(len(u))]) for u in (commands, again))
    inverse, dof = np.linalg.inv(design.T @ design), count - 3
    estimate = inverse @ design.T @ measured
    std = np.sqrt(((measured - design @ estimate) ** 2).sum(axis=0) / dof)
    root = np.linalg.cholesky(new @ inverse @ new.T + np.eye(3))

    def p_values(off):
        """Of differences (..., 3, outputs): each output by itself, then by Sidak."""
        square = (np.linalg.solve(root, off) ** 2).mean(axis=-2) / std**2
        return 1.0 - (1.0 - stats.f.sf(square, 3, dof).min(axis=-1)) ** outputs

    off = std * rng.normal(size=(3, outputs))
    result = calibration.check(again, new @ estimate + off)
    assert result.p_value == pytest.approx(p_values(off), rel=1e-9)
    true = std * np.sqrt(dof / rng.chisquare(dof, (draws, outputs)))
    off = (root @ rng.normal(size=(draws, 3, outputs))) * true[:, None]
    column, output = rng.integers(3, size=draws), rng.integers(outputs, size=draws)
    change = result.tolerance / np.sqrt((design**2).mean(axis=0))
    off[np.arange(draws), :, output] += (new * change).T[column]
    assert result.power == pytest.approx((p_values(off) < 0.05).mean(), abs=0.012)


@pytest.mark.slow
@pytest.mark.parametrize("count", [5, 16])
def test_false_alarms_are_five_in_a_hundred_whatever_the_degrees_of_freedom(count):
    """Of three outputs with a noise each; one F test of all has .10 and .03."""
    rng, alarms = np.random.default_rng(count), 0
    for _ in range(1000):
        commands, again = (rng.uniform(0.0, 1.0, (n, 3)) for n in (count, 3))
        found = jaxcal.identify(commands, commands + 0.1 * rng.normal(size=(count, 3)))
        alarms += (
            found.check(again, again + 0.1 * rng.normal(size=(3, 3))).p_value < 0.05
        )
    low, high = stats.binom.interval(0.999, 1000, 0.05)
    assert low <= alarms <= high


def test_contacts_of_sockets_placed_anew_hold_where_enough_of_them_say_so():
    """A shift and a turn about the vertical of the whole arm are the sockets' too."""
    commands = np.column_stack(contacts.load("kuka_14")["left_back"])
    commands = commands[np.random.default_rng(2).permutation(len(commands))]
    zeros = np.zeros((len(commands), 3))
    arm = contacts.arm("kuka_14")
    found = jaxcal.identify(commands[:24], zeros[:24], model=arm)
    told = found.check(commands[50:56], zeros[50:56], placed_anew=True)
    assert told.says == "cannot be told"
    assert {"d1", "theta1"} <= set(told.blind) and "theta2" not in told.blind
    assert "not checked, because parts were moved: " in str(told)
    assert f"about {told.enough} rows like these in total" in told.next_step
    assert 6 < told.enough <= 36
    rows = commands[24:][: told.enough], zeros[24:][: told.enough]
    assert found.check(*rows, placed_anew=True).says == "holds"


def test_alike_postures_say_nothing_of_sockets_placed_anew():
    """A shift of the socket explains them all: the arm could have drifted anyhow."""
    table = [(0, 90, 90, 0), (-425, 0, 0, 0), (-390, 0, 0, 0)]
    arm = SerialChain.from_dh(table, tool=(0, 0, 31), sensor=Socket(1, [(0, 0, 0)]))
    rng = np.random.default_rng(0)
    joints = rng.uniform(-120.0, 120.0, (30, 3))
    measured = arm.predict(joints) + NOISE * rng.normal(size=(30, 3))
    found = jaxcal.identify(joints, measured, model=arm, noise_std=NOISE)
    alike = joints[0] + rng.uniform(-0.01, 0.01, (4, 3))
    told = found.check(alike, arm.predict(alike) + 3.0, placed_anew=True)
    assert told.says == "cannot be told" and told.power < 0.05
    assert told.blind == ("d1",)  # along the vertical, as the socket's own z
    assert {"theta1", "theta2", "theta3", "a2", "a3"} <= set(told.unseen)
