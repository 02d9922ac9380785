"""How many postures: against brute force, against simulation, and what it refuses."""

from __future__ import annotations

import itertools
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from questions import criteria, plan

import jaxcal
from jaxcal.models import Affine, Noise, Polynomial, Prior, SerialChain
from jaxcal.reports import plots


def value_of(candidates, indices, criterion, region=None):
    where = candidates if region is None else region
    return getattr(criteria(candidates[list(indices)], where), criterion)


def brute_force(candidates, k, criterion, region=None, repeat=False):
    """The least criterion of any design of k, plain algebra."""
    choose = (
        itertools.combinations_with_replacement if repeat else (itertools.combinations)
    )
    where = candidates if region is None else region
    z, at = (np.c_[x, np.ones(len(x))] for x in (candidates, where))
    subsets = np.array(list(choose(range(len(candidates)), k)))
    grams = np.swapaxes(z[subsets], 1, 2) @ z[subsets]
    grams = grams[np.linalg.det(grams) > 1e-12]
    v = np.einsum("ra,bac,rc->br", at, np.linalg.inv(grams), at)
    return (v.max(axis=1) if criterion == "G" else v.mean(axis=1)).min()


@pytest.mark.parametrize("criterion", ["G", "I"])
@pytest.mark.parametrize("repeat", [False, True])
def test_the_smallest_k_and_the_bounds_hold_against_brute_force(criterion, repeat):
    for seed in range(3):
        candidates = np.random.default_rng(seed).random((9, 2))
        best = {
            k: brute_force(candidates, k, criterion, repeat=repeat) for k in range(3, 7)
        }
        target = 0.5 * np.sqrt(best[5] * 1.0001)
        found = plan(
            candidates,
            accuracy=target,
            noise_std=0.5,
            criterion=criterion,
            max_replicates=8 if repeat else 1,
            more=1,
        )
        assert found.k == 5
        for row in found.rows:
            truth = 0.5 * np.sqrt(best[row.k])
            assert row.least_error[0] <= truth * (1 + 1e-9)
            assert row.standard_error[0] >= truth * (1 - 1e-9)
            assert row.standard_error[0] <= truth * 1.02
        if found.smallest_proven:
            assert 0.5 * np.sqrt(best[4]) > target


@settings(max_examples=10)
@example(1398425, "G", 1, True)  # not even all fourteen are enough
@given(st.integers(0, 2**31), st.sampled_from("GI"), st.integers(1, 3), st.booleans())
def test_laws_of_a_plan(seed, criterion, cap, with_region):
    rng = np.random.default_rng(seed)
    candidates = rng.random((14, 3)) * 50 - 20
    region = rng.random((7, 3)) * 50 - 20 if with_region else None
    wanted = {
        "accuracy": 1.2,
        "noise_std": 1.0,
        "criterion": criterion,
        "region": region,
        "max_replicates": cap,
    }
    everything = np.repeat(np.arange(14), cap)
    if np.sqrt(value_of(candidates, everything, criterion, region)) > 1.2:
        with pytest.raises(ValueError, match="cannot be reached"):
            plan(candidates, **wanted)
        return
    found = plan(candidates, **wanted)
    assert len(found.indices) == found.k
    assert np.bincount(found.indices).max() <= cap
    assert (found.standard_error <= 1.2 * (1 + 1e-9)).all()
    value = value_of(candidates, found.indices, criterion, region)
    np.testing.assert_allclose(found.standard_error, np.sqrt(value), rtol=1e-8)
    errors = [row.standard_error[0] for row in found.rows]
    assert all(a >= b * (1 - 1e-9) for a, b in itertools.pairwise(errors))
    assert all(
        (row.least_error <= row.standard_error * (1 + 1e-9)).all() for row in found.rows
    )
    assert [row.k for row in found.rows] == list(range(4, found.k + 1))


