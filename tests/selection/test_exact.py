"""The exact solver against brute force over the full 12 x 12 matrix, and its laws."""

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from questions import make_problem, score

from jaxcal.models import Affine
from jaxcal.selection import exact_batch, exchange_batch, select
from jaxcal.selection.exact import exact as exact_module
from jaxcal.selection.exact.branch_and_bound import Scenario, branch_and_bound
from jaxcal.selection.exact.exact import largest_volume, solve_exact, upper_bound
from jaxcal.selection.exchange.exchange import exchange_indices


def full_log_dets(candidates, subsets, num_outputs=None):
    """(S,) log det of the whole information matrix, regressor by regressor."""
    m = candidates.shape[1] if num_outputs is None else num_outputs
    z = np.c_[candidates, np.ones(len(candidates))]
    outer = z[:, :, None] * z[:, None, :]
    gram = outer[np.asarray(subsets)].sum(axis=1)
    whole = np.stack([np.kron(g, np.eye(m)) for g in gram])
    sign, value = np.linalg.slogdet(whole)
    return np.where(sign > 0, value, -np.inf)


def brute_force(candidates, k, cap=1, available=None, required=(), num_outputs=None):
    """Every selection allowed with its log det, best first."""
    m = len(candidates)
    usable = [i for i in range(m) if available is None or available[i]]
    if cap == 1:
        pool = itertools.combinations(usable, k)
    else:
        pool = itertools.combinations_with_replacement(usable, k)
    subsets = [
        s
        for s in pool
        if all(s.count(i) <= cap for i in set(s)) and all(i in s for i in required)
    ]
    values = full_log_dets(candidates, subsets, num_outputs)
    order = np.argsort(-values, kind="stable")
    return [subsets[i] for i in order], values[order]


def uniform(seed, m, n=3):
    return np.random.default_rng(seed).random((m, n))


def sphere(seed, m):
    points = np.random.default_rng(seed).normal(size=(m, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def grid(side):
    axis = np.linspace(0.0, 1.0, side)
    return np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("m", "k"), [(12, 4), (11, 5), (12, 8), (14, 12)])
def test_distinct_optimum_is_that_of_brute_force(seed, m, k):
    candidates = uniform(seed, m)
    found = select(candidates, k, "exact")
    _, values = brute_force(candidates, k)
    assert found.proven
    assert found.log_det == pytest.approx(values[0], abs=1e-8)
    assert len(set(found.indices.tolist())) == k


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("m", "k", "cap"), [(8, 4, 4), (8, 6, 2), (7, 8, 8), (7, 8, 3)]
)
def test_replicated_optimum_is_that_of_brute_force(seed, m, k, cap):
    candidates = uniform(seed, m)
    found = select(candidates, k, "exact", max_replicates=cap)
    _, values = brute_force(candidates, k, cap)
    assert found.proven
    assert found.log_det == pytest.approx(values[0], abs=1e-8)
    assert np.bincount(found.indices).max() <= cap


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("extra", [0, 1, 3])
@pytest.mark.parametrize("num_outputs", [None, 2])
def test_any_number_of_inputs_and_outputs(n, extra, num_outputs):
    candidates = uniform(n, 11, n)
    model = num_outputs and Affine(n, num_outputs)
    found = select(candidates, n + 1 + extra, "exact", model=model)
    _, values = brute_force(candidates, n + 1 + extra, num_outputs=num_outputs)
    assert found.log_det == pytest.approx(values[0], abs=1e-8)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("k", "r"), [(4, 1), (4, 2), (4, 4), (6, 1), (6, 3), (6, 6)])
def test_mask_and_required_are_those_of_brute_force(seed, k, r):
    rng = np.random.default_rng(seed)
    candidates = rng.random((12, 3))
    available = np.ones(12, dtype=bool)
    available[rng.permutation(12)[:2]] = False
    required = rng.permutation(np.flatnonzero(available))[:r]
    found = select(candidates, k, "exact", available=available, required=required)
    _, values = brute_force(candidates, k, 1, available, tuple(required))
    assert found.log_det == pytest.approx(values[0], abs=1e-8)
    assert available[found.indices].all()
    assert set(required) <= set(found.indices)


@pytest.mark.parametrize(
    ("k", "cap", "best"), [(4, 1, 1), (4, 1, 20), (6, 1, 25), (6, 6, 15)]
)
@pytest.mark.parametrize("seed", range(3))
def test_the_best_subsets_are_the_head_of_brute_force(seed, k, cap, best):
    candidates = uniform(seed, 9)
    found = select(candidates, k, "exact", best=best, max_replicates=cap)
    _, values = brute_force(candidates, k, cap)
    assert len(found.alternatives) == best
    assert [a.log_det for a in found.alternatives] == pytest.approx(
        values[:best], abs=1e-8
    )
    assert len({tuple(a.indices) for a in found.alternatives}) == best
    assert found.alternatives[0].log_det == found.log_det


