"""The regression against oracles built another way, and the laws it must obey."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from jaxcal.information.regression import (
    log_det_gram,
    log_det_information,
    regression_matrix,
    regressors,
)

# A loaded machine is no failure.
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")


def by_hand(commands: np.ndarray, num_outputs: int) -> np.ndarray:
    """The regression matrix of Equation 2, one posture at a time with np.kron."""
    eye = np.eye(num_outputs)
    rows = [np.hstack([np.kron(eye, u[None]), eye]) for u in commands]
    return np.vstack(rows)


@st.composite
def postures(draw: st.DrawFn, extra: int = 6) -> np.ndarray:
    """(N, n) well-spread postures: n from 1 to 4, N from n + 1."""
    n = draw(st.integers(1, 4))
    count = draw(st.integers(n + 1, n + 1 + extra))
    seed = draw(st.integers(0, 2**32 - 1))
    points = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, n))
    centred = points - points.mean(axis=0)
    assume(np.linalg.svd(centred, compute_uv=False)[-1] > 1e-2)
    return points


@pytest.mark.parametrize(("n", "m"), [(3, 3), (1, 1), (2, 3), (4, 2)])
def test_regression_matrix_is_the_kronecker_product(
    rng: np.random.Generator, n: int, m: int
) -> None:
    commands = rng.uniform(-20, 20, (7, n))
    expected = by_hand(commands, m)
    assert regression_matrix(commands, m).shape == (7 * m, m * (n + 1))
    np.testing.assert_array_equal(regression_matrix(commands, m), expected)


def test_regression_matrix_times_parameters_is_the_model(
    rng: np.random.Generator,
) -> None:
    commands, a, b = (
        rng.normal(size=(5, 3)),
        rng.normal(size=(3, 3)),
        rng.normal(size=3),
    )
    parameters = np.concatenate([a.ravel(), b])
    stacked = regression_matrix(commands) @ parameters
    expected = np.array([a @ u + b for u in commands])
    np.testing.assert_allclose(stacked.reshape(5, 3), expected, rtol=1e-13)


@given(postures(), st.integers(1, 4))
def test_log_det_is_that_of_the_full_matrix(points: np.ndarray, m: int) -> None:
    full = by_hand(points, m)
    sign, expected = np.linalg.slogdet(full.T @ full)
    assert sign == 1.0
    np.testing.assert_allclose(
        log_det_information(points, m), expected, rtol=1e-9, atol=1e-9
    )


def test_four_postures_are_the_sixth_power_of_a_volume(
    rng: np.random.Generator,
) -> None:
    corners = rng.uniform(size=(4, 3))
    six_volumes = abs(np.linalg.det(corners[1:] - corners[0]))
    assert log_det_information(corners) == pytest.approx(6 * np.log(six_volumes))


def test_unit_cube_never_exceeds_six_ln_two(rng: np.random.Generator) -> None:
    tetrahedron = np.array([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1.0]])
    assert log_det_information(tetrahedron) == pytest.approx(6 * np.log(2))
    drawn = rng.uniform(size=(2000, 4, 3))
    assert np.max(log_det_information(drawn)) <= 6 * np.log(2)


@given(postures(), st.randoms(use_true_random=False))
def test_log_det_ignores_order(points: np.ndarray, random: object) -> None:
    order = list(range(len(points)))
    random.shuffle(order)  # type: ignore[attr-defined]  # random.Random
    np.testing.assert_allclose(
        log_det_gram(points[order]), log_det_gram(points), rtol=1e-10, atol=1e-10
    )


@given(postures(), st.floats(-1e3, 1e3))
def test_log_det_ignores_shift(points: np.ndarray, shift: float) -> None:
    np.testing.assert_allclose(
        log_det_gram(points + shift), log_det_gram(points), rtol=1e-7, atol=1e-7
    )


@given(postures(), st.floats(1e-3, 1e5), st.integers(1, 4))
def test_log_det_gains_a_constant_under_scaling(
    points: np.ndarray, scale: float, m: int
) -> None:
    n = points.shape[1]
    np.testing.assert_allclose(
        log_det_information(points * scale, m),
        log_det_information(points, m) + 2 * n * m * np.log(scale),
        rtol=1e-9,
        atol=1e-8,
    )


@given(postures())
def test_another_posture_never_removes_information(points: np.ndarray) -> None:
    more = np.vstack([points, points[:1] * 0.5])
    assert log_det_gram(more) >= log_det_gram(points) - 1e-12


def test_leading_axes_are_batches(rng: np.random.Generator) -> None:
    points = rng.normal(size=(2, 5, 6, 3))
    for function in (
        regressors,
        regression_matrix,
        log_det_gram,
        log_det_information,
    ):
        whole = np.asarray(function(points))
        assert whole.shape[:2] == (2, 5)
        for i in range(2):
            for j in range(5):
                np.testing.assert_allclose(
                    whole[i, j], function(points[i, j]), rtol=1e-12, atol=1e-12
                )


def test_encoder_pulses_far_from_zero_keep_their_digits(
    rng: np.random.Generator,
) -> None:
    small = rng.integers(0, 1000, (6, 3)).astype(float)
    far = small + 2.0**40
    assert log_det_gram(far) == pytest.approx(log_det_gram(small), abs=1e-9)


@settings(max_examples=50)
@given(st.integers(2, 4), st.integers(0, 2**32 - 1), st.floats(-6, 6), st.floats(-6, 6))
def test_planar_postures_are_singular(
    n: int, seed: int, size: float, offset: float
) -> None:
    rng = np.random.default_rng(seed)
    flat = rng.uniform(size=(9, n - 1)) @ rng.normal(size=(n - 1, n))
    flat = flat * 10.0**size + 10.0**offset
    assert log_det_information(flat) == -np.inf


def test_too_few_or_repeated_postures_are_singular(rng: np.random.Generator) -> None:
    assert log_det_information(rng.uniform(size=(3, 3))) == -np.inf
    assert (
        log_det_information(np.repeat(rng.uniform(size=(3, 3)), 4, axis=0)) == -np.inf
    )
    assert log_det_information(np.ones((8, 3))) == -np.inf
    batch = rng.uniform(size=(3, 5, 3))
    batch[1, :, 2] = 7.0
    assert np.isneginf(np.asarray(log_det_information(batch))).tolist() == [
        False,
        True,
        False,
    ]


@pytest.mark.parametrize(
    ("commands", "message"),
    [
        ([1.0, 2.0, 3.0], r"commands must have shape .*got \(3,\)"),
        (np.zeros((0, 3)), r"N >= 1.*got \(0, 3\)"),
        (np.zeros((4, 0)), r"n >= 1.*got \(4, 0\)"),
        ([["a", "b"]], "array of numbers"),
        ([[1.0, 2.0], [3.0]], "array of numbers"),
        ([[0.0, np.nan, 0.0]], r"must be finite, got nan at \(0, 1\)"),
        ([[0.0, 0.0], [np.inf, 0.0]], r"must be finite, got inf at \(1, 0\)"),
    ],
)
@pytest.mark.parametrize(
    "function", [regressors, regression_matrix, log_det_information]
)
def test_bad_commands_are_named(
    function: object, commands: object, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        function(commands)  # type: ignore[operator]  # one of the three functions


def test_bad_number_of_outputs_is_named() -> None:
    with pytest.raises(ValueError, match="num_outputs must be at least 1, got 0"):
        regression_matrix(np.eye(3), 0)
