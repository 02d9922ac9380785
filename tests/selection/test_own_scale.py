"""Units change nothing but units, and far rows hide nothing of the others."""

from __future__ import annotations

import time

import exactly
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxcal
from jaxcal import Noise
from jaxcal.models import Polynomial


def asked(name):
    """As and Ds of the constant."""
    return {"As": jaxcal.As(["1"]), "Ds": jaxcal.Ds(["1"])}.get(name, name)


def share(value, best, name):
    """How far apart two values are."""
    size = max(1.0, abs(best)) if name in ("D", "Ds") else abs(best)
    return (value - best) / size


@pytest.mark.parametrize("far", [1e4, 3e7, 1e9, 1e12])
@pytest.mark.parametrize("name", ["D", "A", "I", "E", "As", "Ds"])
def test_a_far_row_hides_no_better_selection(name, far):
    """The proven value is that of brute force in exact fractions."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        x = np.unique(rng.integers(-5, 6, size=7)).astype(float)
        x = np.append(x, [far, -0.7 * far] if seed % 3 == 0 else [-far])
        rows, k = np.stack([np.ones(len(x)), x], axis=1), 2 + seed % 2
        best = exactly.best_choice(name, rows, k, [0])
        design = jaxcal.Design(x[:, None], Polynomial(1, 1))
        found = design.select(k, asked(name), "exact")
        assert abs(share(found.value, best, name)) < 1e-9
        sign = 1.0 if name in ("D", "E", "Ds") else -1.0
        assert sign * share(found.bound, best, name) > -1e-9
        assert found.proven or far > 1e11


@pytest.mark.parametrize("name", ["D", "A", "I", "As", "Ds"])
def test_a_far_row_of_a_quadratic_hides_no_better_selection(name):
    x = np.array([-2.0, -1.0, 0.0, 1.0, 2.0, 3000.0])
    rows = np.stack([np.ones(6), x, x**2], axis=1)
    best = exactly.best_choice(name, rows, 3, [0])
    design = jaxcal.Design(x[:, None], Polynomial(2, 1))
    found = design.select(3, asked(name), "exact")
    assert found.proven
    assert abs(share(found.value, best, name)) < 1e-9


def test_a_selection_without_the_far_row_has_its_eigenvalue():
    x = np.array([1e4, -2.0, 1.0, 1.0, -1.0])
    scored = jaxcal.Design(x[:, None], Polynomial(1, 1)).score([1, 2, 4], "E")
    assert scored.value == pytest.approx(2.0, rel=1e-8)
    assert scored.criteria.A == pytest.approx(1 / 2 + 1 / 7, rel=1e-8)


powers = st.integers(-12, 12).map(lambda exponent: 10.0**exponent)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), powers, powers, st.sampled_from(["D", "I", "As", "Ds"]))
def test_units_of_commands_and_noise_change_only_units(seed, unit, std, name):
    """Blocks [1, x, x^2] of a command in any unit; I is in units of the noise."""
    x = np.random.default_rng(seed).uniform(-1.0, 1.0, 12)

    def design(x, noise):
        rows = np.stack([np.ones(12), x, x * x], axis=1)
        return jaxcal.Design.from_blocks(rows[:, None], noise=noise)

    criterion = {"As": jaxcal.As([0]), "Ds": jaxcal.Ds([0])}.get(name, name)
    plain = design(x, None).select(4, criterion, "exact")
    other = design(x * unit, Noise(std=std))
    found, back = (
        other.select(4, criterion, "exact"),
        other.score(plain.indices, criterion),
    )
    assert found.proven == plain.proven
    if name in ("D", "Ds"):
        count = 3 if name == "D" else 1
        expected = plain.value + 2.0 * count * np.log((unit if count == 3 else 1) / std)
        assert found.value == pytest.approx(expected, abs=1e-8)
        assert back.value == pytest.approx(found.value, abs=1e-8)
    else:
        expected = plain.value * (std**2 if name == "As" else 1.0)
        assert found.value == pytest.approx(expected, rel=1e-8)
        assert back.value == pytest.approx(found.value, rel=1e-8)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10**6), st.lists(powers, min_size=3, max_size=3), powers)
def test_units_of_parameters_and_prior_change_only_units(seed, units, std):
    rng = np.random.default_rng(seed)
    blocks, root = rng.normal(size=(9, 2, 3)), rng.normal(size=(1, 3))
    plain = jaxcal.Design.from_blocks(blocks, prior=root.T @ root, max_replicates=2)
    scale = np.array(units)
    prior = (root * scale).T @ (root * scale) / std**2
    other = jaxcal.Design.from_blocks(
        blocks * scale, prior=prior, noise=Noise(std=std), max_replicates=2
    )
    found, same = other.select(2, "D", "exact"), plain.select(2, "D", "exact")
    expected = same.value + 2.0 * np.log(scale / std).sum()
    assert found.value == pytest.approx(expected, abs=1e-8)
    means = [each.select(2, "I", "exact").value for each in (other, plain)]
    assert means[0] == pytest.approx(means[1], rel=1e-8)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), powers, powers)
def test_units_change_no_plan(seed, unit, std):
    u = np.random.default_rng(seed).uniform(-1.0, 1.0, (8, 2))
    plain = jaxcal.Design(u, Polynomial(1, 2)).plan(1.0, 1.0)
    other = jaxcal.Design(u * unit, Polynomial(1, 2)).plan(std, std)
    assert other.k == plain.k
    assert other.smallest_proven == plain.smallest_proven
    np.testing.assert_allclose(other.standard_error, plain.standard_error * std)


def test_a_mean_variance_beside_a_weak_prior_is_that_of_exact_fractions():
    """What only the prior knows is large, and must not be lost in rounding."""
    rng = np.random.default_rng(0)
    for weak in (1.0, 1e-4, 1e-8, 1e-12):
        rows = np.round(rng.uniform(-1, 1, (7, 3)), 3)
        rows[:, 2] *= 2.0**-24
        prior = np.diag([0.0, 0.0, weak])
        found = jaxcal.select(blocks=rows[:, None], prior=prior, k=3, criterion="I")
        exact = exactly.fractions(rows)
        total = exactly.information(
            [exact[i] for i in found.indices], exactly.fractions(prior)
        )
        expected = exactly.worth("I", total, region=exact)
        assert found.value == pytest.approx(expected, rel=1e-9)


def test_a_score_without_a_required_candidate_is_refused(rng):
    design = jaxcal.Design(rng.random((8, 2)), required=[3])
    with pytest.raises(ValueError, match=r"indices lack the required candidate 3$"):
        design.score([0, 1, 2])


@pytest.mark.parametrize("criterion", "AE")
def test_blocks_of_the_smallest_numbers_are_refused(criterion):
    blocks = np.array([[[1.0, 0.0]], [[0.0, 1.0]], [[1.0, 1.0]]]) * 6e-309
    with pytest.raises(ValueError, match="in double precision"):
        jaxcal.select(blocks=blocks, criterion=criterion)


@pytest.mark.parametrize("name", ["A", "E"])
def test_what_double_precision_cannot_hold_is_refused_by_name(name):
    u = np.random.default_rng(0).random((12, 2)) * 1e-155
    with pytest.raises(ValueError, match=f"criterion {name} is .* in doub"):
        jaxcal.select(u, criterion=name)
    assert jaxcal.select(u).proven


def test_what_is_left_without_each_measurement_is_told(rng):
    x = np.array([-1.0, 0.0, 0.0, 1.0])
    selection = jaxcal.Design(x[:, None], Polynomial(2, 1)).score([0, 1, 2, 3])
    rows = np.stack([np.ones(4), x, x**2], axis=1)
    whole = np.linalg.det(rows.T @ rows)
    rest = [np.delete(rows, i, axis=0) for i in range(4)]
    expected = [max(np.linalg.det(some.T @ some), 0.0) / whole for some in rest]
    np.testing.assert_allclose(selection.left_without, expected, atol=1e-12)
    ends = "without one   singular without candidate 0 or 3\n"
    assert ends in str(selection)
    fewest = jaxcal.select(rng.random((9, 3)))
    np.testing.assert_array_equal(fewest.left_without, 0.0)
    assert "singular, whichever measurement is lost" in str(fewest)
    more = jaxcal.select(rng.random((9, 3)), 6)
    worst = more.left_without.argmin()
    share = f"{100 * more.left_without[worst]:.3g} % of det S remains\n"
    assert f"losing candidate {more.indices[worst]} costs most: {share}" in str(more)


def test_a_time_limit_is_kept_by_many_best_and_by_many_replicates(rng):
    """Of the processor's time, which a busy machine does not stretch."""
    u = rng.random((3000, 3))
    begun = time.process_time()
    many = jaxcal.select(u, 6, "exact", best=2000, time_limit=1)
    assert 1 <= len(many.alternatives) <= 2000
    values = [each.value for each in many.alternatives]
    assert values == sorted(values, reverse=True)
    assert len({tuple(each.indices) for each in many.alternatives}) == len(values)
    often = jaxcal.select(u[:200], 50_000, "exact", max_replicates=50_000, time_limit=1)
    assert len(often.indices) == 50_000
    assert time.process_time() - begun < 4.0
