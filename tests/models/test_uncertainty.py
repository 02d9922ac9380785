"""Prior and Noise: what they resolve to, and what they refuse."""

from __future__ import annotations

import itertools

import hypothesis
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest

import jaxcal
from jaxcal.models import Affine, Noise, Polynomial, Prior

MODEL = Affine(1, 2)  # a11 a21 b1 b2


def test_names_that_are_left_out_are_unknown_and_stay_nominal():
    prior = Prior({"a11": 0.5, "b2": 2.0}, mean={"b1": 3.0}, fixed=["a21"])
    resolved = prior.resolve(MODEL)
    np.testing.assert_array_equal(resolved.mean, [1.0, 0.0, 3.0, 0.0])
    np.testing.assert_array_equal(resolved.precisions, [4.0, 0.0, 0.0, 0.25])
    np.testing.assert_array_equal(resolved.free, [True, False, True, True])


def test_one_number_and_a_row_of_them():
    assert not jaxcal.Prior(np.inf).resolve(MODEL).precisions.any()
    resolved = Prior([1.0, 2.0, np.inf, 4.0], mean=[1.0, 2.0, 3.0, 4.0]).resolve(MODEL)
    np.testing.assert_array_equal(resolved.precisions, [1, 0.25, 0, 1 / 16])
    np.testing.assert_array_equal(resolved.mean, [1.0, 2.0, 3.0, 4.0])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"std": {"a99": 1.0}},
            "parameter in std of the prior must be one of .* got 'a99'",
        ),
        (
            {"std": 1.0, "mean": {"x": 1}},
            "parameter in mean of the prior must be one of",
        ),
        ({"std": 1.0, "mean": np.nan}, "mean of the prior must be finite"),
        ({"std": 1.0, "fixed": ["x"]}, "parameter in fixed must be one of .* got 'x'"),
        ({"std": 1.0, "fixed": "b1"}, "fixed must be a sequence of names"),
        ({"std": [1.0, 2.0]}, r"one number or \(4,\) or a mapping"),
        ({"std": 0.0}, r"std of the prior must be positive .*, got \(0\)"),
        ({"std": {"a11": np.nan}}, r"must be positive .*, got \(nan\)"),
    ],
)
def test_a_prior_that_does_not_fit_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Prior(**arguments).resolve(MODEL)


def _covariances(draw, count, q):
    roots = draw(hnp.arrays(float, (count, q, q), elements=st.floats(-2, 2)))
    return roots @ np.matrix_transpose(roots) + 0.1 * np.eye(q)


@hypothesis.given(st.data(), st.integers(1, 4), st.integers(1, 4), st.integers(1, 3))
def test_whitened_noise_is_unit_noise(data, count, q, n):
    covariance = _covariances(data.draw, count, q)
    slopes = data.draw(hnp.arrays(float, (count, q, n), elements=st.floats(-2, 2)))
    spread = np.linspace(0.0, 1.0, n)
    noise = Noise(covariance=covariance, command_std=spread)
    white = noise.whitening(count, q, slopes)
    total = covariance + (slopes * spread**2) @ np.matrix_transpose(slopes)
    one = white @ total @ np.matrix_transpose(white)
    np.testing.assert_allclose(one, np.broadcast_to(np.eye(q), one.shape), atol=1e-8)


@hypothesis.given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 5))
def test_an_unknown_command_is_the_limit_of_a_large_one(seed, n, q):
    rng = np.random.default_rng(seed)
    slopes, blocks = rng.normal(size=(3, q, n)), rng.normal(size=(3, q, 5))
    std = rng.uniform(0.5, 2.0, (3, q))
    spread = np.where(np.arange(n) == 0, 0.3, np.inf)
    eaten = min(q, n - 1)
    white = Noise(std=std, command_std=spread).whitening(3, q, slopes)
    assert (np.count_nonzero(np.abs(white).max(axis=2) == 0.0, axis=1) == eaten).all()
    blocks = white @ blocks
    # Schur complement: command 0 with its spread, the others as free parameters.
    near = std[:, :, None] ** 2 * np.eye(q)
    near = near + 0.09 * slopes[:, :, :1] @ np.matrix_transpose(slopes[:, :, :1])
    free = slopes[:, :, 1:]
    inverse = np.linalg.inv(near)
    across = np.matrix_transpose(free) @ inverse
    reduced = inverse - np.matrix_transpose(across) @ (
        np.linalg.pinv(across @ free, rcond=1e-12) @ across
    )
    np.testing.assert_allclose(
        np.matrix_transpose(white) @ white, reduced, atol=1e-6 * np.abs(inverse).max()
    )


