"""A calibration that found nothing is not good, and says why; right tables are good.

The judges are known truths: readings that follow the commands, or do not.
"""

from __future__ import annotations

import dataclasses
import pickle
import re
import subprocess
import sys
import warnings

import numpy as np
import pytest

import jaxcal
from jaxcal.models import FromFunction, Polynomial

A = np.array([[1.0, 0.3], [-0.2, 0.8]])
SCRIPT = """
import warnings
import numpy as np, jaxcal
rng = np.random.default_rng(0)
for _ in range(5):
    jaxcal.identify(rng.normal(size=(20, 2)), rng.normal(size=(20, 2)))
u = rng.normal(size=(20, 2))
good = jaxcal.identify(u, u * [1.0, 0.9] + 0.01 * rng.normal(size=(20, 2)))
for _ in range(5):
    good.predict(100.0 * rng.normal(size=(20, 2)))
    good.command_for(100.0 * rng.normal(size=(20, 2)), limits=[(-9, 9)] * 2, clip=True)
warnings.simplefilter("ignore", jaxcal.CalibrationWarning)
for _ in range(5):
    jaxcal.identify(rng.normal(size=(20, 2)), rng.normal(size=(20, 2)))
    good.predict(100.0 * rng.normal(size=(20, 2)))
"""


def _identify(commands, readings, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", jaxcal.CalibrationWarning)
        return jaxcal.identify(commands, readings, **options)


def _right(seed, rows=12, noise=0.03, **options):
    rng = np.random.default_rng(seed)
    commands = rng.uniform(-1.0, 1.0, (rows, 2))
    readings = commands @ A.T + 0.5 + noise * rng.normal(size=(rows, 2))
    return _identify(commands, readings, **options)


def _reason(commands, readings, **options):
    verdict = _identify(commands, readings, **options).verdict
    assert not verdict.good
    return verdict.reasons[0]


@pytest.mark.parametrize("shape", [(20, 2, 2), (20, 2, 1), (8, 2, 2), (12, 3, 3)])
@pytest.mark.parametrize("noise_std", [None, 1.0])
def test_noise_is_no_calibration(shape, noise_std):
    count, n, m = shape
    good = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        commands, readings = rng.normal(size=(count, n)), rng.normal(size=(count, m))
        verdict = _identify(commands, 3.0 + readings, noise_std=noise_std).verdict
        good += verdict.good
        told = re.search("explains nothing|may be chance", str(verdict))
        assert verdict.good or told
    assert good <= 2


def test_a_fit_of_hardly_more_rows_than_parameters_may_be_chance():
    commands = np.array([[1.5, 1], [1.25, 2], [2.25, 3], [0.5, 5], [0.75, 2]])
    told = _reason(commands, np.array([[2.0], [3.0], [5.0], [6.0], [1.0]]))
    assert re.search(r"may be chance: R2 = 0.92 of 5 rows and 3", told), told


@pytest.mark.parametrize("rows", [6, 12, 40])
@pytest.mark.parametrize("model", [None, Polynomial(1, 2, 2)])
def test_right_tables_are_good(rows, model):
    assert sum(_right(seed, rows, model=model).verdict.good for seed in range(40)) >= 38


def test_an_output_that_does_not_follow_is_named_among_others():
    rng = np.random.default_rng(3)
    commands = rng.normal(size=(20, 2))
    readings = np.column_stack([commands @ A[0], rng.normal(size=20)])
    readings[:, 0] += 0.02 * rng.normal(size=20)
    assert "explains nothing of y_2:" in _reason(commands, readings)


def test_zeros_of_the_matrix_are_no_fault():
    rng = np.random.default_rng(0)
    commands = rng.normal(size=(12, 3))
    readings = commands * [1.0, 0.8, 1.2] + 0.02 * rng.normal(size=(12, 3))
    assert _identify(commands, readings).verdict.good


@pytest.mark.parametrize("noise_std", [None, 0.01])
def test_readings_that_stand_still_are_named(noise_std):
    rng = np.random.default_rng(1)
    commands = rng.normal(size=(12, 2))
    readings = commands @ A.T + 0.01 * rng.normal(size=(12, 2))
    readings[:, 1] = 2.5
    said = _reason(commands, readings, noise_std=noise_std)
    assert said == "y_2: the reading never changes: 2.5 in all 12 rows."


@pytest.mark.parametrize(
    ("made", "times"),
    [
        (lambda u: u, ""),
        (lambda u: -u, " times -1"),
        (np.radians, " times 0.017"),
        (lambda u: 1e-3 * u, " times 0.001"),
        (lambda u: u.round(1), ""),
    ],
)
def test_pasted_commands_are_named(made, times):
    rng = np.random.default_rng(2)
    commands = rng.uniform(-20.0, 20.0, (12, 2))
    readings = commands @ A.T + 0.1 * rng.normal(size=(12, 2))
    readings[:, 0] = made(commands[:, 1])
    said = _reason(commands, readings)
    assert said.startswith(f"y_1 equals the command u_2{times} in every row")


def test_a_machine_that_does_nearly_what_it_is_told_is_no_paste():
    rng = np.random.default_rng(2)
    commands = rng.uniform(-20.0, 20.0, (12, 2))
    readings = (commands + 0.02 * rng.normal(size=(12, 2))).round(2)
    assert _identify(commands, readings).verdict.good


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        (0.001, "(0.001) is about 30 times too small: residuals are 0.03"),
        (5.0, "(5) is about 170 times too large: residuals are 0.03"),
    ],
)
def test_a_noise_wrong_by_a_factor_is_said_as_such(stated, said):
    rng = np.random.default_rng(0)
    commands = rng.uniform(-1.0, 1.0, (400, 2))
    readings = commands @ A.T + 0.03 * rng.normal(size=(400, 2))
    verdict = _identify(commands, readings, noise_std=stated).verdict
    assert not verdict.good and len(verdict.reasons) == 1
    found = verdict.reasons[0]
    factor = 0.03 / stated if stated < 0.03 else stated / 0.03
    assert float(found.split("about ")[1].split()[0]) == pytest.approx(factor, rel=0.1)
    assert said.split(" is about")[0] in found and said[-24:-19] in found