def test_an_affine_map_changes_no_k_and_no_error(rng):
    candidates = rng.random((15, 3))
    mapped = candidates @ (rng.normal(size=(3, 3)) + 2 * np.eye(3)) * 1e4 + 3e4
    first, second = (plan(c, accuracy=0.9, noise_std=1.0) for c in (candidates, mapped))
    assert first.k == second.k
    np.testing.assert_allclose(
        first.rows[0].least_error, second.rows[0].least_error, rtol=1e-6
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::jaxcal.CalibrationWarning")  # one in a hundred
@pytest.mark.parametrize("criterion", ["G", "I"])
def test_simulated_calibrations_err_as_planned(rng, criterion):
    candidates = rng.random((20, 3)) * 40 - 20
    noise = np.array([0.05, 0.1, 0.2])
    found = plan(
        candidates,
        accuracy=0.17,
        noise_std=noise,
        criterion=criterion,
        max_replicates=3,
    )
    matrix, bias = np.diag([0.43, 0.71, 0.87]), np.array([3.1, -5.8, 2.41])
    commands = candidates[found.indices]
    trials = 1500
    errors = np.empty((trials, 20, 3))
    for trial in range(trials):
        measured = commands @ matrix.T + bias + rng.normal(size=(found.k, 3)) * noise
        fitted = jaxcal.identify(commands, measured, noise_std=noise)
        errors[trial] = fitted.predict(candidates) - candidates @ matrix.T - bias
    spread = np.sqrt((errors**2).mean(axis=0))  # (M, m)
    seen = spread.max(0) if criterion == "G" else np.sqrt((spread**2).mean(axis=0))
    np.testing.assert_allclose(seen, found.standard_error, rtol=0.08)
    assert (found.standard_error <= 0.17).all()
    predicted = fitted.predict_std(candidates)
    told = (
        predicted.max(axis=0)
        if criterion == "G"
        else np.sqrt((predicted**2).mean(axis=0))
    )
    np.testing.assert_allclose(told, found.standard_error, rtol=1e-6)


def test_replicates_need_no_more_measurements(rng):
    candidates = rng.random((12, 3))
    wanted = {"accuracy": 0.8, "noise_std": 1.0}
    single = plan(candidates, **wanted)
    several = plan(candidates, max_replicates=4, **wanted)
    assert several.k <= single.k


def test_the_bound_is_that_of_kiefer_and_wolfowitz_where_nothing_limits(rng):
    """The corners of a cube are its G-optimal design: p / K is reached at K = 8."""
    corners = np.array(list(itertools.product([0.0, 1.0], repeat=3)))
    found = plan(corners, accuracy=np.sqrt(0.5) * (1 + 1e-9), noise_std=1.0)
    assert found.k == 8
    assert found.rows[-1].least_error[0] == pytest.approx(np.sqrt(4 / 8))
    assert found.smallest_proven


def test_required_and_masked_postures_are_kept(rng):
    candidates = rng.random((15, 3))
    available = np.arange(15) != 4
    found = plan(
        candidates,
        accuracy=0.9,
        noise_std=1.0,
        required=[2, 7],
        available=available,
    )
    assert {2, 7} <= set(found.indices.tolist())
    assert 4 not in found.indices


def test_required_postures_in_a_plane_raise_the_least_k(rng):
    candidates = np.r_[rng.random((6, 3)) * [1, 1, 0], rng.random((8, 3))]
    found = plan(candidates, accuracy=9.0, noise_std=1.0, required=[0, 1, 2, 3, 4])
    assert found.k == 6


def test_each_output_has_its_own_target(rng):
    candidates = rng.random((15, 3))
    strict = plan(candidates, accuracy=[9, 9, 0.9], noise_std=1.0)
    loose = plan(candidates, accuracy=0.9, noise_std=[0.1, 0.1, 1.0])
    assert strict.k == loose.k
    assert strict.standard_error.shape == (3,)


def test_out_of_reach_names_the_best_achievable(rng):
    candidates = rng.random((9, 3))
    everything = np.sqrt(value_of(candidates, range(9), "G"))
    with pytest.raises(ValueError, match=r"= 0\.01 cannot be reached") as error:
        plan(candidates, accuracy=0.01, noise_std=1.0)
    assert f"{everything:.6g}" in str(error.value)
    assert ": all 9 measurements give" in str(error.value)
    with pytest.raises(ValueError, match="reached: 5 measurements give"):
        plan(candidates, accuracy=0.01, noise_std=1.0, max_k=5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"criterion": "D"}, "criterion must be one of G, I, parameters, got 'D'"),
        ({"noise_std": 0.0}, "noise_std must be positive, got 0"),
        ({"noise_std": [1.0, 2.0]}, "noise_std must be one number"),
        ({"accuracy": -1.0}, "accuracy must be positive, got -1"),
        ({"accuracy": np.nan}, "accuracy must be finite"),
        ({"max_k": 3}, "max_k must be at least 4, got 3"),
        ({"max_k": 13}, "max_k must not exceed the 12 measurements allowed, got 13"),
        ({"more": -1}, "more must be at least 0, got -1"),
        ({"region": np.zeros((3, 2))}, r"region must have shape \(N, 3\)"),
        ({"required": [40]}, "required must lie in"),
        ({"candidates": np.zeros(3)}, r"candidates must have shape \(M, n\)"),
        ({"candidates": np.zeros((9, 3))}, "candidates must vary"),
    ],
)
def test_bad_requests_name_argument_rule_and_value(rng, change, message):
    given = {
        "candidates": rng.random((12, 3)),
        "accuracy": 1.0,
        "noise_std": 1.0,
    } | change
    with pytest.raises(ValueError, match=message):
        plan(given.pop("candidates"), **given)


