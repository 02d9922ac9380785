"""A factor on a command, an output, a noise or a prior changes the units alone."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal import Noise, Prior, identify, select
from jaxcal.models import (
    Affine,
    FromJax,
    Linear,
    Polynomial,
    SerialChain,
    identifiability,
)

FACTORS = st.floats(-12.0, 12.0).map(lambda exponent: 10.0**exponent)
LOSSES = ("gaussian", "student")
RNG = np.random.default_rng(4)
COMMANDS = RNG.uniform([-0.5, -1.0], [1.5, 1.0], (14, 2))
MEASURED = np.column_stack(
    [
        1.0 + COMMANDS @ [2.0, -1.0] + 3.0 * COMMANDS[:, 0] ** 2,
        0.3 - COMMANDS @ [0.5, 0.2] + COMMANDS.prod(axis=1),
    ]
) + RNG.normal(0.0, [0.01, 0.2], (14, 2))
CLEAN = COMMANDS @ [[2.0, 0.5], [-1.0, 1.5]] + RNG.normal(0.0, [0.01, 0.1], (14, 2))
MEASURED[5] += [0.3, -2.0]  # an outlier


def quadratic():
    def function(u, theta):
        import jax.numpy as jnp

        features = jnp.array([1.0, u[0], u[1], u[0] ** 2, u[0] * u[1]])
        return theta.reshape(2, 5) @ features

    return FromJax(function, np.zeros(10), num_inputs=2)


MODELS = {
    "affine": Affine(2, 2),
    "line": Polynomial(1, 2, 2),
    "quadratic": Polynomial(2, 2, 2),
    "formula": Linear("x + y + I(x**2) + x:y", 2),
    "jax": quadratic(),
}


def told(calibration, commands, outputs):
    """What is said in units of the first: all of it must stay."""
    assert calibration.unidentified is None
    std = calibration.predict_std(commands)
    return (
        calibration.predict(commands) / outputs,
        std / outputs,
        calibration.residuals / outputs,
        calibration.noise_std / outputs,
        calibration.loss_weights,
        calibration.distance,
        [calibration.dof, calibration.noise_dof, calibration.square],
    )


def assert_same(first, second):
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-4, atol=1e-6 * np.abs(a).max())


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=8)
@given(FACTORS, FACTORS, FACTORS, FACTORS)
def test_units_of_commands_and_outputs_change_nothing(name, loss, a, b, c, d):
    model, commands, outputs = MODELS[name], np.array([a, b]), np.array([c, d])
    plain = identify(COMMANDS, MEASURED, model=model, loss=loss)
    other = identify(COMMANDS * commands, MEASURED * outputs, model=model, loss=loss)
    assert_same(told(plain, COMMANDS, 1.0), told(other, COMMANDS * commands, outputs))
    assert list(plain.outliers) == list(other.outliers)
    assert identifiability(model, COMMANDS * commands).rank == len(model.names)


@pytest.mark.parametrize("loss", LOSSES)
@given(FACTORS, FACTORS, FACTORS)
@settings(max_examples=8)
def test_units_of_noise_and_prior_change_nothing(loss, a, c, d):
    """With a prior on every parameter and the noise given, in other units."""
    model, outputs = MODELS["line"], np.array([c, d])
    std, size = np.array([0.02, 0.3]), np.array([1.0, a, 1.0])
    prior, mean = np.array([3.0, 1.0, 0.5]), np.array([1.0, 1.5, -0.5])
    every = np.ones((2, 1)) * prior, np.ones((2, 1)) * mean

    def fitted(commands, outputs, size):
        scale = (outputs[:, None] / size).ravel()
        return identify(
            COMMANDS * commands,
            MEASURED * outputs,
            model=model,
            loss=loss,
            noise=Noise(std=std * outputs),
            prior=Prior(every[0].ravel() * scale, every[1].ravel() * scale),
        )

    plain = fitted(np.ones(2), np.ones(2), np.ones(3))
    other = fitted(size[1:], outputs, size)
    assert_same(told(plain, COMMANDS, 1.0), told(other, COMMANDS * size[1:], outputs))
    np.testing.assert_allclose(other.from_data, plain.from_data, atol=1e-6)


def test_small_commands_have_a_square():
    """Eleven positions of 1e-7 m: the square was held at zero, rms 1.06 for .0067."""
    u = np.linspace(-1.0, 1.0, 11)[:, None]
    noise = np.random.default_rng(0).normal(0.0, 0.01, (11, 1))
    measured = 1.0 + 2.0 * u + 3.0 * u**2 + noise
    model = Polynomial(2, 1)
    plain = identify(u, measured, model=model)
    for s in (1e-12, 1e-7, 1e-6, 1e12):
        other = identify(u * s, measured, model=model)
        np.testing.assert_allclose(
            other.parameters * [1.0, s, s**2], plain.parameters, rtol=1e-6
        )
        chosen, best = select(u * s, 4, "exact", model=model), select(u, 4, model=model)
        assert chosen.criteria.I == pytest.approx(best.criteria.I, rel=1e-6)


def test_pascals_beside_tenths_of_a_nanometre():
    """A column of A was 0 and 1, rms .40 for .0089."""
    rng = np.random.default_rng(3)
    u = rng.uniform(-1.0, 1.0, (12, 2))
    y = u @ [[2.0, 0.5], [-1.0, 1.5]] + rng.normal(0.0, 0.01, (12, 2))
    units = np.array([1e5, 1e-10])
    plain = identify(u, y, loss="student")
    other = identify(u, y * units, loss="student")
    np.testing.assert_allclose(other.matrix / units[:, None], plain.matrix, rtol=1e-6)


@pytest.mark.parametrize("factor", [1e-12, 1e-3, 1e3, 1e12])
def test_unit_of_an_arms_lengths_changes_nothing(factor):
    table = np.array([(0, 90, 90, 0), (-425, 0, 0, 0), (-390, 0, 0, 0)], dtype=float)
    rng = np.random.default_rng(2)
    joints = rng.uniform(-90, 90, (24, 3))
    arms, found = [], []
    for unit in (1.0, factor):
        scaled = table * [unit, 1.0, unit, 1.0]
        arms.append(SerialChain.from_dh(scaled))
    lengths = np.array([u == "length" for u in arms[0].units])
    off = rng.normal(0, 0.3, len(lengths))
    noise = rng.normal(0, 0.1, (24, 3))
    for unit, arm in zip((1.0, factor), arms, strict=True):
        actual = arm.nominal + off * np.where(lengths, unit, 1.0)
        measured = arm.predict(joints, actual) + noise * unit
        found.append(identify(joints, measured, model=arm).predict(joints) / unit)
    np.testing.assert_allclose(found[1], found[0], atol=1e-3)


def test_a_line_is_one_model_however_it_is_written():
    """Intervals of outputs that differ in noise are those of each output by itself."""
    affine = identify(COMMANDS, CLEAN)
    line = identify(COMMANDS, CLEAN, model=Polynomial(1, 2, 2))
    order = [1, 2, 4, 5, 0, 3]
    for name in ("parameters", "standard_errors", "confidence_intervals"):
        a, b = getattr(affine, name), getattr(line, name)
        a, b = (a(), b()) if callable(a) else (a, b)
        np.testing.assert_allclose(b[order], a, rtol=1e-9)
    np.testing.assert_allclose(line.matrix, affine.matrix, rtol=1e-9)
    np.testing.assert_allclose(
        line.command_for(CLEAN[:2]), affine.command_for(CLEAN[:2]), rtol=1e-9
    )


def test_intervals_hold_where_outputs_differ_in_noise():
    model, ratio, count = Linear("x", 2), 5.0, 8
    rng = np.random.default_rng(0)
    held = []
    for _ in range(250):
        u = rng.uniform(-1.0, 1.0, (count, 1))
        y = u * [1.0, 2.0] + [1.0, 0.0] + rng.normal(0, [0.1, 0.1 * ratio], (count, 2))
        ends = identify(u, y, model=model, loss="gaussian").confidence_intervals()
        truth = np.array([1.0, 1.0, 0.0, 2.0])
        held.append((ends[:, 0] < truth) & (truth < ends[:, 1]))
    assert 0.93 < np.mean(held) < 0.97  # .87 where the levels were pooled


def exact(commands, measured):
    """(n + 1, m) slopes and bias of least squares, in rational arithmetic."""
    rows = [[*map(Fraction, row), Fraction(1)] for row in commands.tolist()]
    right = [[*map(Fraction, row)] for row in measured.tolist()]
    size = len(rows[0])
    table = [
        [sum(row[i] * row[j] for row in rows) for j in range(size)]
        + [
            sum(row[i] * y[k] for row, y in zip(rows, right, strict=True))
            for k in range(len(right[0]))
        ]
        for i in range(size)
    ]
    for i in range(size):
        table[i] = [x / table[i][i] for x in table[i]]
        for j in range(size):
            if j != i:
                table[j] = [
                    x - table[j][i] * y for x, y in zip(table[j], table[i], strict=True)
                ]
    return np.array([[float(x) for x in row[size:]] for row in table])


@pytest.mark.parametrize("offset", [0.0, 1e3, 1e6, 1e9])
@pytest.mark.parametrize("count", [4, 7])
@pytest.mark.parametrize("model", [None, Polynomial(1, 3, 2)])
@pytest.mark.parametrize("loss", [None, "student"])
def test_lines_far_from_zero_are_those_of_exact_arithmetic(offset, count, model, loss):
    rng = np.random.default_rng(7)
    u = offset + rng.uniform(-1.0, 1.0, (count, 3))
    y = (u - offset) @ rng.normal(size=(3, 2)) + rng.normal(0, 0.05, (count, 2))
    if loss and count > 4:
        return  # has no closed form
    truth = exact(u, y)
    found = identify(u, y, model=model, loss=loss)
    size = np.finfo(float).eps * max(offset, 1.0)
    np.testing.assert_allclose(found.matrix.T, truth[:-1], atol=100 * size)
    np.testing.assert_allclose(
        found.bias, truth[-1], atol=100 * size * max(offset, 1.0)
    )
    assert (found.noise_std is None) == (count == 4)