def test_the_output_whose_noise_is_wrong_is_named():
    rng = np.random.default_rng(0)
    commands = rng.uniform(-1.0, 1.0, (30, 2))
    readings = commands @ A.T + [0.03, 0.5] * rng.normal(size=(30, 2))
    said = _reason(commands, readings, noise_std=[0.03, 0.02])
    assert said.startswith("The noise you gave for y_2 (0.02) is about 2")


def test_one_outlier_is_no_wrong_noise():
    rng = np.random.default_rng(0)
    commands = rng.uniform(-1.0, 1.0, (30, 2))
    readings = commands @ A.T + 0.03 * rng.normal(size=(30, 2))
    readings[7, 0] += 1.0
    said = _reason(commands, readings, noise_std=0.03)
    assert said.startswith("Row") and " 7" in said and "outlier" in said


def test_a_right_noise_is_right():
    good = sum(_right(seed, noise_std=0.03).verdict.good for seed in range(40))
    assert good >= 38


def test_good_is_what_command_for_takes():
    both = set()
    for seed in range(60):
        rng = np.random.default_rng(seed)
        commands = rng.uniform(-1.0, 1.0, (12, 2))
        nearly = np.array([[1.0, 0.5], [1.0, 0.5 + 0.1 * rng.normal()]])
        readings = commands @ nearly.T + 0.02 * rng.normal(size=(12, 2))
        found = _identify(commands, readings)
        try:
            found.command_for([0.1, 0.1])
            refused = False
        except ValueError:
            refused = True
        if not found.outliers:
            assert found.verdict.good is not refused
        both.add(refused)
    assert both == {True, False}