@pytest.mark.parametrize("k", [4, 6])
def test_all_subsets_can_be_asked_for(k):
    candidates = uniform(0, 7)
    subsets, values = brute_force(candidates, k)
    found = select(candidates, k, "exact", best=10_000)
    assert {tuple(a.indices) for a in found.alternatives} == set(subsets)
    assert [a.log_det for a in found.alternatives] == pytest.approx(values, abs=1e-8)


@pytest.mark.parametrize("k", [4, 6])
def test_best_subsets_with_mask_and_required(k):
    candidates = uniform(5, 11)
    available = np.ones(11, dtype=bool)
    available[3] = False
    found = select(candidates, k, "exact", best=8, available=available, required=[7, 2])
    _, values = brute_force(candidates, k, 1, available, (7, 2))
    assert [a.log_det for a in found.alternatives] == pytest.approx(
        values[:8], abs=1e-8
    )


@pytest.mark.parametrize("k", [4, 5, 7])
@pytest.mark.parametrize("cap", [1, 2])
def test_duplicated_candidates(k, cap):
    candidates = np.repeat(uniform(1, 5), 2, axis=0)
    found = select(candidates, k, "exact", max_replicates=cap)
    _, values = brute_force(candidates, k, cap)
    assert found.log_det == pytest.approx(values[0], abs=1e-8)
    assert np.bincount(found.indices).max() <= cap
    best = select(candidates, k, "exact", max_replicates=cap, best=6)
    assert [a.log_det for a in best.alternatives] == pytest.approx(values[:6], abs=1e-8)


def test_required_duplicates_of_one_posture_are_both_kept():
    candidates = np.repeat(uniform(1, 6), 2, axis=0)
    found = select(candidates, 6, "exact", required=[0, 1])
    _, values = brute_force(candidates, 6, 1, None, (0, 1))
    assert {0, 1} <= set(found.indices)
    assert found.log_det == pytest.approx(values[0], abs=1e-8)


@pytest.mark.parametrize("k", [4, 8])
def test_grid_optimum_is_its_corners(k):
    corners = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
    _, values = brute_force(corners.astype(float), k)
    assert select(grid(4), k, "exact").log_det == pytest.approx(values[0], abs=1e-8)


def test_hull_enumeration_and_branch_and_bound_agree_on_a_sphere():
    problem = make_problem(sphere(0, 40), 4)
    enumerated = solve_exact(problem)
    start = np.bincount(exchange_indices(problem, 5), minlength=40)
    alone = Scenario(problem.blocks, problem.prior, problem.criterion)
    branched = branch_and_bound(alone, problem.lower, problem.upper, start)
    assert branched.proven
    assert problem.log_det(enumerated.indices) == pytest.approx(
        problem.log_det(np.flatnonzero(branched.counts[0])), abs=1e-8
    )


@pytest.mark.parametrize("q", range(1, 7))
@pytest.mark.parametrize("h", [8, 11])
def test_the_largest_volume_is_that_of_every_determinant(q, h):
    vectors = np.random.default_rng(q).normal(size=(h, q))
    subsets = np.array(list(itertools.combinations(range(h), q)))
    volumes = np.abs(np.linalg.det(vectors[subsets]))
    order = np.argsort(-volumes)
    found = largest_volume(vectors)
    np.testing.assert_array_equal(found.subset, subsets[order[0]])


def test_grouped_enumeration_agrees_with_branch_and_bound():
    problem = make_problem(uniform(3, 120), 4)
    found = largest_volume(problem.rows)  # all of them: no hull, the grouped products
    exact = solve_exact(problem)
    assert problem.log_det(found.subset) == pytest.approx(exact.bound, abs=1e-8)


@pytest.mark.parametrize("k", [4, 8, 12])
def test_degrees_with_unequal_ranges_give_the_pick_of_normalised_angles(k):
    candidates = uniform(7, 50)
    degrees = candidates * [30.0, 90.0, 4.0] + [-15.0, 200.0, 1000.0]
    for method in ("greedy", "exchange", "exact"):
        plain, mapped = select(candidates, k, method), select(degrees, k, method)
        assert sorted(plain.indices) == sorted(mapped.indices)
        shift = 6.0 * np.log([30.0, 90.0, 4.0]).sum()
        assert mapped.log_det == pytest.approx(plain.log_det + shift, abs=1e-7)


laws = settings(max_examples=25, deadline=None)
sizes = st.tuples(st.integers(0, 10**6), st.integers(10, 40), st.integers(4, 9))


@laws
@given(sizes)
def test_permuting_the_candidates_permutes_the_answer(size):
    seed, m, k = size
    candidates = uniform(seed, m)
    order = np.random.default_rng(seed).permutation(m)
    plain = select(candidates, k, "exact")
    moved = select(candidates[order], k, "exact")
    assert moved.log_det == pytest.approx(plain.log_det, abs=1e-8)


