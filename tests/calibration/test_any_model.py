"""identify with a model, a prior or a loss, against scipy, closed forms, simulation."""

from __future__ import annotations

import copy
import gc
import json
import pathlib
import weakref
from typing import Any

import numpy as np
import pytest
from scipy import optimize, stats

import jaxcal
from jaxcal.calibration import Calibration, identify
from jaxcal.calibration.fit_problem import LOSSES, Loss, constants
from jaxcal.calibration.verdict import Verdict, verdict
from jaxcal.models import (
    Affine,
    FromFunction,
    FromJax,
    Linear,
    Model,
    Noise,
    Polynomial,
    Pose,
    Prior,
    SerialChain,
    identifiability,
)
from jaxcal.models.model import Fitting


class Wave:
    """y = (a sin(b u + c) + d v, a cos(b u + c) + e v), nothing shows ``idle``."""

    names = ("a", "b", "c", "d", "e", "idle")
    nominal = np.array([1.0, 1.0, 0.0, 0.0, 1.0, 3.0])
    num_inputs, num_outputs, num_parameters = 2, 2, 6

    def predict(self, commands: Any, parameters: Any = None) -> np.ndarray:
        a, b, c, d, e, _ = self.nominal if parameters is None else parameters
        u, v = np.asarray(commands).T
        turn = b * u + c
        return np.column_stack([a * np.sin(turn) + d * v, a * np.cos(turn) + e * v])

    def jacobian(self, commands: Any, parameters: Any = None) -> np.ndarray:
        a, b, c, *_ = self.nominal if parameters is None else parameters
        u, v = np.asarray(commands).T
        s, k, zero = np.sin(b * u + c), np.cos(b * u + c), 0 * u
        first = np.stack([s, a * k * u, a * k, v, zero, zero], axis=-1)
        second = np.stack([k, -a * s * u, -a * s, zero, v, zero], axis=-1)
        return np.stack([first, second], axis=1)

    def command_jacobian(self, commands: Any, parameters: Any = None) -> np.ndarray:
        a, b, c, d, e, _ = self.nominal if parameters is None else parameters
        u = np.asarray(commands)[:, 0]
        s, k = np.sin(b * u + c), np.cos(b * u + c)
        first = np.stack([a * b * k, d + 0 * u], axis=-1)
        return np.stack([first, np.stack([-a * b * s, e + 0 * u], axis=-1)], axis=1)

    def default_prior(self) -> Prior:
        return Prior(np.inf)

    def to_dict(self) -> dict[str, Any]:
        return {"kind": "wave"}


TRUTH = np.array([2.0, 1.3, 0.4, 0.3, 0.8, 3.0])
WAVE = Wave()


def waves(seed: int, count: int = 12, noise: float = 0.05) -> tuple[Any, Any]:
    rng = np.random.default_rng(seed)
    commands = rng.uniform(-1.5, 1.5, (count, 2))
    measured = WAVE.predict(commands, TRUTH)
    return commands, measured + rng.normal(0, noise, measured.shape)


# -- the estimate ----------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_least_squares_agrees_with_scipy(seed: int) -> None:
    commands, measured = waves(seed)
    rng = np.random.default_rng(seed)
    root = np.tril(rng.normal(size=(12, 2, 2)) * 0.02) + 0.05 * np.eye(2)
    covariance = root @ np.matrix_transpose(root)
    weights = rng.uniform(0.5, 2, 12)
    std = {"a": 0.5, "b": 0.3, "idle": 0.1}
    found = identify(
        commands,
        measured,
        model=WAVE,
        prior=Prior(std),
        noise=Noise(covariance=covariance),
        weights=weights,
        loss="gaussian",
    )
    precision = np.diag([0.5**-2, 0.3**-2, 0, 0, 0, 0.1**-2])
    white = np.linalg.inv(np.linalg.cholesky(covariance / weights[:, None, None]))

    def rows(theta: np.ndarray) -> np.ndarray:
        off = (white @ (WAVE.predict(commands, theta) - measured)[..., None]).ravel()
        return np.concatenate([off, np.sqrt(precision) @ (theta - WAVE.nominal)])

    expected = optimize.least_squares(
        rows, WAVE.nominal, ftol=1e-15, xtol=1e-15, gtol=1e-15
    )
    np.testing.assert_allclose(found.parameters, expected.x, atol=1e-7)
    slopes = (white @ WAVE.jacobian(commands, expected.x)).reshape(-1, 6)
    np.testing.assert_allclose(
        found.covariance, np.linalg.inv(slopes.T @ slopes + precision), rtol=1e-5
    )


