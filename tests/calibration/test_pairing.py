"""A table that was mispaired is told how; a right one is left alone.

The oracle is the spoiling: rows of a right table are moved in a known way, and the
sentence must name it and its row.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
import re
import warnings

import contacts
import fr3
import numpy as np
import positioner
import pytest
import ur5

import jaxcal
from jaxcal.calibration.pairing.fit import (
    Hypothesis,
    Table,
    fitted,
    log_evidence,
    shifted,
)
from jaxcal.calibration.pairing.judge import of_fit
from jaxcal.commands import main
from jaxcal.models import Affine, FromFunction, Linear

MATRIX = np.array([[1.02, 0.05, -0.03], [0.04, 0.97, 0.06], [-0.02, 0.03, 1.01]])
BIAS = np.array([0.4, -0.7, 0.2])
NOISE = 0.05


def _table(seed=0, count=20):
    rng = np.random.default_rng(seed)
    commands = rng.uniform(-10.0, 10.0, (count + 10, 3))
    measured = commands @ MATRIX.T + BIAS + NOISE * rng.normal(size=commands.shape)
    return commands, measured


def _verdict(commands, measured, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return jaxcal.identify(commands, measured, **options)


def _lost(commands, measured, row, count=20):
    """Readings from ``row`` on were taken at the next command."""
    return commands[:count], np.delete(measured, row, axis=0)[:count]


SPOILT = {
    "lost": (
        lambda u, y: _lost(u, y, 12),
        r"from row 12 on.*readings are one row early",
    ),
    "doubled": (
        lambda u, y: (u[:20], np.insert(y, 12, y[11], axis=0)[:20]),
        r"from row 12 on.*readings are one row late",
    ),
    "a command lost": (
        lambda u, y: (np.delete(u, 9, axis=0)[:20], y[:20]),
        r"from row 9 on.*readings are one row late",
    ),
    "two rows late": (
        lambda u, y: (u[2:22], y[:20]),
        "all readings are 2 rows late",
    ),
    "rolled early": (
        lambda u, y: (u[:20], np.roll(y[:20], -3, axis=0)),
        "all readings are 3 rows early.*the first 3 are at the other end",
    ),
    "halves": (
        lambda u, y: (u[:20], np.vstack([y[10:20], y[:10]])),
        "halves of the readings are exchanged: the readings from row 10 on",
    ),
    "reversed": (lambda u, y: (u[:20], y[19::-1]), "in reverse order"),
    "commands sorted": (
        lambda u, y: (u[:20][np.argsort(u[:20, 1])], y[:20]),
        "the commands are sorted and the readings are not",
    ),
    "readings sorted": (
        lambda u, y: (u[:20], y[:20][np.argsort(y[:20, 2])]),
        "the readings are sorted and the commands are not",
    ),
    "a block from elsewhere": (
        lambda u, y: (u[:20], np.vstack([y[:7], y[20:25], y[12:20]])),
        "from row 7 to 11, readings do not belong",
    ),
    "two sessions": (
        lambda u, y: (u[:20], y[:20] + (np.arange(20) >= 13)[:, None]),
        r"from row 13 on the readings have another offset, by \((1|0\.9|1\.0)\d*, ",
    ),
    "another unit": (
        lambda u, y: (u[:20], y[:20] * np.where(np.arange(20) < 11, 1, 0.1)[:, None]),
        "from row 11 on the readings have another slope or offset",
    ),
    "rows exchanged": (
        lambda u, y: (u[:20], y[[*range(5), 14, *range(6, 14), 5, *range(15, 20)]]),
        "the readings of rows 5, 14 are exchanged",
    ),
    "lag": (
        lambda u, y: (u[6:26], y[:20]),
        "all readings are 6 rows late",
    ),
}


@pytest.mark.parametrize("kind", SPOILT)
def test_what_was_spoilt_is_named(kind):
    spoil, pattern = SPOILT[kind]
    for seed in range(4):
        found = _verdict(*spoil(*_table(seed)))
        verdict = found.verdict
        assert not verdict.good
        assert re.search(pattern, verdict.reasons[0]), verdict.reasons[0]
        noise = found.mispairing.noise
        assert (0.4 * NOISE < noise).all() and (noise < 2.0 * NOISE).all()


def test_the_row_is_named_wherever_it_is():
    named = []
    for seed in range(20):
        row = 3 + seed % 14
        found = _verdict(*_lost(*_table(100 + seed), row)).mispairing
        named.append(found is not None and f"from row {row} on" in found.reason)
    assert sum(named) >= 19


def test_sessions_of_another_gain_are_told_of_one_reading():
    """At a residual of five times the noise; as n + 1 parameters 8 of 20 were."""
    named = []
    for seed in range(20):
        rng = np.random.default_rng([3, 1, seed])
        slopes, bias = rng.normal(size=3), rng.normal()
        u, row = rng.uniform(-1.0, 1.0, (20, 3)), rng.integers(6, 15)
        gains = np.where(np.arange(20) < row, 1.0, 1.0 + 0.3 * rng.choice([-1, 1]))
        y = (u @ slopes * gains + bias)[:, None]
        regressors = np.hstack([u, np.ones((20, 1))])
        square = np.linalg.lstsq(regressors, y, rcond=None)[1]
        y += np.sqrt(square / 16.0 / 24.0) * rng.normal(size=y.shape)
        found = _verdict(u, y).mispairing
        named.append(found is not None and "two sessions" in found.reason)
    assert sum(named) >= 17


def _right_tables():
    rng = np.random.default_rng(5)
    for seed in range(12):
        u, y = _table(seed)
        u, y = u[:20], y[:20]
        time = np.linspace(0.0, 1.0, 20)[:, None]
        yield "plain", u, y
        yield "drift", u, y + 2.0 * time
        yield "heteroscedastic", u, y + 0.3 * np.abs(u) * rng.normal(size=y.shape)
        yield "curve", u, y + 0.05 * u[:, :1] ** 2
        outliers = y.copy()
        outliers[rng.integers(20, size=2)] += 20.0
        yield "outliers", u, outliers
        yield "replicated", np.repeat(u[:7], 3, axis=0), np.repeat(y[:7], 3, axis=0)
        yield "few", u[:6], y[:6]
        yield "random walk", u, y + np.cumsum(rng.normal(size=y.shape), axis=0) / 8.0
        sweep = np.linspace(-10.0, 10.0, 20)[:, None]
        yield "sweep", sweep, 1.1 * sweep + 0.02 * sweep**2 + 0.1 * np.sin(sweep)
        yield "noise alone", u, rng.normal(size=y.shape)


def test_right_tables_are_left_alone():
    for kind, u, y in _right_tables():
        found = _verdict(u, y).mispairing
        assert found is None, (kind, found.reason)


def test_exchanged_columns_of_an_affine_machine_change_its_slopes_alone():
    u, y = _table()
    assert _verdict(u[:20, [1, 0, 2]] * (1.0, -1.0, 0.01), y[:20]).mispairing is None


def test_a_noise_that_is_known_and_explains_the_fit_leaves_nothing_to_tell():
    u, y = _lost(*_table(), 12)
    assert _verdict(u, y, noise_std=20.0).mispairing is None
    assert _verdict(u, y, noise_std=NOISE).mispairing is not None


def test_the_mended_table_is_the_right_one():
    u, y = _table()
    found = _verdict(*_lost(u, y, 12)).mispairing
    commands, measured = found.repaired(*_lost(u, y, 12))
    rows = np.delete(np.arange(20), 12)
    np.testing.assert_array_equal(commands, u[rows])
    np.testing.assert_array_equal(measured, y[rows])
    sessions = _verdict(u[:20], y[:20] + (np.arange(20) >= 13)[:, None]).mispairing
    with pytest.raises(ValueError, match="two sessions cannot be repaired"):
        sessions.repaired(u[:20], y[:20])


@pytest.mark.parametrize("kind", ["lost", "doubled", "a command lost"])
def test_a_mended_table_holds_no_pair_that_was_none(kind):
    for seed in range(10):
        u, y = _table(seed)
        truth = {
            tuple(reading): tuple(command)
            for command, reading in zip(u, y, strict=True)
        }
        spoilt = SPOILT[kind][0](u, y)
        commands, measured = _verdict(*spoilt).mispairing.repaired(*spoilt)
        pairs = [*zip(map(tuple, commands), map(tuple, measured), strict=True)]
        assert all(truth[reading] == command for command, reading in pairs), seed
        assert len({command for command, _ in pairs}) == len(pairs) >= 17, seed


def test_of_two_explanations_the_rows_are_mended_in_which_they_agree():
    for seed in range(10):
        u, y = (side[:20] for side in _table(seed))
        spoilt = u, np.roll(y, 1, axis=0)
        mispairing = _verdict(*spoilt).mispairing
        assert mispairing.alternatives  # the last reading is another's, or the first's
        commands, measured = mispairing.repaired(*spoilt)
        np.testing.assert_array_equal(commands, u[:-1])
        np.testing.assert_array_equal(measured, y[:-1])


def test_a_table_whose_explanations_hardly_agree_is_not_mended():
    u, y = _table()
    mispairing = _verdict(*_lost(u, y, 12)).mispairing
    few = np.where(np.arange(len(mispairing.match)) < 5, mispairing.match, -1)
    open_ = dataclasses.replace(mispairing, match=few, alternatives=("another",))
    with pytest.raises(ValueError, match="several explanations fit"):
        open_.repaired(*_lost(u, y, 12))


def _recording(seed, count, bend=0.0):
    rng = np.random.default_rng(seed)
    time, phase = 0.1 * np.arange(count), rng.uniform(0.0, 6.0, 3)
    u = np.stack([9.0 * np.sin(r * time + p) + 2.0 * np.cos(3.1 * r * time)
                  for r, p in zip((1.0, 1.3, 0.7), phase, strict=True)], 1)  # fmt: skip
    y = u @ MATRIX.T + BIAS + bend * u[:, [1, 0, 1]] * u / 10.0
    return u, y + NOISE * rng.normal(size=u.shape)


@pytest.mark.parametrize("by, bend", [(1, 0.0), (2, 0.0), (0, 0.3), (0, 0.0)])
def test_a_lag_of_a_short_smooth_recording_is_no_curve(by, bend):
    for seed in range(8):
        u, y = _recording(seed, 40, bend)
        reasons = str(_verdict(u[by:], y[: len(y) - by]).verdict)
        assert ("all readings are" in reasons) == (by > 0), (seed, reasons)
        assert ("follow a curve" in reasons) == (bend > 0.0), (seed, reasons)


def _column_lost(u, y):
    return u[:-1], np.column_stack([y[:-1, 0], np.delete(y[:, 1], 9), y[:-1, 2]])


def _column_sorted(u, y):
    return u, np.column_stack([y[:, 0], np.sort(y[:, 1]), y[:, 2]])


def _column_late(u, y):
    return u[3:], np.column_stack([y[3:, 0], y[:-3, 1], y[3:, 2]])


@pytest.mark.parametrize(
    "spoil, table, words",
    [
        (_column_lost, _table, "y_y alone: from row 9 "),
        (_column_sorted, _table, "y_y alone: the readings are sorted"),
        (_column_late, _recording, "y_y alone: all readings are 3 rows late"),
        (lambda u, y: (u, y), _table, ""),
        (lambda u, y: (u, y), _recording, ""),
    ],
)
def test_one_output_that_was_moved_is_named(spoil, table, words):
    for seed in range(8):
        fit = _verdict(*spoil(*table(seed, 60)))
        assert (fit.mispairing is None) == (not words), seed
        assert not words or words in fit.verdict.reasons[0], fit.verdict.reasons
        if words:
            assert "--repair" not in fit.verdict.next_step
            with pytest.raises(ValueError, match="one column cannot be repaired"):
                fit.mispairing.repaired(fit.commands, fit.measured)


def test_three_sessions_are_told_and_no_drift_that_turns_is():
    for seed in range(10):
        u, y = (side[:24] for side in _table(seed))
        steps = np.repeat([[0, 0, 0], [1, -1, 0.5], [-1, 0.6, 2]], 8, axis=0)
        reason = _verdict(u, y + steps).verdict.reasons[0]
        assert "three sessions: from row 8 on and from row 16 on" in reason
        u, y = _table(seed, 60)
        turns = np.sin(np.linspace(0.0, 9.0, len(u)) + seed)[:, None] * (0.3, 0.2, 0.1)
        assert _verdict(u, y + turns).mispairing is None


def test_a_check_names_columns_and_rows():
    u, y = _table()
    fit = jaxcal.identify(u[:20], y[:20])
    new, read = _table(7)
    new, read = new[:12], read[:12]
    spoilt = {
        "u_x and u_y are exchanged": (new[:, [1, 0, 2]], read),
        "u_z has the other sign": (new * (1.0, 1.0, -1.0), read),
        "u_y is in radians": (new * (1.0, np.pi / 180.0, 1.0), read),
        "y_x and y_z are exchanged": (new, read[:, [2, 1, 0]]),
        "all readings are one row late": (new[1:], read[:-1]),
    }
    for words, table in spoilt.items():
        result = fit.check(*table)
        assert result.says == "does not hold" and words in result.mispairing, words
        assert words in str(result) and "correct the table" in result.next_step
    off = read.copy()
    off[[2, 9]] += 0.6  # twelve times the noise
    assert "rows 2, 9 off by" in fit.check(new, off).mispairing
    doubled = fit.check(np.vstack([new[:1], new]), np.vstack([read[:1], off]))
    assert "rows 3, 10 off by" in doubled.mispairing  # as the caller counts them
    drifted = fit.check(new, read + 0.5)
    assert drifted.says == "does not hold" and not drifted.mispairing
    assert fit.check(new, read).good


@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("inputs", [1, 2])
def test_a_check_names_a_sign_however_few_columns_there_are(inputs, outputs):
    for seed in range(10):
        u, y = _table(seed, count=40)
        slopes = MATRIX[:outputs, :inputs] + 0.5
        y = u[:, :inputs] @ slopes.T + NOISE * y[:, :outputs]
        u, rows = u[:, :inputs], slice(30, 50)
        fit = jaxcal.identify(u[:30], y[:30])
        turned = y[rows] * np.where(np.arange(outputs) == 0, -1.0, 1.0)
        assert "has the other sign" in fit.check(u[rows], turned).mispairing, seed
        if inputs > 1:
            told = fit.check(u[rows, ::-1], y[rows]).mispairing
            assert "u_1 and u_2 are exchanged" in told, seed
        for change in (1.05, 0.7, -0.6):  # another machine
            assert not fit.check(u[rows], change * y[rows] + 1.0).mispairing, seed


def test_a_check_names_two_sessions_and_what_is_wrong_with_all_columns():
    u, y = _table(count=50)
    y = y[:, :2]
    u, fit = u[:, :2], jaxcal.identify(u[:30, :2], y[:30] - 0.05 * u[:30, 2:])
    new = u[30:50]
    read = fit.predict(new) + NOISE * np.random.default_rng(1).normal(size=(20, 2))
    later = (np.arange(20) >= 9)[:, None]
    for words, readings in (
        ("from row 9 on the readings have another offset, by (0.", read + 0.5 * later),
        ("from row 9 on the readings have another slope", read * (1.0 + 0.2 * later)),
        ("every column of the readings has the other sign", -read),
        ("the readings are 11.4 times", read * 4096 / 360),
    ):
        result = fit.check(new, readings)
        assert result.says == "does not hold" and words in result.mispairing, words
        assert "; or " not in result.mispairing
    drift = np.linspace(0.0, 1.0, 20)[:, None]
    for readings in (read + 0.5, read * 1.1, read + drift, read):
        assert not fit.check(new, readings).mispairing


def test_commands_in_counts_are_told_by_the_nominal_and_mend_the_table():
    def reach(commands, theta):
        a, b = np.radians(commands[:, 0]), np.radians(commands.sum(axis=1) + theta[2])
        along = theta[0] * np.cos(a) + theta[1] * np.cos(b)
        return np.stack([along, theta[0] * np.sin(a) + theta[1] * np.sin(b)], axis=1)

    model = jaxcal.models.FromFunction(
        reach, [310.0, 190.0, 0.0], scale=[3.0, 3.0, 1.5], batch=True
    )
    rng = np.random.default_rng(3)
    commands = rng.uniform([-80.0, -120.0], [80.0, 120.0], (20, 2))
    readings = reach(commands, [312.0, 188.0, 1.0]) + rng.normal(size=(20, 2))
    counts = _verdict(commands * 4096 / 360, readings, model=model)
    assert "commands is in counts of 4096 a turn" in counts.verdict.reasons[0]
    repaired = counts.mispairing.repaired(commands * 4096 / 360, readings)
    np.testing.assert_allclose(repaired[0], commands, rtol=1e-12)
    scaled = _verdict(commands, readings * 4096 / 360, model=model)
    assert "11.4 times what the parameters say" in scaled.verdict.reasons[0]
    with pytest.raises(ValueError, match="how many exactly is not known"):
        scaled.mispairing.repaired(commands, readings)
    assert "as far from 310 as was stated" in str(
        _verdict(commands, readings * 200 / 360, model=model).verdict
    )
    assert _verdict(commands, readings, model=model).verdict.good


@pytest.mark.parametrize(("low", "high"), [(-8.0, 8.0), (-99.0, 10.0)])
def test_a_sensor_at_the_end_of_its_range_is_told(low, high):
    for seed in range(10):
        u, y = _table(seed)
        y = np.clip(y[:20, :1], low, high)
        found = _verdict(u[:20], y)
        if np.isin(y, (low, high)).sum() > 4:
            assert "the end of the sensor's range" in str(found.verdict), seed
        for digits in (0, 1, 2):  # repeats of a coarse sensor are none
            coarse = _verdict(u[:20], _table(seed)[1][:20].round(digits)).verdict
            assert "range?" not in str(coarse), seed


def test_two_rows_from_elsewhere_are_told_beside_a_nearer_one():
    """Row 11 is off by less than six times the noise, rows 8 and 9 by over twenty."""
    rng = np.random.default_rng(18)
    u = rng.uniform(-20.0, 20.0, (20, 2))
    y = u @ [[1.3], [1.2]] + 2.0
    y[8:12] = rng.uniform(y.min(), y.max(), (4, 1))
    verdict = _verdict(u, y + rng.normal(0.0, 1.7, y.shape)).verdict
    assert not verdict.good and "Rows 8, 9 are outliers" in verdict.reasons[0]


def test_rows_of_one_output_in_another_unit_are_told_beside_right_outputs():
    """Ten or thirty in a hundred of its readings are a tenth of what they should be."""
    for share, least in ((0.1, 10), (0.3, 5)):
        told = 0
        for seed in range(10):
            u, y = _table(seed, count=40)
            wrong = np.random.default_rng(seed).random(len(y)) < share
            y[wrong, 0] /= 10.0
            told += not _verdict(u, y).verdict.good
        assert told >= least, share


@pytest.mark.parametrize("seed", range(3))
def test_outliers_of_outputs_that_share_every_parameter_are_named(seed):
    mixed = np.random.default_rng(0).normal(size=(3, 8))

    def bent(commands, theta):
        waves = np.sin(np.outer(commands[:, 0], np.arange(1, 9)) + commands[:, 1:])
        return (waves * (theta + 0.02 * theta**2)) @ mixed.T

    rng = np.random.default_rng(seed)
    commands = rng.uniform(-2.0, 2.0, (16, 2))
    measured = bent(commands, np.linspace(0.3, 0.9, 8))
    measured += 0.01 * rng.normal(size=measured.shape)
    model = FromFunction(bent, np.full(8, 0.5), inputs=2, batch=True)
    measured[[2, 5, 9, 14]] += 0.2
    told = str(_verdict(commands, measured, model=model, loss="gaussian").verdict)
    assert "Rows 2, 5, 9, 14 are outliers" in told


def test_one_output_that_was_sorted_is_told():
    for seed in range(10):
        u, y = _table(seed)
        u, y = u[:20, :2], y[:20, :1] - u[:20, 2:]
        verdict = _verdict(u, np.sort(y, axis=0)).verdict
        assert not verdict.good and "sorted" in str(verdict), seed
        assert "sorted" not in str(_verdict(u, np.roll(y, 5, axis=0)).verdict)


def test_a_curve_with_a_lost_reading():
    model = Linear("1 + x + y + x:y + I(x**2)", 2)
    rng = np.random.default_rng(3)
    u = rng.uniform(-1.0, 1.0, (30, 2))
    y = model.predict(u, rng.normal(size=10)) + 0.01 * rng.normal(size=(30, 2))
    found = _verdict(u[:-1], np.delete(y, 8, axis=0), model=model).mispairing
    assert "from row 8 on" in found.reason and "one row early" in found.reason


@pytest.mark.parametrize(
    "spoil, words",
    [
        (lambda u, y: _lost(u, y, 9), "from row 9 on"),
        (lambda u, y: (u[:20], y[19::-1]), "in reverse order"),
        (
            lambda u, y: (u[:20, [0, 2, 1, 3, 4, 5]], y[:20]),
            "u_2 and u_3 are exchanged",
        ),
        (lambda u, y: (u[:20] * (1, 1, 1, -1, 1, 1), y[:20]), "u_4 has the other sign"),
        (lambda u, y: (u[:20], y[:20]), None),
    ],
)
def test_a_real_arm(spoil, words):
    joints, measured = ur5.load("ur5_grid_1000.csv")
    at = np.random.default_rng(2).choice(1000, 25, replace=False)
    found = _verdict(*spoil(joints[at], measured[at]), model=ur5.arm()).mispairing
    assert (found is None) if words is None else words in found.reason


@pytest.mark.parametrize(
    "columns", [[1, 0, 2], [2, 1, 0], [0, 2, 1]], ids=["xy", "xz", "yz"]
)
def test_an_arm_whose_readings_are_mirrored(columns):
    """Its frame is known from the readings alone: one sign, or two columns exchanged,
    explain them alike."""
    joints, measured = ur5.load("ur5_grid_1000.csv")
    at = np.random.default_rng(3).choice(1000, 25, replace=False)
    told = _verdict(joints[at], measured[at][:, columns], model=ur5.arm()).verdict
    assert not told.good
    mirrored = "the readings are mirrored: one of y_x, y_y, y_z has the other sign or"
    assert told.reasons[0].startswith(mirrored)


def _views(example, seed=0):
    """20 real views of a board and one more: commands, with the pose that was seen."""
    table = example.load()
    return table[np.random.default_rng(seed).choice(len(table), 21, replace=False)]


@pytest.mark.parametrize("example", [fr3, positioner])
def test_views_of_a_board_that_lost_their_order_or_one_of_them(example):
    """By how far the tip turns from row to row, whatever is known of the camera."""
    table, joints = _views(example), example.arm().num_joints
    zeros = np.zeros((20, 6))
    told = functools.partial(_verdict, measured=zeros, model=example.arm())
    views = table[:20].copy()
    assert told(views).mispairing is None
    for kind, column in (("commands", 0), ("readings", joints)):
        moved = np.argsort(views[:, column])
        side = slice(0, joints) if kind == "commands" else slice(joints, None)
        table = views.copy()
        table[:, side] = views[moved, side]
        assert told(table).mispairing.reason.startswith(f"the {kind} are sorted")
        right = told(table).mispairing.repaired(table, zeros)[0]
        assert {tuple(row) for row in right} == {tuple(row) for row in views}
    table = views.copy()
    table[[4, 11], joints:] = views[[11, 4], joints:]
    assert "rows 4, 11 are exchanged" in told(table).mispairing.reason
    table = np.hstack([views[:19, :joints], np.delete(views, 14, axis=0)[:, joints:]])
    lost = _verdict(table, zeros[:19], model=example.arm()).mispairing
    assert lost.reason.startswith("from row 14 on, readings are one row early")


def test_many_rows_are_not_compared_each_with_each():
    joints, measured = ur5.load("ur5_grid_1000.csv")
    few, many = (
        dataclasses.replace(
            of_fit(_verdict(joints[:20], measured[:20], model=ur5.arm())),
            commands=joints[:count], measured=measured[:count],
        )
        for count in (20, 1000)
    )  # fmt: skip
    assert many.alike is None
    np.testing.assert_array_equal(few.alike, np.arange(20))


@pytest.mark.parametrize("example", [fr3, positioner])
@pytest.mark.parametrize(
    ("columns", "factors", "words"),
    [
        ([0, 1, 2], (1, -1, 1, 1, 1, 1), "{1} has the other sign"),
        ([0, 1, 2], (1, 1, 1, 1, 1, -1), "{5} has the other sign"),
        ([1, 0, 2], (1, 1, 1, 1, 1, 1), "{0} and {1} are exchanged"),
        ([0, 1, 2, 4, 3], (1, 1, 1, 1, 1, 1), "{3} and {4} are exchanged"),
        ([0, 1, 2], (1e3, 1e3, 1e3, 1, 1, 1), "{0} to {2}: each is too large by 1000"),
        (
            [0, 1, 2],
            (1, 1, 1, *[np.pi / 180] * 3),
            "{3} to {5}: each is in radians instead of degrees",
        ),
    ],
)
def test_columns_of_a_pose_that_was_seen(example, columns, factors, words):
    views, joints = _views(example)[:20], example.arm().num_joints
    order = [*columns, *range(len(columns), 6)]
    views[:, joints:] = views[:, joints:][:, order] * factors
    numbered = [f"u_{joints + i + 1}" for i in range(6)]
    try:
        told = _verdict(views, np.zeros((20, 6)), model=example.arm())
        reason, names = told.mispairing.reason, numbered
    except ValueError as error:  # before there is a calibration
        reason, names = str(error), example.arm().inputs[joints:] or numbered
    refused = "views of the board fit the arm only with lengths divided by 1000"
    assert reason.startswith(words.format(*names)) or (
        "1000" in words and reason == refused
    )


@pytest.mark.parametrize("name", ["panda_1", "kuka_14"])
def test_contacts_beside_other_sockets(name):
    """Readings are zero: which socket is touched is what may be mispaired."""
    joints, sockets = contacts.load(name)[contacts.TRAINED]
    at = np.random.default_rng(6).choice(len(joints), 20, replace=False)
    joints, sockets, model = joints[at], sockets[at, None], contacts.arm(name)
    zeros = np.zeros((20, 3))
    told = _verdict(np.hstack([joints, sockets]), zeros, model=model)
    assert told.mispairing is None
    lost = np.hstack([joints[:-1], np.delete(sockets, 9, axis=0)])
    told = _verdict(lost, zeros[1:], model=model).mispairing
    assert "one row early" in told.reason
    in_radians = joints * [np.pi / 180, *[1.0] * (joints.shape[1] - 1)]
    with pytest.raises(ValueError, match=f"^{model.inputs[0]} is in radians instead"):
        _verdict(np.hstack([in_radians, sockets]), zeros, model=model)


def test_contacts_that_an_arm_at_rest_would_fit_better_are_left_alone():
    joints, sockets = contacts.load("dinova_1")["left"]
    commands = np.column_stack([joints, sockets])
    zeros = np.zeros((len(joints), 3))
    found = _verdict(commands, zeros, model=contacts.arm("dinova_1")).mispairing
    assert found is None


def test_a_search_that_lost_its_way_on_a_sweep_is_no_shift_of_rows():
    def peak(u, theta):
        return theta[0] / theta[1] * np.exp(-0.5 * ((u - theta[2]) / theta[1]) ** 2)

    u = np.linspace(400.0, 500.0, 35)[:, None]
    y = peak(u, (1.55, 4.1, 451.5)) + 1e-3 * np.random.default_rng(0).normal(
        size=(35, 1)
    )
    model = FromFunction(lambda one, theta: peak(one, theta), [1.0, 10.0, 500.0])
    try:
        found = _verdict(u, y, model=model, loss="gaussian").mispairing
    except ValueError as refused:  # with some versions of SciPy it does not converge
        assert str(refused).startswith("identify did not converge")
    else:
        assert found is None


def _write(path, u, y):
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["u_a", "u_b", "u_c", "y_a", "y_b", "y_c", "posture"])
        numbers = np.hstack([u, y]).tolist()
        rows.writerows([*row, f"p{i}"] for i, row in enumerate(numbers))


def test_repair_writes_another_file_and_only_where_asked(tmp_path, capsys):
    path, mended = tmp_path / "measured.csv", tmp_path / "mended.csv"
    u, y = _table()
    _write(path, *_lost(u, y, 12))
    before = path.read_bytes()
    assert main(["identify", str(path), "--report", str(tmp_path / "report")]) == 1
    assert "from row 12 on, readings are one row early" in capsys.readouterr().out
    assert not mended.exists()
    assert main(["identify", str(path), "--repair", str(mended)]) == 0
    assert "19 of 20 rows" in capsys.readouterr().out
    assert path.read_bytes() == before
    written = np.loadtxt(mended, delimiter=",", skiprows=1, usecols=range(6))
    rows = np.delete(np.arange(20), 12)
    postures = np.loadtxt(mended, delimiter=",", skiprows=1, usecols=6, dtype=str)
    assert [*postures] == [f"p{row}" for row in rows]
    np.testing.assert_allclose(written, np.hstack([u[rows], y[rows]]))
    assert main(["identify", str(mended), "--report", str(tmp_path / "again")]) == 0
    capsys.readouterr()
    assert main(["identify", str(mended), "--repair", str(path)]) == 2
    assert "exists; pass --overwrite" in capsys.readouterr().err
    assert main(["identify", str(mended), "--repair", str(tmp_path / "new.csv")]) == 2
    assert "no mispaired rows" in capsys.readouterr().err
    assert path.read_bytes() == before
    assert main(["identify", str(path), "--repair", str(path)]) == 2
    assert "another file" in capsys.readouterr().err


def test_evidence_is_that_of_least_squares_with_unknown_noise():
    """By its integral over slope, offset and noise, on a grid."""
    rng = np.random.default_rng(0)
    u, y = rng.normal(size=(7, 1)), rng.normal(size=(7, 1))
    ones = np.ones(2)
    table = Table(
        Affine(1, 1), u, y, np.ones(7, dtype=bool), 0 * ones, 0 * ones,
        np.ones(2, dtype=bool), 0 * ones, np.ones(1), np.ones(1), True,
    )  # fmt: skip
    design = np.column_stack([u, np.ones(7)])
    values = []
    for target in (y, y[::-1]):
        square = float(np.linalg.lstsq(design, target)[1][0])
        sizes = np.exp(np.linspace(-8.0, 8.0, 4001))
        # The integral over both parameters is a constant times noise squared.
        density = sizes**-5.0 * np.exp(-0.5 * square / sizes**2) / sizes
        integral = np.trapezoid(density, sizes)
        values.append((np.log(integral), log_evidence(table, np.array([square]), 7)))
    (first, ours), (second, other) = values
    assert first - second == pytest.approx(float(ours - other), abs=1e-6)


def test_a_fit_leaves_out_an_outlier_and_readings_without_a_command():
    u, y = _table()
    y[4] += 30.0
    counted = np.ones(20, dtype=bool)
    table = Table(
        Affine(3, 3), u[:20], y[:20], counted, np.zeros(12), np.zeros(12),
        np.ones(12, dtype=bool), np.zeros(12), y[:20].std(axis=0), np.ones(3), True,
    )  # fmt: skip
    fit = fitted(table, Hypothesis("as it is", np.arange(20)))
    assert np.flatnonzero(~fit.inside).tolist() == [4]
    rows = np.delete(np.arange(20), 4)
    design = np.column_stack([u[rows], np.ones(19)])
    slopes = np.linalg.lstsq(design, y[rows])[0]
    np.testing.assert_allclose(fit.solution * table.scale, slopes, rtol=1e-6)
    assert shifted(5, 2).tolist() == [2, 3, 4, -1, -1]
    assert not fitted(table, Hypothesis("shift", shifted(20, 2))).inside[18:].any()


@pytest.mark.parametrize("seed", range(20))
def test_outliers_that_least_squares_hides_are_named(seed):
    """Three of twenty rows are wrong: the noise grows until none is an outlier."""
    rng = np.random.default_rng(seed)
    commands, measured = (side[:20] for side in _table(seed))
    assert _verdict(commands, measured).verdict.good
    rows = np.sort(rng.choice(20, 3, replace=False))
    off = rng.normal(size=(3, 3))
    measured[rows] += 1.5 * off / np.abs(off).max(axis=1, keepdims=True)
    verdict = _verdict(commands, measured).verdict
    assert not verdict.good
    assert "Rows " + ", ".join(map(str, rows)) in verdict.reasons[0]


@pytest.mark.parametrize("levels", [(3, 3, 3), (4, 5), (6, 6)])
@pytest.mark.parametrize("by", [1, -1])
def test_a_shift_of_a_grid_in_order_is_named_beside_the_reverse(levels, by):
    """A symmetric grid in reverse order is another machine, which fits as well."""
    axes = [np.linspace(-10.0, 10.0, count) for count in levels]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(levels))
    n = len(levels)
    for seed in range(10):
        rng = np.random.default_rng(seed)
        measured = grid @ MATRIX[:n, :n].T + NOISE * rng.normal(size=grid.shape)
        assert _verdict(grid, measured).verdict.good
        fit = _verdict(*((grid[1:], measured[:-1]), (grid[:-1], measured[1:]))[by < 0])
        first, second = fit.mispairing.reason.split("; or ")[:2]
        assert f"readings are one row {'late' if by > 0 else 'early'}" in first
        assert "reverse order" in second
        assert fit.verdict.next_step.startswith("find out which it is")


@pytest.mark.parametrize("inputs, levels, repeats", [(2, 2, 3), (3, 4, 2), (1, 3, 2)])
def test_what_bends_on_a_grid_in_order_is_no_shift(inputs, levels, repeats, rng):
    """A product's signs are those of a column, some rows further."""
    axes = [np.arange(levels) - (levels - 1) / 2.0] * inputs
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, inputs)
    u = np.repeat(grid, repeats, axis=0)
    y = (u.prod(axis=1) if inputs > 1 else u[:, 0] ** 2)[:, None] * [1.3, -0.4]
    fit = _verdict(u, y + 0.01 * rng.normal(size=y.shape))
    assert not fit.verdict.good and fit.mispairing is None