def test_the_table_and_the_figure_show_every_row(rng):
    found = plan(rng.random((15, 3)), accuracy=0.9, noise_std=1.0, more=2)
    lines = str(found).splitlines()
    assert len(lines) == len(found.rows) + 3
    assert sum(line.endswith("<-") for line in lines) == 1
    axes = plots.plan(Figure().add_subplot(), found)
    assert len(axes.lines[0].get_xdata()) == len(found.rows)
    assert "standard error" in axes.get_ylabel()


def test_a_masked_candidate_may_hold_anything(rng):
    candidates = rng.random((15, 3))
    wanted = {"accuracy": 0.9, "noise_std": 1.0}
    available = np.arange(15) != 4
    plain = plan(candidates, available=available, **wanted)
    candidates[4] = np.nan
    odd = plan(candidates, available=available, **wanted)
    assert odd.indices.tolist() == plain.indices.tolist()


def test_a_plan_keeps_its_own_levels(rng):
    noise, target = np.array([0.1, 0.1, 1.0]), np.array([0.9, 0.9, 0.9])
    found = plan(rng.random((15, 3)), accuracy=target, noise_std=noise)
    table = str(found)
    noise[:] = 7.0
    target[:] = 7.0
    assert str(found) == table
    with pytest.raises(ValueError, match="read-only"):
        found.noise_std[0] = 2.0


def test_planning_loads_neither_jax_nor_matplotlib():
    code = (
        "import sys, numpy, jaxcal\n"
        "c = numpy.random.default_rng(0).random((9, 3))\n"
        "jaxcal.Design(c).plan(accuracy=2.0, noise_std=1.0)\n"
        "print(sorted({'jax', 'matplotlib'} & set(sys.modules)))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize("criterion", ["G", "I", "parameters"])
@pytest.mark.parametrize("known", [False, True])
def test_blocks_are_planned_as_by_brute_force(criterion, known):
    """Blocks of two rows, three parameters of very different size, several outputs."""
    rng = np.random.default_rng(4)
    size = np.array([1.0, 1e3, 1e-2])
    blocks = rng.normal(size=(8, 2, 3)) * size
    prior = np.diag([0.5, 0.0, 1.0]) * size**2 if known else None
    region = rng.normal(size=(5, 2, 3)) * size
    target = np.array([1.0, 2.0])
    if criterion == "parameters":
        target = np.array([1.0, 1e-3, 1e9])  # the third does not matter

    def shares(indices):
        """(outputs,) standard error as a share of the target."""
        rows = blocks[list(indices)].reshape(-1, 3)
        cov = np.linalg.inv(rows.T @ rows + (0.0 if prior is None else prior))
        if criterion == "parameters":
            return np.sqrt(np.diagonal(cov)) / target
        v = np.einsum("rop,pq,roq->ro", region, cov, region)
        return np.sqrt(v.max(0) if criterion == "G" else v.mean(0)) / target

    best = {
        k: min(shares(s).max() for s in itertools.combinations(range(8), k))
        for k in range(2, 6)
    }
    found = plan(
        blocks=blocks,
        prior=prior,
        region=None if criterion == "parameters" else region,
        accuracy=target * best[4] * 1.0001,
        criterion=criterion,
        more=1,
    )
    assert found.k == 4
    for row in found.rows:
        share = shares(row.indices)
        np.testing.assert_allclose(
            row.standard_error / found.accuracy,
            share / best[4] / 1.0001,
            rtol=1e-8,
        )
        if row.k in best:
            worst = found.hardest_output
            truth = best[row.k] * target[worst]
            assert row.least_error[worst] <= truth * (1 + 1e-9)
            assert share.max() <= best[row.k] * 1.02
    assert "parameter" in str(found) or criterion != "parameters"


def test_blocks_of_affine_rows_are_planned_as_the_candidates(rng):
    candidates = rng.random((12, 2))
    rows = np.c_[candidates, np.ones(12)][:, None]
    one = plan(candidates, accuracy=0.09, noise_std=0.1)
    other = plan(blocks=rows / 0.1, region=rows, accuracy=0.09)
    assert other.k == one.k
    for mine, its in zip(other.rows, one.rows, strict=True):
        np.testing.assert_allclose(mine.standard_error, its.standard_error[:1])
        np.testing.assert_allclose(mine.least_error, its.least_error[:1], rtol=1e-6)


def test_the_first_k_is_one_that_identifies():
    """Two rows each, but three of the four parameters only, or the fourth only."""
    blocks = np.random.default_rng(0).normal(size=(10, 2, 4))
    blocks[:6, :, 3] = 0.0
    blocks[6:, :, :3] = 0.0
    found = plan(blocks=blocks, accuracy=1e3)
    assert found.k == 3
    assert np.linalg.matrix_rank(blocks[found.indices].reshape(-1, 4)) == 4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"noise_std": 1.0}, "noise_std must be left out with blocks"),
        ({"region": np.zeros((3, 2))}, r"region must have shape \(R, m, 3\), got"),
        ({"blocks": None, "candidates": np.eye(3)}, "noise_std is missing: the des"),
        ({"parameters": [0]}, "parameters needs criterion="),
        ({"noise": Noise(1.0)}, "noise and noise_std must be left out with blocks"),
        ({"accuracy": [1.0, 2.0, 3.0]}, r"accuracy must be one number"),
    ],
)
def test_bad_requests_with_blocks_are_named(rng, change, message):
    given = {"blocks": rng.normal(size=(8, 2, 3)), "accuracy": 1.0} | change
    with pytest.raises(ValueError, match=message):
        plan(**given)