@laws
@given(sizes)
def test_an_affine_map_changes_only_the_constant(size):
    seed, m, k = size
    rng = np.random.default_rng(seed)
    candidates = rng.random((m, 3))
    matrix = rng.normal(size=(3, 3)) + 2 * np.eye(3)
    if np.linalg.cond(matrix) > 1e4:
        return
    mapped = candidates @ matrix.T + rng.normal(size=3) * 10
    shift = 6 * np.log(abs(np.linalg.det(matrix)))
    plain, moved = select(candidates, k, "exact"), select(mapped, k, "exact")
    assert moved.log_det == pytest.approx(plain.log_det + shift, abs=1e-7)


@laws
@given(sizes)
def test_one_more_candidate_or_more_replicates_never_lower_the_optimum(size):
    seed, m, k = size
    candidates = uniform(seed, m)
    fewer = select(candidates[:-1], k, "exact").log_det
    plain = select(candidates, k, "exact").log_det
    twice = select(candidates, k, "exact", max_replicates=2).log_det
    often = select(candidates, k, "exact", max_replicates=k).log_det
    assert fewer <= plain + 1e-8
    assert plain <= twice + 1e-8
    assert twice <= often + 1e-8


@laws
@given(sizes)
def test_the_relaxation_is_an_upper_bound(size):
    seed, m, k = size
    for cap in (1, k):
        problem = make_problem(uniform(seed, m), k, max_replicates=cap)
        optimum = problem.log_det(solve_exact(problem).indices)
        assert upper_bound(problem) >= optimum - 1e-8


def test_time_limit_returns_the_best_found_and_an_honest_bound():
    candidates = sphere(0, 200)
    found = select(candidates, 12, "exact", time_limit=0.3)
    assert not found.proven
    assert found.gap > 0.0
    assert 0.9 < found.efficiency < 1.0
    assert found.log_det >= select(candidates, 12, "greedy").log_det - 1e-9


@pytest.mark.parametrize("method", ["exact", "auto"])
def test_there_is_a_time_limit_by_default(monkeypatch, method):
    """600 postures on a sphere: the proof would not end in any reasonable time."""
    monkeypatch.setattr(exact_module, "TIME_LIMIT", 0.2)
    extra: dict[str, Any] = {"least_efficiency": 1.0} if method == "auto" else {}
    found = select(sphere(0, 600), 8, method, **extra)
    assert not found.proven
    assert found.seconds < 5.0
    assert found.bound > found.log_det
    assert 0.9 < found.efficiency < 1.0


def test_time_limit_during_enumeration_is_honest_too():
    found = select(sphere(0, 300), 4, "exact", time_limit=1e-6)
    assert not found.proven
    optimum = select(sphere(0, 300), 4, "exchange").log_det
    assert found.log_det <= optimum + 1e-9 <= found.bound + 2e-9


def test_far_commands_and_a_far_outlier_are_solved():
    candidates = uniform(2, 40)
    pulses = np.round(candidates * 2000) + 1e6
    assert select(pulses, 8, "exact").proven
    candidates[0] = 1e5
    found = select(candidates, 6, "exact")
    assert found.proven
    assert 0 in found.indices
    assert found.log_det >= select(candidates, 6, "exchange").log_det - 1e-8


def test_a_batch_is_its_sets_one_by_one():
    candidates = np.random.default_rng(0).random((6, 20, 3))
    available = np.random.default_rng(1).random((6, 20)) < 0.8
    required = np.argmax(available, axis=1)[:, None]
    for k in (4, 7):
        batch = exact_batch(candidates, k, available=available, required=required)
        assert batch.proven.all()
        for b in range(6):
            one = select(
                candidates[b], k, "exact", available=available[b], required=required[b]
            )
            assert batch.log_det[b] == pytest.approx(one.log_det, abs=1e-9)
            assert required[b, 0] in batch.indices[b]
            assert available[b][batch.indices[b]].all()


def test_score_against_the_exact_optimum():
    candidates = uniform(0, 30)
    optimum = select(candidates, 6, "exact")
    same = score(candidates, optimum.indices[::-1], reference="exact")
    assert same.proven
    assert same.efficiency == pytest.approx(1.0)
    other = score(candidates, range(6), reference="exact")
    assert not other.proven
    assert other.efficiency == pytest.approx(
        np.exp((other.log_det - optimum.log_det) / 12)
    )


@pytest.mark.slow
@pytest.mark.parametrize("k", [4, 8, pytest.param(12, marks=pytest.mark.slow)])
@pytest.mark.parametrize("cap", [1, 12])
def test_exact_and_exchange_agree_on_hundreds_of_sets(k, cap):
    candidates = np.random.default_rng(k).random((300, 50, 3))
    exact = exact_batch(candidates, k, max_replicates=cap)
    exchange = exchange_batch(candidates, k, max_replicates=cap)
    assert exact.proven.all()
    np.testing.assert_allclose(exchange.log_det, exact.log_det, atol=1e-8)