@pytest.mark.parametrize("noise", [
    Noise(), Noise(std=2.0), Noise(std=[1.0, 2.0]), Noise(std=np.full((3, 2), 0.5)),
    Noise(covariance=[[2.0, 1.0], [1.0, 2.0]]),
])  # fmt: skip
def test_noise_beside_another_adds_its_variance(noise):
    one, both = (each.whitening(3, 2) for each in (noise, noise.beside(0.7)))
    total = np.linalg.inv(np.matrix_transpose(one) @ one) + 0.49 * np.eye(2)
    np.testing.assert_allclose(np.matrix_transpose(both) @ both, np.linalg.inv(total))


def test_a_level_of_noise_for_everything_each_output_or_each_candidate():
    def first_rows(noise):
        return np.diagonal(noise.whitening(2, 3), axis1=1, axis2=2)

    np.testing.assert_array_equal(first_rows(Noise()), np.ones((2, 3)))
    np.testing.assert_array_equal(first_rows(Noise(std=0.5)), np.full((2, 3), 2.0))
    np.testing.assert_array_equal(
        first_rows(Noise(std=[1.0, 0.5, 0.25])), [[1.0, 2.0, 4.0]] * 2
    )
    std = np.array([[1.0, 1.0, 1.0], [0.5, 0.5, 0.25]])
    np.testing.assert_array_equal(first_rows(Noise(std=std)), 1.0 / std)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"std": 1.0, "covariance": np.eye(2)}, "std or covariance .* not both"),
        ({"std": 0.0}, "std of the noise must be positive"),
        ({"std": [1.0, 2.0, 3.0]}, r"std of the noise must be one number, \(2,\)"),
        ({"covariance": np.eye(3)}, r"covariance of the noise must be \(2, 2\)"),
        ({"covariance": [[1.0, 2.0], [0.0, 1.0]]}, "must be symmetric"),
        ({"covariance": -np.eye(2)}, "positive definite, got eigenvalue -1"),
        ({"command_std": -1.0}, "command_std must not be negative"),
        ({"command_std": 1.0}, "needs std or covariance of the readings too"),
        ({"std": 1.0, "command_std": 1.0}, "needs the derivative by the commands"),
        (
            {"std": 1.0, "command_std": [[1.0], [np.inf]]},
            "inf in a whole column",
        ),
    ],
)
def test_noise_that_cannot_be_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Noise(**arguments).whitening(4, 2)


def test_derivatives_of_another_shape_are_refused():
    noise = Noise(std=1.0, command_std=[0.1, 0.2])
    with pytest.raises(ValueError, match=r"command_std must be one number or \(3,\)"):
        noise.whitening(4, 2, np.ones((4, 2, 3)))
    with pytest.raises(ValueError, match=r"must have shape \(4, 2, n\)"):
        noise.whitening(4, 2, np.ones((3, 2, 2)))


def test_noise_of_each_candidate_goes_with_the_available_ones():
    rng = np.random.default_rng(0)
    commands = rng.uniform(-1.0, 1.0, (12, 1))
    available = np.arange(12) % 4 > 0
    model, std = Polynomial(1, 1, 2), rng.uniform(0.1, 1.0, (12, 2))
    rows = np.c_[np.ones(12), commands[:, 0]]
    best = max(
        sum(
            np.linalg.slogdet((rows[at] / std[at, j, None] ** 2).T @ rows[at])[1]
            for j in range(2)
        )
        for at in map(
            list, itertools.combinations(np.flatnonzero(available).tolist(), 3)
        )
    )
    for noise in (
        Noise(std=std),
        Noise(covariance=np.stack([np.diag(row**2) for row in std])),
    ):
        found = jaxcal.select(
            commands, 3, "exact", model=model, noise=noise, criterion="D",
            available=available,
        )  # fmt: skip
        assert found.log_det == pytest.approx(best)
        with pytest.raises(ValueError, match="the same for all candidates where meas"):
            jaxcal.select(
                commands, 3, model=model, noise=noise, measured=commands[:2],
                available=available,
            )  # fmt: skip


@pytest.mark.parametrize("noise", [
    jaxcal.Noise(0.3), jaxcal.Noise([0.1, 0.2]), jaxcal.Noise(np.full((4, 2), 0.5)),
    jaxcal.Noise(covariance=[[1.0, 0.2], [0.2, 2.0]]),
    jaxcal.Noise(0.1, command_std=[0.2, np.inf]),
    jaxcal.Noise(0.1, command_std=[[0.1, 0.3], [0.2, 0.1], [0.0, 0.4], [1.0, 0.2]]),
])  # fmt: skip
def test_rows_are_weighed_by_the_whitening_matrices(noise):
    rng = np.random.default_rng(0)
    rows, slopes = rng.normal(size=(4, 2, 3)), rng.normal(size=(4, 2, 2))
    found = noise.weigh(rows, slopes)
    np.testing.assert_allclose(found, noise.whitening(4, 2, slopes) @ rows, rtol=1e-14)