def test_students_loss_is_at_its_minimum() -> None:
    commands, measured = waves(3)
    measured[4] += [1.0, -0.7]
    found = identify(commands, measured, model=WAVE, noise_std=0.05)

    def loss(theta: np.ndarray) -> float:
        off = (WAVE.predict(commands, [*theta, 3.0]) - measured) / 0.05
        return float(6 * np.log1p((off**2).sum(axis=1) / 6).sum())

    expected = optimize.minimize(loss, TRUTH[:5], method="BFGS", tol=1e-10).x
    np.testing.assert_allclose(found.parameters[:5], expected, atol=2e-6)
    assert list(found.outliers) == [4] and found.outliers[4] < 0.05
    assert "Row 4 is an outlier" in repr(found)
    plain = identify(commands, measured, model=WAVE, noise_std=0.05, loss="gaussian")
    error, plain_error = (
        np.linalg.norm((each.parameters - TRUTH)[:5]) for each in (found, plain)
    )
    assert error < 0.1 < plain_error


class Cauchy(Loss):
    def weight(self, square: np.ndarray, q: int) -> np.ndarray:
        return 1.0 / (1.0 + square)

    def slope(self, square: np.ndarray, q: int) -> np.ndarray:
        return -1.0 / (1.0 + square) ** 2


def test_a_loss_of_ones_own_is_a_class_and_a_row(monkeypatch) -> None:
    monkeypatch.setitem(LOSSES, "cauchy", Cauchy())
    commands, measured = waves(3)
    options = {"model": WAVE, "noise_std": 0.05, "loss": "cauchy"}
    found = identify(commands, measured, **options)

    def loss(theta: np.ndarray) -> float:
        off = (WAVE.predict(commands, [*theta, 3.0]) - measured) / 0.05
        return float(np.log1p((off**2).sum(axis=1)).sum())

    expected = optimize.minimize(loss, TRUTH[:5], method="BFGS", tol=1e-10).x
    np.testing.assert_allclose(found.parameters[:5], expected, atol=5e-6)


def test_a_linear_model_with_a_prior_has_a_closed_form() -> None:
    rng = np.random.default_rng(0)
    model = Polynomial(2, 2, 2)
    p = model.num_parameters
    commands = rng.uniform(-1, 1, (9, 2))
    measured = rng.normal(size=(9, 2))
    mean, std = rng.normal(size=p), rng.uniform(0.1, 2, p)
    found = identify(
        commands,
        measured,
        model=model,
        prior=Prior(std, mean),
        noise=Noise([0.2, 0.4]),
        loss="gaussian",
    )
    rows = model.jacobian(commands) / np.array([0.2, 0.4])[:, None]
    rows, right = rows.reshape(-1, p), (measured / [0.2, 0.4]).ravel()
    information = rows.T @ rows + np.diag(std**-2)
    expected = np.linalg.solve(information, rows.T @ right + mean / std**2)
    np.testing.assert_allclose(found.parameters, expected, atol=1e-9)
    np.testing.assert_allclose(
        found.covariance, np.linalg.inv(information), rtol=1e-8, atol=1e-12
    )
    hat = rows @ np.linalg.solve(information, rows.T)
    assert found.dof == pytest.approx(18 - np.trace(hat))


def test_the_closed_form_of_the_affine_model_is_its_limit() -> None:
    rng = np.random.default_rng(1)
    commands = rng.uniform(-20, 20, (9, 3))
    measured = commands * [0.4, 0.7, 0.9] + rng.normal(0, 0.1, (9, 3))
    closed = identify(commands, measured, model=Affine(3, 3), noise=Noise(0.1))
    assert closed.centre is not None
    assert np.array_equal(
        closed.parameters, identify(commands, measured, noise_std=0.1).parameters
    )
    found = identify(
        commands, measured, prior=Prior(1e6), noise=Noise(0.1), loss="gaussian"
    )
    assert found.centre is None
    np.testing.assert_allclose(found.matrix, closed.matrix, atol=1e-9)
    np.testing.assert_allclose(found.bias, closed.bias, atol=1e-9)
    np.testing.assert_allclose(found.covariance, closed.covariance, atol=1e-9)
    np.testing.assert_allclose(
        found.predict_std(commands), closed.predict_std(commands), rtol=1e-6
    )
    free = identify(
        commands, measured, prior=Prior(1e6), loss="gaussian", common_noise=False
    )
    assert free.noise_dof == pytest.approx(5, abs=1e-3)
    expected = identify(commands, measured)
    np.testing.assert_allclose(free.noise_std, expected.noise_std, rtol=1e-4)


def test_noise_is_estimated_beside_a_prior() -> None:
    rng = np.random.default_rng(2)
    model = Polynomial(3, 2)
    p = model.num_parameters
    commands = rng.uniform(-1, 1, (14, 2))
    measured = model.predict(commands, rng.normal(0, 0.3, p)) + rng.normal(
        0, 0.1, (14, 1)
    )
    found = identify(commands, measured, model=model, prior=Prior(0.3), loss="gaussian")
    rows = model.jacobian(commands)[:, 0] / found.noise_std
    hat = rows @ np.linalg.solve(rows.T @ rows + np.eye(p) / 0.09, rows.T)
    square = (found.residuals**2).sum() / (14 - np.trace(hat))
    assert found.noise_std[0] ** 2 == pytest.approx(square, rel=1e-3)
    assert found.noise_dof == pytest.approx(14 - np.trace(hat), rel=1e-3)


