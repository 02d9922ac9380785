"""Each criterion against its definition, its gradient against finite differences."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxcal
from jaxcal.selection.criteria import CRITERIA

P = 4
PICK = np.eye(P)[[0, 2]]


def information(rng, count=6):
    rows = rng.normal(size=(count, P))
    return rows.T @ rows


def made(name, rng, times=1):
    root = np.eye(P)
    if name == "I":
        root = rng.normal(size=(P, P))
    elif name in ("Ds", "As"):
        root = PICK
    elif name == "E":
        root = np.eye(P) + 0.2 * rng.normal(size=(P, P))
    return CRITERIA[name].of_rows(root, times)


def definition(criterion, m):
    """The reported value, by the inverse and numpy alone."""
    v = criterion.root @ np.linalg.inv(m) @ criterion.root.T
    if criterion.name in ("D", "Ds"):
        return -criterion.times * np.log(np.linalg.det(v))
    if criterion.name == "E":
        return 1.0 / np.linalg.eigvalsh(v)[-1]
    return criterion.times * np.trace(v)


@pytest.mark.parametrize("name", CRITERIA)
def test_value_is_the_definition_for_one_and_for_a_batch(name):
    rng = np.random.default_rng(0)
    criterion = made(name, rng, times=3)
    matrices = np.stack([information(rng) for _ in range(5)])
    values = criterion.reported(criterion.value(matrices))
    assert values.shape == (5,)
    for value, m in zip(values, matrices, strict=True):
        assert value == pytest.approx(definition(criterion, m), rel=1e-10)
        assert criterion.reported(criterion.value(m)) == pytest.approx(value)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), name=st.sampled_from(tuple(CRITERIA)))
def test_phi_is_concave_and_information_never_hurts(seed, name):
    rng = np.random.default_rng(seed)
    criterion = made(name, rng)
    at, other = information(rng), information(rng)
    chord = (criterion.value(at) + criterion.value(other)) / 2.0
    assert criterion.value((at + other) / 2.0) >= chord - 1e-9 * (1.0 + abs(chord))
    more = criterion.value(at + other)
    assert more >= criterion.value(at) - 1e-9 * abs(more)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    name=st.sampled_from(tuple(CRITERIA)),
    share=st.floats(0.05, 1.0),
)
def test_enough_is_the_bound_that_proves_the_share(seed, name, share):
    rng = np.random.default_rng(seed)
    criterion = made(name, rng, times=2)
    phi = float(criterion.value(information(rng)))
    slope, more = criterion.enough(share)
    bound = slope * phi + more
    found = criterion.efficiency(criterion.reported(phi), criterion.reported(bound))
    assert found == pytest.approx(share)
    assert bound >= phi - 1e-12


@pytest.mark.parametrize("name", CRITERIA)
def test_singular_information_is_never_a_finite_good_value(name):
    rng = np.random.default_rng(2)
    value = made(name, rng).value(information(rng, count=3))
    assert np.isneginf(value)


def test_a_factor_of_the_root_is_given_back_by_the_offset():
    rng = np.random.default_rng(3)
    m, factor = information(rng), rng.normal(size=(2, 2))
    offset = 2.0 * np.log(abs(np.linalg.det(factor)))
    changed = CRITERIA["Ds"].of_rows(factor @ PICK, 2, offset)
    plain = CRITERIA["Ds"].of_rows(PICK, 2)
    expected = plain.reported(plain.value(m))
    assert changed.reported(changed.value(m)) == pytest.approx(expected)


def test_i_of_noise_that_differs_by_row_is_the_mean_variance(rng):
    rows = np.linspace(0.0, 1.0, 9)[:, None]
    plain = np.hstack([np.ones((9, 1)), rows])
    model = jaxcal.models.Polynomial(1, 1, 1)
    for _ in range(5):
        std = 0.2 + rng.uniform(0.0, 2.0) * rows

        def mean_variance(chosen, std=std):
            white = plain[list(chosen)] / std[list(chosen)]
            return np.trace(np.linalg.inv(white.T @ white) @ plain.T @ plain) / 9

        best = min(map(mean_variance, itertools.combinations(range(9), 3)))
        for criterion in ("I", jaxcal.I(rows)):
            chosen = jaxcal.select(
                rows, 3, model=model, noise=jaxcal.Noise(std=std), criterion=criterion
            )
            assert chosen.proven
            np.testing.assert_allclose(mean_variance(chosen.indices), best, rtol=1e-9)
            # In units of the noise, which is 1 in root mean square.
            np.testing.assert_allclose(chosen.value * (std**2).mean(), best, rtol=1e-9)
