"""Every criterion against its definition on the full information matrix."""

import numpy as np
import pytest
from questions import criteria

from jaxcal.information.regression import regression_matrix


@pytest.fixture(params=[(4, 3, None), (9, 3, None), (6, 2, 5), (3, 1, None), (8, 4, 1)])
def case(request):
    num_postures, n, m = request.param
    rng = np.random.default_rng(num_postures)
    return rng.random((num_postures, n)) * 10, rng.random((30, n)) * 10, m


def test_the_alphabet_is_that_of_the_whole_matrix(case):
    postures, region, m = case
    a = regression_matrix(postures, m)
    s = a.T @ a
    found = criteria(postures, region, m)
    size = len(s)
    assert found.D == pytest.approx(np.linalg.det(s) ** (1 / size), rel=1e-8)
    assert found.A == pytest.approx(np.trace(np.linalg.inv(s)), rel=1e-8)
    assert found.E == pytest.approx(np.linalg.eigvalsh(s)[0], rel=1e-8)


def test_i_and_g_are_mean_and_largest_prediction_variance(case):
    postures, region, m = case
    a = regression_matrix(postures, m)
    covariance = np.linalg.inv(a.T @ a)
    outputs = postures.shape[1] if m is None else m
    variance = []
    for posture in region:
        rows = regression_matrix(posture[None], m)  # one row an output
        variance.append(np.trace(rows @ covariance @ rows.T) / outputs)
    found = criteria(postures, region, m)
    assert pytest.approx(np.mean(variance), rel=1e-8) == found.I
    assert pytest.approx(np.max(variance), rel=1e-8) == found.G


def test_observability_indices_are_those_of_the_whole_regressor(case):
    postures, region, m = case
    s = np.linalg.svd(regression_matrix(postures, m), compute_uv=False)
    found = criteria(postures, region, m)
    mean = np.exp(np.log(s).mean())
    assert pytest.approx(mean / np.sqrt(len(postures)), rel=1e-8) == found.O1
    assert pytest.approx(s[-1] / s[0], rel=1e-8) == found.O2
    assert pytest.approx(s[-1], rel=1e-8) == found.O3
    assert pytest.approx(s[-1] ** 2 / s[0], rel=1e-8) == found.O4
    assert pytest.approx(1 / np.sum(1 / s), rel=1e-8) == found.O5


def test_i_and_g_do_not_depend_on_the_unit(case):
    postures, region, m = case
    n = postures.shape[1]
    scale, shift = np.linspace(1, 50, n), np.linspace(1e4, -1e5, n)
    plain = criteria(postures, region, m)
    mapped = criteria(postures * scale + shift, region * scale + shift, m)
    assert pytest.approx(plain.I, rel=1e-6) == mapped.I
    assert pytest.approx(plain.G, rel=1e-6) == mapped.G
    assert mapped.D / plain.D == pytest.approx(
        np.prod(scale) ** (2 / (n + 1)), rel=1e-6
    )


def test_g_is_at_least_the_number_of_regressors_over_postures():
    corners = np.stack(np.meshgrid([0.0, 1], [0.0, 1], [0.0, 1]), axis=-1).reshape(8, 3)
    found = criteria(corners)  # a factorial is G-optimal: Kiefer and Wolfowitz
    assert pytest.approx(4 / 8) == found.G
    assert criteria(np.random.default_rng(0).random((8, 3))).G > 4 / 8