def test_outputs_in_different_units_get_a_level_each() -> None:
    commands = waves(0, 30)[0]
    unit = np.array([1.0, 1000.0])
    model = Linear("x + y", 2)
    rng = np.random.default_rng(0)
    line = commands @ np.ones((2, 2)) + rng.normal(0, 0.1, (30, 2))
    found = identify(commands, line * unit, model=model)
    alone = identify(commands, line, model=model)
    np.testing.assert_allclose(found.noise_std / unit, alone.noise_std, rtol=1e-4)


def test_weights_count_as_repeated_readings_and_zero_leaves_out() -> None:
    commands, measured = waves(5)
    measured[3] += 100.0
    weights = np.arange(12) % 3 + 1
    weights[3] = 0
    options: dict[str, Any] = {"model": WAVE, "noise_std": 0.05, "loss": "gaussian"}
    found = identify(commands, measured, weights=weights, **options)
    repeated = identify(
        np.repeat(commands, weights, axis=0),
        np.repeat(measured, weights, axis=0),
        **options,
    )
    np.testing.assert_allclose(found.parameters, repeated.parameters, atol=1e-9)
    np.testing.assert_allclose(found.covariance, repeated.covariance, rtol=1e-6)
    assert found.num_measurements == 11 and found.loss_weights[3] == 0.0
    assert np.abs(found.residuals[3]).min() > 90 and not found.outliers


# -- uncertain commands ----------------------------------------------------------------


@pytest.mark.parametrize("command_std", [[0.08, 0.02], [np.inf, 0.0], [np.inf, 0.03]])
def test_uncertain_commands_are_estimated_beside_the_parameters(
    command_std: list[float],
) -> None:
    commands, measured = waves(6, 14)
    rng = np.random.default_rng(6)
    told = commands + rng.normal(0, 0.05, commands.shape) * (np.array(command_std) > 0)
    prior = Prior({"a": 0.5, "b": 0.02, "c": 0.1, "d": 0.1, "e": 0.3})
    found = identify(
        told,
        measured,
        model=WAVE,
        prior=prior,
        noise=Noise(0.05, command_std=command_std),
        loss="gaussian",
    )
    root = 1.0 / np.where(np.array(command_std) > 0, command_std, 1e-9)
    weak = np.sqrt(prior.resolve(WAVE).precisions)[:5]

    def rows(x: np.ndarray) -> np.ndarray:
        theta, moved = np.append(x[:5], 3.0), x[5:].reshape(told.shape) / (1 + root)
        off = (WAVE.predict(told + moved, theta) - measured) / 0.05
        return np.concatenate(
            [off.ravel(), (moved * root).ravel(), weak * (x[:5] - WAVE.nominal[:5])]
        )

    start = np.concatenate([WAVE.nominal[:5], np.zeros(told.size)])
    brute = optimize.least_squares(rows, start, ftol=1e-14, xtol=1e-14, gtol=1e-14)
    np.testing.assert_allclose(found.parameters[:5], brute.x[:5], atol=1e-5)
    full = np.linalg.inv(brute.jac.T @ brute.jac)[:5, :5]
    np.testing.assert_allclose(
        np.sqrt(np.diag(found.covariance))[:5], np.sqrt(np.diag(full)), rtol=1e-3
    )
    moved = brute.x[5:].reshape(told.shape) / (1 + root)
    np.testing.assert_allclose(found.estimated_commands, told + moved, atol=1e-5)


@pytest.mark.filterwarnings("ignore:.*odr. is deprecated")
def test_pearsons_data_with_yorks_weights() -> None:
    """York, 1966: slope -.480533, intercept 5.47991; and scipy's odr."""
    x = np.array([0.0, 0.9, 1.8, 2.6, 3.3, 4.4, 5.2, 6.1, 6.5, 7.4])
    y = np.array([5.9, 5.4, 4.4, 4.6, 3.5, 3.7, 2.8, 2.8, 2.4, 1.5])
    of_x = np.array([1000, 1000, 500, 800, 200, 80, 60, 20, 1.8, 1.0]) ** -0.5
    of_y = np.array([1, 1.8, 4, 8, 20, 20, 70, 70, 100, 500]) ** -0.5
    noise = Noise(std=of_y[:, None], command_std=of_x[:, None])
    found = identify(x[:, None], y[:, None], noise=noise)
    np.testing.assert_allclose(found.matrix[0, 0], -0.480533407, atol=1e-8)
    np.testing.assert_allclose(found.bias[0], 5.47991022, atol=1e-7)
    from scipy import odr

    line = odr.Model(lambda beta, x: beta[0] * x + beta[1])
    data = odr.RealData(x, y, sx=of_x, sy=of_y)
    other = odr.ODR(data, line, beta0=[-0.5, 5.0], sstol=1e-14).run()
    errors = np.sqrt(np.diag(other.cov_beta))
    np.testing.assert_allclose(found.standard_errors, errors, rtol=1e-3)