def an_arm(rng):
    """Two joints, 19 parameters, three outputs of unequal noise."""
    model = SerialChain.from_dh([(100, 0, 50, 0), (80, 90, 0, 0)])
    names = [name for name in model.names if name.startswith("base")]
    prior = Prior(model.default_prior().std, fixed=names)
    return model, prior, Noise([0.1, 0.2, 0.1]), rng.uniform(-90, 90, (8, 2))


def a_polynomial(rng):
    """Six parameters of which nothing is known, one output."""
    return Polynomial(2, 2, 1), None, Noise(0.1), rng.random((8, 2))


@pytest.mark.parametrize("criterion", ["G", "I", "parameters"])
@pytest.mark.parametrize("make", [an_arm, a_polynomial])
def test_any_model_is_planned_as_by_brute_force(make, criterion):
    rng = np.random.default_rng(1)
    model, prior, noise, candidates = make(rng)
    measured, region = candidates[:4] + 0.01, candidates[:3] + 0.3
    known = (prior or model.default_prior()).resolve(model)
    asked = [model.names.index(name) for name in known_names(model, known)[:2]]

    def jacobian(commands):
        return model.jacobian(commands)[..., known.free]

    def variances(indices):
        """(outputs,) summed up by the criterion, in the outputs' unit."""
        rows = np.concatenate([jacobian(measured), jacobian(candidates[list(indices)])])
        rows = rows / np.atleast_1d(noise.std)[:, None]
        information = np.einsum("kqa,kqb->ab", rows, rows)
        information += np.diag(known.precisions[known.free])
        cov = np.linalg.inv(information)
        if criterion == "parameters":
            return np.diagonal(cov)[asked]
        at = jacobian(region)
        v = np.einsum("rop,pq,roq->ro", at, cov, at)
        return v.max(0) if criterion == "G" else v.mean(0)

    best = {
        k: min(np.sqrt(variances(s).max()) for s in itertools.combinations(range(8), k))
        for k in (2, 3, 4)
    }
    given = {"criterion": criterion, "parameters": known_names(model, known)[:2]}
    if criterion != "parameters":
        given = {"criterion": criterion, "region": region}
    found = plan(
        candidates,
        model=model,
        prior=prior,
        noise=noise,
        measured=measured,
        accuracy=best[3] * 1.0001,
        more=1,
        **given,
    )
    assert found.k == 3
    for row in found.rows[-2:]:
        truth = np.sqrt(variances(row.indices))
        np.testing.assert_allclose(row.standard_error, truth, rtol=1e-7)
        assert row.least_error.max() <= best[row.k] * (1 + 1e-9)
        assert truth.max() <= best[row.k] * 1.02
    assert found.names[found.hardest_output] in str(found)


def known_names(model, known):
    return [n for n, free in zip(model.names, known.free, strict=True) if free]


def test_the_affine_model_given_is_that_which_is_meant(rng):
    candidates, noise = rng.random((12, 2)), [0.1, 0.3]
    wanted = {"accuracy": 0.3, "measured": candidates[:3]}
    one = plan(candidates, noise_std=noise, **wanted)
    same = plan(candidates, model=Affine(2, 2), noise=Noise(noise), **wanted)
    full = plan(
        candidates, model=Affine(2, 2), noise=Noise(covariance=np.diag(noise) ** 2),
        **wanted,
    )  # fmt: skip
    assert one.k == same.k == full.k
    np.testing.assert_array_equal(one.standard_error, same.standard_error)
    np.testing.assert_allclose(one.standard_error, full.standard_error, rtol=1e-6)
    assert full.noise_std is None and "noise" not in str(full)