def test_a_plateau_is_not_good():
    def peak(commands, theta):
        return theta[0] * np.exp(-0.5 * ((commands[:, :1] - theta[2]) / theta[1]) ** 2)

    commands = np.linspace(400.0, 500.0, 35)[:, None]
    rng = np.random.default_rng(0)
    readings = peak(commands, [0.38, 4.0, 451.5]) + 0.006 * rng.normal(size=(35, 1))
    far = FromFunction(peak, [0.1, 10.0, 480.0], batch=True)
    near = FromFunction(peak, [0.3, 5.0, 450.0], batch=True)
    assert _identify(commands, readings, model=near).verdict.good
    verdict = _identify(commands, readings, model=far).verdict
    assert not verdict.good and "explains nothing" in verdict.reasons[0]
    assert any("known only to +-" in why for why in verdict.reasons)


def test_a_search_that_stopped_short_has_not_converged():
    """Half a standard error from the optimum it is told, at the optimum it is not."""

    def decay(commands, theta):
        return theta[0] * np.exp(-theta[1] * commands)

    commands = np.linspace(0.0, 4.0, 30)[:, None]
    readings = decay(commands, [1.0, 0.5])
    readings += 0.01 * np.random.default_rng(0).normal(size=(30, 1))
    model = FromFunction(decay, [0.9, 0.6], batch=True)
    found = _identify(commands, readings, model=model, loss="gaussian")
    assert found.verdict.good
    root = np.linalg.cholesky(found.covariance)
    short = found.estimate + root @ [0.5, 0.0]  # so long in the metric of the errors
    residuals = readings - decay(commands, short)
    square = float(((residuals / found.noise_std) ** 2).sum())
    stopped = dataclasses.replace(
        found, estimate=short, residuals=residuals, square=square
    )
    (said,) = [why for why in stopped.verdict.reasons if "converged" in why]
    length = float(said.split("a step is ")[1].split()[0])
    assert length == pytest.approx(0.5, rel=0.05) and not stopped.verdict.good


def test_what_cancels_in_a_covariance_is_not_certain():
    """Of four rows and three parameters, noise makes one known to 1e7 and more."""

    def decay(commands, theta):
        return theta[0] * np.exp(-theta[1] * commands[:, :1]) + theta[2]

    model = FromFunction(decay, [1.0, 0.5, 0.1], batch=True)
    fits = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        theta = model.nominal * (1.0 + 0.2 * rng.normal(size=3))
        commands = rng.uniform(0.0, 4.0, (4, 1))
        readings = decay(commands, theta) + 0.3 * rng.normal(size=(4, 1))
        try:
            found = _identify(commands, readings, model=model, loss="gaussian")
        except ValueError:
            continue
        errors, std = found.standard_errors, found.predict_std(commands)
        if errors is None or found.unidentified is not None:
            continue
        fits += 1
        assert np.isfinite(errors).all() and (std > 0.0).all()
        if (errors > 1e3 * np.abs(found.parameters).max()).any():
            assert not found.verdict.good
    assert fits > 30


def test_a_program_warns_once_and_can_be_told_to_be_quiet():
    run = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True
    )
    assert run.stderr.count("CalibrationWarning") == 4, run.stderr
    for words in ("explains nothing", "commands are far", "targets are far", "clipped"):
        assert run.stderr.count(words) == 1


def test_the_text_of_a_warning_is_the_whole_verdict_wherever_it_is_read():
    rng = np.random.default_rng(0)
    with pytest.warns(jaxcal.CalibrationWarning, match="explains nothing") as given:
        found = jaxcal.identify(rng.normal(size=(20, 2)), rng.normal(size=(20, 2)))
    texts = [str(given[0].message), str(pickle.loads(pickle.dumps(given[0].message)))]
    assert texts == [str(found.verdict)] * 2
    assert type(texts[0]) is str