def test_commands_that_are_exact_in_some_rows_stay_there() -> None:
    """The limit of a standard deviation that goes to zero."""
    rng = np.random.default_rng(2)
    commands, measured = waves(7, 14)
    spread = rng.uniform(0.02, 0.1, commands.shape)
    exact = rng.random(commands.shape) < 0.4
    found, near = (
        identify(
            commands,
            measured,
            model=WAVE,
            noise=Noise(0.05, command_std=np.where(exact, least, spread)),
            loss="gaussian",
        )
        for least in (0.0, 1e-7)
    )
    np.testing.assert_array_equal(found.estimated_commands[exact], commands[exact])
    np.testing.assert_allclose(found.parameters, near.parameters, atol=1e-6)
    np.testing.assert_allclose(found.standard_errors, near.standard_errors, rtol=1e-4)


# -- uncertainty -----------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:.*far outside the measurements")
@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"noise_std": 0.05, "loss": "gaussian"},
        {"noise_std": 0.05},
        {"loss": "gaussian"},
        {},
    ],
)
def test_intervals_cover_what_they_promise(options: dict[str, Any]) -> None:
    rng = np.random.default_rng(4)
    commands = rng.uniform(-1.5, 1.5, (8, 2))
    exact = WAVE.predict(commands, TRUTH)
    target = rng.uniform(-1.5, 1.5, (3, 2))
    trials = 120
    hits, reached = np.zeros(5), np.zeros((3, 2))
    for _ in range(trials):
        measured = exact + rng.normal(0, 0.05, exact.shape)
        found = identify(commands, measured, model=WAVE, **options)
        low, high = found.confidence_intervals().T
        hits += ((low <= TRUTH) & (TRUTH <= high))[:5]
        low, high = found.predict_interval(target)
        expected = WAVE.predict(target, TRUTH)
        reached += (low <= expected) & (expected <= high)
    share = np.concatenate([hits, reached.ravel()]) / trials
    # Four standard deviations below; Student's loss may promise a little less.
    assert share.min() > 0.95 - 4 * np.sqrt(0.95 * 0.05 / trials)
    assert share.mean() < 0.99


def test_without_freedom_the_noise_is_unknown() -> None:
    rng = np.random.default_rng(0)
    model = Polynomial(2, 1)
    commands = np.array([[-1.0], [0.0], [1.0]])
    found = identify(commands, rng.normal(size=(3, 1)), model=model)
    np.testing.assert_allclose(found.residuals, 0, atol=1e-9)
    assert found.covariance is None and found.noise_std is None
    for call in (found.confidence_intervals, lambda: found.predict_std(commands)):
        with pytest.raises(ValueError, match="noise is unknown"):
            call()
    assert "noise is unknown" in repr(found) and "[" not in repr(found)


def test_what_nothing_determines_is_named_and_has_no_interval() -> None:
    commands, measured = waves(7)
    found = identify(commands, measured, model=WAVE, noise_std=0.05)
    assert found.parameters[5] == 3.0 and np.isinf(found.standard_errors[5])
    assert np.isfinite(found.standard_errors[:5]).all()
    assert np.isfinite(found.predict_std(commands)).all()
    assert found.from_data.tolist() == [1, 1, 1, 1, 1, 0]
    assert "Not determined, kept near the prior's mean: idle;" in repr(found)
    assert found.identifiability().directions[0].words == "idle"
    short = Linear("x + y + x:y", 1)
    flat = commands * [1.0, 0.0]
    found = identify(flat, measured[:, :1], model=short, noise_std=0.1)
    lost = np.isinf(found.standard_errors)
    assert [n for n, gone in zip(short.names, lost, strict=True) if gone] == [
        "y",
        "x:y",
    ]
    std = found.predict_std([[1.0, 0.0], [1.0, 1.0]])
    assert np.isfinite(std[0, 0]) and np.isinf(std[1, 0])
    with pytest.raises(ValueError, match="4 independent readings, too few for 6 free"):
        identify(commands[:2], measured[:2], model=WAVE, noise_std=0.05)


def test_a_prior_holds_what_the_measurements_do_not_say() -> None:
    commands, measured = waves(7)
    prior = Prior({"idle": 0.5, "d": 1e-3}, mean={"idle": 7.0, "d": 0.3}, fixed=["e"])
    found = identify(commands, measured, model=WAVE, prior=prior, noise_std=0.05)
    assert found.parameters[5] == 7.0 and found.standard_errors[5] == pytest.approx(0.5)
    assert found.parameters[4] == 1.0 and found.standard_errors[4] == 0.0
    assert found.from_data[4] == found.from_data[5] == 0.0
    assert found.from_data[3] < 0.05 and found.from_data[0] > 0.99
    assert "(1 fixed)" in repr(found)