def test_a_check_of_few_levels_names_a_sign_though_a_curve_explains_it(rng):
    levels = rng.choice([-1.0, 0.0, 1.0], (100, 3)) + BIAS
    y = levels @ MATRIX.T + BIAS + 0.01 * rng.normal(size=levels.shape)
    told = _verdict(levels, y).check(levels * [1.0, -1.0, 1.0], y)
    assert told.mispairing.startswith("u_y has the other sign")


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_many_rows_of_which_one_output_stands_still_divide_by_no_zero(rng):
    u = rng.uniform(-1.0, 1.0, (800, 2))
    y = np.column_stack(
        [u @ [1.0, 2.0] + 0.3 * rng.standard_normal(800), np.zeros(800)]
    )
    assert "never changes" in str(jaxcal.identify(u, y).verdict)


@pytest.mark.parametrize(
    ("words", "commands_times", "readings_times"),
    [
        ("y_1 is too small by 1000", 1.0, 1e-3),
        ("y_1 is in radians", 1.0, np.pi / 180.0),
        ("every column of the commands is too small by 1000", 1e-3, 1.0),
        ("y_1 has the other sign", 1.0, -1.0),
        ("times what the parameters say (counts?)", 1.0, 65536 / 360),
        ("times what the parameters say (counts?)", 1.0, 10.0),
        ("", 1.0, 1.0),
    ],
)
def test_what_parameters_take_up_is_told_by_the_nominal(
    words, commands_times, readings_times
):
    def saturating(commands, theta):
        one, other = commands.T
        return (theta[0] * (1 - np.exp(-theta[1] * one)) + theta[2] * other)[:, None]

    nominal = np.array([120.0, 0.4, 3.0])
    model = jaxcal.models.FromFunction(saturating, nominal=nominal, batch=True)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        commands = rng.uniform(0.0, 5.0, (20, 2))
        truth = nominal * (1.0 + rng.normal(0.0, 0.15, 3))
        measured = saturating(commands, truth) + rng.normal(0.0, 0.3, (20, 1))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", jaxcal.CalibrationWarning)
            calibration = jaxcal.identify(
                commands * commands_times, measured * readings_times, model=model
            )
        assert calibration.verdict.good == (not words)
        assert calibration.verdict.reasons[:1] == () or words in str(
            calibration.verdict.reasons[0]
        )