def test_lack_of_fit_is_small_where_the_model_is_wrong() -> None:
    commands, measured = waves(8, 20)
    good = identify(commands, measured, model=WAVE, noise_std=0.05).lack_of_fit()
    bad = identify(
        commands, measured + commands**2, model=WAVE, noise_std=0.05
    ).lack_of_fit()
    assert good > 0.01 and bad < 1e-6


# -- the inverse -----------------------------------------------------------------------


def test_command_for_inverts_predict() -> None:
    commands, measured = waves(9)
    found = identify(
        commands, measured, model=WAVE, noise_std=0.05, input_names=["pan", "reach"]
    )
    wanted = found.predict(commands[:6].reshape(2, 3, 2))
    back = found.command_for(wanted)
    assert back.shape == (2, 3, 2)
    np.testing.assert_allclose(found.predict(back), wanted, atol=1e-8)
    limits = [[-1.5, 1.5], [-1.5, 1.5]]
    inside = found.command_for(wanted, limits)
    np.testing.assert_allclose(found.predict(inside), wanted, atol=1e-8)
    assert (np.abs(inside) <= 1.5).all()
    near = found.command_for(wanted[0, 0], start=commands[0])
    np.testing.assert_allclose(near, commands[0], atol=1e-8)


@pytest.mark.filterwarnings("ignore:.*far outside the measurements")
def test_command_for_reaches_a_pose() -> None:
    """Absolute poses, asked for as turns from nominal at a rough start."""
    table = [(0, 90, 89, 0), (-425, 0, 0, 0), (-392, 0, 0, 0),
             (0, 90, 109, 0), (0, -90, 95, 0), (0, 0, 82, 0)]  # fmt: skip
    arm = SerialChain.from_dh(table, sensor=Pose())
    rng = np.random.default_rng(0)
    joints = rng.uniform(-120, 120, (30, 6))
    truth = arm.nominal + 0.2 * rng.normal(size=arm.num_parameters)
    measured = arm.predict(joints, truth)
    found = identify(joints, measured, model=arm, noise_std=0.01)
    goals = joints[:5] + 1.0
    poses = found.predict(goals)
    frames = arm.rotations(goals, poses[:, 3:])
    for away in (2.0, 40.0):
        start = goals + away * rng.normal(size=goals.shape)
        desired = np.hstack([poses[:, :3], arm.rotation_vectors(start, frames)])
        back = found.command_for(desired, start=start)
        reached = found.predict(back)
        np.testing.assert_allclose(reached[:, :3], poses[:, :3], atol=1e-6)
        again = arm.rotations(back, reached[:, 3:])
        np.testing.assert_allclose(again, frames, atol=1e-9)
    with pytest.raises(ValueError, match="start is missing: for an arm's pose"):
        found.command_for(desired)


@pytest.mark.filterwarnings("ignore:.*targets are clipped")
def test_what_is_out_of_reach_or_beyond_the_limits_is_named() -> None:
    rng = np.random.default_rng(0)
    commands = rng.uniform(-1, 1, (12, 2))
    measured = commands * 2.0 + 0.3 * commands**3 + rng.normal(0, 1e-3, (12, 2))
    found = identify(commands, measured, model=Polynomial(3, 2, 2), noise_std=1e-3)
    wanted = found.predict([0.5, 0.9])
    with pytest.raises(ValueError, match=r"u_2 would have to be 0\.9.* \(limits"):
        found.command_for(wanted, [[-1, 1], [-0.5, 0.5]])
    held = found.command_for(wanted, [[-1, 1], [-0.5, 0.5]], clip=True)
    assert held[1] == pytest.approx(0.5)
    wave = identify(*waves(9), model=WAVE, noise_std=0.05)
    with pytest.raises(
        ValueError, match=r"target 1 \(50, 0\) cannot be reached; the nea"
    ):
        wave.command_for([50.0, 0.0])
    with pytest.raises(ValueError, match=r"cannot be reached.* at the limit of u_2"):
        wave.command_for([50.0, 0.0], [[-3, 3], [-2, 2]])
    with pytest.raises(ValueError, match="desired must be finite"):
        found.command_for([np.nan, 0.0])
    flat = identify(commands, measured[:, :1], model=Linear("x", inputs=["x", "y"]))
    with pytest.raises(ValueError, match="at most as many outputs as inputs"):
        identify(
            commands[:, :1], measured, model=Affine(1, 2), loss="student"
        ).command_for([0.0, 0.0])
    assert flat.predict(flat.command_for([0.5]))[0] == pytest.approx(0.5)


def test_no_inverse_where_the_outputs_do_not_respond() -> None:
    rng = np.random.default_rng(0)
    commands = rng.uniform(-1, 1, (12, 2))
    twins = commands[:, :1] @ np.ones((1, 2))
    found = identify(commands, twins, model=Affine(2, 2), loss="student")
    with pytest.raises(ValueError, match="is singular"):
        found.command_for([0.1, 0.1])


# -- the file, and bad input -----------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {"noise_std": 0.1},
        {"prior": Prior({"1": 0.1}, fixed=["x"])},
        {"noise": Noise(0.1, command_std=[0.1, 0.0])},
    ],
)
def test_a_file_holds_every_bit(
    tmp_path: pathlib.Path, options: dict[str, Any]
) -> None:
    rng = np.random.default_rng(0)
    commands = rng.uniform(-1, 1, (12, 2))
    measured = commands[:, :1] ** 2 + rng.normal(0, 0.1, (12, 1))
    model = Linear("1 + x + y + I(x**2)")
    found = identify(commands, measured, model=model, notes={"arm": 3}, **options)
    found.save(tmp_path / "c.json")
    back = Calibration.load(tmp_path / "c.json")
    assert back.to_dict() == found.to_dict() and repr(back) == repr(found)
    assert np.array_equal(back.predict(commands), found.predict(commands))
    assert np.array_equal(back.predict_std(commands), found.predict_std(commands))
    content = json.loads((tmp_path / "c.json").read_text())
    assert content["version"] == 3 and content["model"]["kind"] == "linear"
    for edit, message in (
        ({"loss": 3}, '"loss" must be'),
        ({"estimate": [1.0]}, '"prior_mean" must have shape|"joint_covariance" must'),
        ({"model": {"kind": "odd"}}, "kind of the model"),
        ({"noise_dof": -1.0}, '"noise_dof" must be at least 0'),
        ({"noise_std": None}, "contradict"),
    ):
        with pytest.raises(ValueError, match=message):
            Calibration.from_dict({**content, **edit})


def test_a_function_is_given_to_load(tmp_path: pathlib.Path) -> None:
    model = Linear(lambda u: np.column_stack([u, u**2]), inputs=1, terms=["p", "q"])
    commands = np.linspace(-1, 1, 9)[:, None]
    found = identify(commands, commands + 0.1 * commands**2, model=model)
    found.save(tmp_path / "c.json")
    with pytest.raises(ValueError, match=r"c\.json: .* pass the model, model="):
        Calibration.load(tmp_path / "c.json")
    back = Calibration.load(tmp_path / "c.json", model=model)
    np.testing.assert_array_equal(back.predict([[0.3]]), found.predict([[0.3]]))
    with pytest.raises(ValueError, match=r"parameters of the file, \['p', 'q'\]"):
        Calibration.load(tmp_path / "c.json", model=Polynomial(1, 1))


def test_only_an_affine_model_has_a_matrix() -> None:
    found = identify(*waves(0), model=WAVE)
    with pytest.raises(AttributeError, match="matrix: only an affine model"):
        _ = found.matrix
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = found.nothing


def broken(method: str, answer: Any) -> Any:
    model = Wave()
    setattr(model, method, lambda commands, parameters=None: answer(len(commands)))
    return model


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"model": 3}, "model must be of jaxcal.models, .* got int without predict"),
        (
            {"model": Affine(3, 2), "loss": "student"},
            r"commands must have shape \(N, 3\) for this mo",
        ),
        ({"model": Polynomial(1, 2, 3)}, r"measured must have shape \(N, 3\)"),
        (
            {"model": broken("predict", lambda n: np.zeros((n, 3)))},
            r"model.predict must return \(12, 2\), got \(12, 3\)",
        ),
        (
            {"model": broken("predict", lambda n: np.full((n, 2), np.nan))},
            r"model.predict must be finite, got \(nan, nan\) for the command",
        ),
        (
            {"model": broken("jacobian", lambda n: np.zeros((n, 2, 5)))},
            r"model.jacobian must return \(12, 2, 6\), got \(12, 2, 5\)",
        ),
        (
            {"model": broken("jacobian", lambda n: np.full((n, 2, 6), np.inf))},
            "model.jacobian must be finite, got inf by a, b.* for the command",
        ),
        ({"prior": 1.0}, r"prior must be a jaxcal.Prior\(std=...\), got float"),
        ({"prior": Prior(1.0, {"a": "x"})}, "mean of the prior of a must be an array"),
        ({"prior": Prior(1.0, fixed=WAVE.names)}, "fixes all parameters"),
        ({"prior": Prior({"zz": 1.0})}, "parameter in std of the prior must be one of"),
        ({"noise": Noise(1.0), "noise_std": 1.0}, "give noise_std or noise, not both"),
        ({"noise": Noise(np.ones((3, 2)))}, r"std of the noise must be .* \(3, 2\)"),
        ({"noise": Noise(1.0, command_std=[1, 2, 3])}, "command_std must be one"),
        ({"noise": Noise(1.0, command_std=np.inf)}, "must leave fewer unknown"),
        ({"noise": Noise(1.0, command_std=np.ones((3, 2)))}, "command_std must have"),
        ({"noise_std": 1.0, "common_noise": True}, "not both"),
        (
            {"noise": "0.1"},
            "noise must be a jaxcal.Noise or its standard deviation, got str",
        ),
        ({"common_noise": "no"}, "common_noise must be True, False or a label"),
        ({"input_names": "ab"}, "input_names must hold 2 different names, got 'ab'"),
        ({"loss": "huber"}, "loss must be one of student, gaussian"),
        ({"weights": np.zeros(12)}, "weights must be positive for at least one"),
    ],
)
def test_bad_arguments_are_named(options: dict[str, Any], message: str) -> None:
    commands, measured = waves(0)
    with pytest.raises(ValueError, match=message):
        identify(commands, measured, **({"model": WAVE} | options))


def test_a_search_that_fails_says_what_to_try() -> None:
    commands, measured = waves(0)
    rng = np.random.default_rng(0)
    model = broken("jacobian", lambda n: rng.normal(size=(n, 2, 6)))
    with pytest.raises(ValueError, match=r"did not converge|is not the deriva"):
        identify(commands, measured, model=model, loss="gaussian")


def test_a_function_in_jax_is_identified_and_inverted() -> None:
    jnp = pytest.importorskip("jax.numpy")

    def decay(u: Any, theta: Any) -> Any:
        return jnp.array([theta[0] * jnp.exp(-theta[1] * u[0]) + jnp.log(theta[2])])

    model = FromJax(decay, [1.0, 1.0, 0.2], ["size", "rate", "floor"])
    commands = np.linspace(0, 3, 10)[:, None]
    rng = np.random.default_rng(0)
    measured = 2.0 * np.exp(-0.7 * commands) + np.log(3.0)
    measured += rng.normal(0, 1e-3, measured.shape)
    found = identify(commands, measured, model=model)
    np.testing.assert_allclose(found.parameters, [2.0, 0.7, 3.0], rtol=0.05)
    assert found.command_for([2.0])[0] == pytest.approx(
        -np.log((2.0 - np.log(3.0)) / 2.0) / 0.7, abs=0.01
    )


def test_level_of_students_loss_is_that_of_normal_noise() -> None:
    rng = np.random.default_rng(0)
    commands = rng.uniform(-1, 1, (400, 1))
    measured = commands + rng.normal(0, 0.3, (400, 1))
    found = identify(commands, measured, model=Polynomial(1, 1))
    assert abs(found.noise_std[0] - 0.3) < 4 * 0.3 / np.sqrt(2 * 400)


@pytest.mark.parametrize("given", [{"noise_std": 0.1}, {}])
def test_measurements_without_any_error_are_no_error(given):
    model = Polynomial(1, 1)
    found = identify([[0.0], [1.0], [2.0]], [[0.0]] * 3, model=model, **given)
    np.testing.assert_allclose(found.parameters, 0.0, atol=1e-12)


@pytest.mark.parametrize("noise_std", [None, 0.1])
def test_noise_is_that_of_a_measurement_of_weight_one(noise_std) -> None:
    commands = np.random.default_rng(0).uniform(-1.0, 1.0, (12, 1))
    measured = 2.0 * commands + np.random.default_rng(1).normal(0.0, 0.1, (12, 1))
    about = {"weights": np.full(12, 4.0), "noise_std": noise_std}
    plain = identify(commands, measured, **about)
    found = identify(
        commands, measured, model=Polynomial(1, 1), loss="gaussian", **about
    )
    np.testing.assert_allclose(found.noise_std, plain.noise_std, rtol=1e-3)
    np.testing.assert_allclose(
        found.predict_std([[0.5]], new_measurement=True),
        plain.predict_std([[0.5]], new_measurement=True),
        rtol=1e-3,
    )


class Line(Model):
    """y = a + b u with all hooks that ``identify`` and ``select`` ask."""

    names = ("a", "b")
    nominal = np.zeros(2)
    num_inputs = num_outputs = 1

    def predict(self, commands, parameters=None):
        theta = self.nominal if parameters is None else parameters
        return self.jacobian(commands) @ np.asarray(theta)

    def jacobian(self, commands, parameters=None):
        return np.stack([np.ones_like(commands), commands], axis=-1)

    def command_jacobian(self, commands, parameters=None):
        return np.full((len(commands), 1, 1), parameters[1])

    def default_noise(self):
        return Noise(std=0.5)

    @property
    def fitting(self):
        return LineFitting(self)


class LineFitting(Fitting):
    placed: tuple[str, ...] = ("a",)

    def require_commands(self, commands):
        if (commands < 0.0).any():
            raise ValueError("commands must not be negative")

    def verdict(self, fit):
        said = f"a noise of {fit.noise_std[0]:.1g}"
        return Verdict(bool(fit.noise_std[0] < 1.0), (said,), "measure the line again")


def test_a_model_of_ones_own_answers_for_itself(monkeypatch):
    commands = np.arange(6.0)[:, None]
    measured = 1.0 + 2.0 * commands + 0.1 * np.cos(9.0 * commands)
    calibration = identify(commands, measured, model=Line())
    assert calibration.verdict.good
    with pytest.warns(
        UserWarning, match="a noise of 8\nnot good; next: measure the line again"
    ):
        identify(commands, measured + 9.0 * np.cos(9.0 * commands), model=Line())
    with pytest.raises(ValueError, match="must not be negative"):
        identify(-commands, measured, model=Line())
    with pytest.raises(ValueError, match="must not be negative"):
        jaxcal.select(-commands, 2, model=Line())
    with pytest.raises(ValueError, match="must not be negative"):
        calibration.check(-commands, measured)
    # A line that is set up anew may be shifted as a whole.
    moved = measured + 5.0
    assert calibration.check(commands, moved).says == "does not hold"
    anew = calibration.check(commands, moved, placed_anew=True, tolerance=9.0)
    assert anew.says == "holds"
    monkeypatch.setattr(LineFitting, "placed", calibration.names)
    # And nothing is left to be judged.
    anew = calibration.check(commands, moved, placed_anew=True, tolerance=9.0)
    assert anew.says == "cannot be told" and anew.power == 0.0
    assert not hasattr(calibration, "to_urdf")  # as only of an arm


def test_a_hook_that_is_not_used_is_named():
    text = "Turning.wrapped is not used: define it in a class derived from .*Fitting"
    with pytest.warns(UserWarning, match=text):

        class Turning(Line):
            def wrapped(self, off, commands):
                return off


def test_what_a_copy_of_a_model_is_asked_is_of_the_copy():
    model = Polynomial(1, 1)
    assert model.fitting.wrapped(np.array([[350.0]]), np.zeros((1, 1))) == 350.0
    angle = copy.copy(model)
    angle.periods = np.array([360.0])
    assert angle.fitting.wrapped(np.array([[350.0]]), np.zeros((1, 1))) == -10.0


def test_a_model_that_was_asked_goes_when_it_is_no_more_used():
    model = FromFunction(lambda u, theta: theta * u, [1.0], inputs=1, quiet=True)
    assert model.fitting.rounding is None
    gone = weakref.ref(model)
    gc.disable()
    try:
        del model  # and its processes with it
        assert gone() is None
    finally:
        gc.enable()


def test_seven_names_are_a_model():
    class Least:  # not derived from Model
        names, nominal, num_inputs, num_outputs = Line.names, Line.nominal, 1, 1
        predict, jacobian = Line.predict, Line.jacobian
        command_jacobian = Line.command_jacobian

    commands = np.arange(6.0)[:, None]
    measured = 1.0 + 2.0 * commands + 0.1 * np.cos(9.0 * commands)
    least, line = (identify(commands, measured, model=m) for m in (Least(), Line()))
    assert least.verdict == verdict(line) and "of Least" in least.summary()
    np.testing.assert_allclose(least.estimate, line.estimate, atol=1e-9)
    assert jaxcal.select(commands, 2, model=Least()).log_det > 0.0
    assert identifiability(Least(), commands).rank == 2


@pytest.mark.parametrize("q", [3, 1500])
def test_what_a_loss_does_to_normal_noise_is_an_integral(q):
    """By quadrature over the quantiles of the squared distance."""
    student = LOSSES["student"]
    assert student is not None
    square = stats.chi2.ppf((np.arange(4000) + 0.5) / 4000, q)
    weight, slope = student.weight(square, q), student.slope(square, q)
    by_residual = np.mean(weight + 2.0 * square * slope / q)
    expected = [
        np.mean(weight * square) / q,
        np.mean(weight),
        by_residual**2 / (np.mean(weight**2 * square) / q),
    ]
    np.testing.assert_allclose(constants(student, q), expected, rtol=2e-4)


def test_trajectories_of_a_thousand_readings_are_identified():
    """By least squares of scipy: no measurement is far from the others."""
    times, u = np.linspace(0.0, 1.0, 1500), np.linspace(0.1, 3.0, 6)[:, None]

    def trajectory(u, theta):
        return theta[0] * np.exp(-theta[1] * times * u)

    model = FromFunction(trajectory, [1.0, 0.5], batch=True, quiet=True)
    measured = trajectory(u, [1.1, 0.45])
    measured += np.random.default_rng(0).normal(0.0, 0.1, measured.shape)
    fit = identify(u, measured, model=model, noise=Noise(0.1))
    least = optimize.least_squares(
        lambda theta: (trajectory(u, theta) - measured).ravel(), [1.0, 0.5]
    )
    assert (np.abs(fit.parameters - least.x) < 0.1 * fit.standard_errors).all()


@pytest.mark.parametrize(
    ("given", "remedy"),
    [
        (lambda u, theta: theta[0] * u, r"use FromFunction\(f, nominal\)"),
        ("1 + x", r"use Linear\('1 \+ x'\)"),
    ],
)
def test_what_could_be_made_a_model_is_told_how(given, remedy):
    u = np.linspace(0.0, 1.0, 6)[:, None]
    with pytest.raises(ValueError, match=f"without predict; {remedy}"):
        jaxcal.identify(u, u, model=given)
    with pytest.raises(ValueError, match=r"one column alone is values\[:, None\]"):
        jaxcal.identify(u, u[:, 0])
