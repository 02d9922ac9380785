"""The Fedorov exchange, and the kernels beneath it."""

import itertools

import numpy as np
import pytest
from questions import make_problem, of

import jaxcal
from jaxcal.selection import exchange_batch, select
from jaxcal.selection.criteria import CRITERIA
from jaxcal.selection.exchange.exchange import (
    Climbs,
    exchange_from,
    exchange_indices,
)


def uniform(seed, m, n=3):
    return np.random.default_rng(seed).random((m, n))


@pytest.mark.parametrize("k", [4, 6, 9])
@pytest.mark.parametrize("cap", [1, 2, 9])
def test_no_single_swap_improves_the_result(k, cap):
    candidates = uniform(k, 20)
    problem = make_problem(candidates, k, max_replicates=cap)
    chosen = exchange_indices(problem, restarts=1, seed=3)
    best = problem.log_det(chosen)
    for position, new in itertools.product(range(k), range(20)):
        swapped = chosen.copy()
        swapped[position] = new
        if np.bincount(swapped).max() <= cap:
            assert problem.log_det(swapped) <= best + 1e-8


@pytest.mark.parametrize("q", [1, 2, 5])
@pytest.mark.parametrize("name", CRITERIA)
def test_no_single_swap_of_blocks_improves_the_result(name, q):
    """14 parameters: leverages are updated for q = 1 and 2, recomputed for q = 5."""
    rng = np.random.default_rng(q)
    blocks = rng.normal(size=(150, q, 14)) * 10.0 ** rng.uniform(-1, 1, size=14)
    design = jaxcal.Design.from_blocks(blocks, prior=0.1 * np.eye(14))
    problem = design.problem(6, of(name))
    chosen = exchange_indices(problem, restarts=1)
    best = design.score(chosen, of(name)).value
    swapped = np.repeat(chosen[None], 6 * 150, axis=0).reshape(6, 150, 6)
    for position in range(6):
        swapped[position, :, position] = np.arange(150)
    twice = np.sort(swapped, axis=2)
    swapped = swapped[(np.diff(twice, axis=2) > 0).all(axis=2)]
    if name == "G":  # by hand: it is a scenario for each row
        rows = blocks.reshape(-1, 14)
        information = np.einsum("rkqi,rkqj->rij", blocks[swapped], blocks[swapped])
        inverse = np.linalg.inv(information + 0.1 * np.eye(14))
        found = np.einsum("si,rij,sj->rs", rows, inverse, rows, optimize=True).max(1)
    else:
        found = problem.values(swapped)[0]
    if problem.criterion.larger_is_better:
        assert found.max() <= best + 1e-8 * max(1.0, abs(best))
    else:
        assert found.min() >= best * (1.0 - 1e-8)


@pytest.mark.parametrize("k", [4, 8, 12])
def test_default_restarts_find_the_proven_optimum(k):
    candidates = np.random.default_rng(k).random((60, 50, 3))
    found = exchange_batch(candidates, k)
    for b in range(60):
        optimum = select(candidates[b], k, "exact")
        assert optimum.proven
        assert found.log_det[b] == pytest.approx(optimum.log_det, abs=1e-8)


def test_the_seed_decides_and_is_recorded():
    candidates = uniform(0, 60)
    one = select(candidates, 10, "exchange", restarts=1, seed=5)
    same = select(candidates, 10, "exchange", restarts=1, seed=5)
    np.testing.assert_array_equal(one.indices, same.indices)
    assert (one.seed, one.restarts) == (5, 1)
    problem = make_problem(uniform(1, 60), 4)  # the first starts are greedy, not drawn
    climbs = [Climbs(problem, s) for s in range(20)]
    picks = {tuple(sorted(c.climbed(c.random_start())[0].tolist())) for c in climbs}
    assert len(picks) > 1
    assert select(candidates, 10, "exchange", seed=2**70).log_det >= one.log_det - 1e-9


def test_more_restarts_never_lower_the_result():
    candidates = uniform(1, 50)
    values = [
        select(candidates, 8, "exchange", restarts=r).log_det for r in (1, 2, 5, 20, 80)
    ]
    assert np.all(np.diff(values) >= -1e-9)


@pytest.mark.parametrize("k", [4, 6])
def test_required_and_mask_are_respected(k):
    candidates = uniform(2, 30)
    available = np.arange(30) % 3 > 0
    found = select(candidates, k, "exchange", available=available, required=[4, 1])
    np.testing.assert_array_equal(found.indices[:2], [4, 1])
    assert available[found.indices].all()
    assert len(set(found.indices.tolist())) == k


def test_starts_are_not_singular_on_grids_of_duplicates():
    axis = np.array([0.0, 1.0])
    corners = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    candidates = np.concatenate([np.tile(corners[:3], (40, 1)), corners])
    for seed in range(10):
        found = select(candidates, 4, "exchange", restarts=1, seed=seed)
        assert np.isfinite(found.log_det)


def test_climbing_from_a_selection_never_lowers_it():
    problem = make_problem(uniform(4, 40), 7, required=[3, 9])
    rng = np.random.default_rng(0)
    for _ in range(20):
        others = rng.permutation(np.setdiff1d(np.arange(40), [3, 9]))[:5]
        start = np.concatenate([[9], others, [3]])
        chosen = exchange_from(problem, start)
        assert problem.log_det(chosen) >= problem.log_det(start) - 1e-9
        assert {3, 9} <= set(chosen.tolist())
        assert len(set(chosen.tolist())) == 7


def test_the_smallest_eigenvalue_is_no_lower_than_that_of_known_selections():
    known = [  # by an exchange that looked at 20 local optima of A
        [5, 142, 145, 162, 164, 175],
        [22, 29, 40, 52, 171, 195],
        [160, 163, 167, 169, 186, 193],
        [10, 90, 124, 173, 178, 193],
        [40, 97, 132, 175, 183, 196],
        [33, 36, 60, 90, 130, 154],
    ]
    rise = []
    for seed, indices in enumerate(known):
        blocks = np.random.default_rng([2, 8, 200, 6, seed]).standard_normal(
            (200, 2, 8)
        )
        found = select(None, 6, "exchange", blocks=blocks, criterion="E").indices
        now, then = (
            np.linalg.eigvalsh(np.einsum("iqa,iqb->ab", blocks[c], blocks[c]))[0]
            for c in (found, indices)
        )
        rise.append(np.log(now / then))
    assert np.mean(rise) >= 0.0


def textbook(rows, k):
    """Greedy from a small ridge, the largest gain of log det first."""
    information, left, chosen = 1e-8 * np.eye(rows.shape[1]), np.ones(len(rows)), []
    for _ in range(k):
        gains = np.einsum("ij,jk,ik->i", rows, np.linalg.inv(information), rows)
        chosen.append(int((gains * left).argmax()))
        left[chosen[-1]] = 0.0
        information += np.outer(rows[chosen[-1]], rows[chosen[-1]])
    return chosen


@pytest.mark.parametrize(
    "count, degree, k", [(50, 1, 4), (50, 1, 12), (2000, 2, 12), (20_000, 2, 20)]
)
def test_greedy_is_as_good_as_the_textbooks(rng, count, degree, k):
    model, shares = jaxcal.models.Polynomial(degree, 3, 1), []
    for _ in range(3 if count > 50 else 15):
        candidates = rng.uniform(0.0, 1.0, (count, 3))
        rows = model.jacobian(candidates)[:, 0]
        chosen = jaxcal.select(candidates, k, "greedy", model=model, criterion="D")
        own, other = (
            np.linalg.slogdet(rows[one].T @ rows[one])[1]
            for one in (chosen.indices, textbook(rows, k))
        )
        shares.append(np.exp((own - other) / rows.shape[1]))
    assert np.mean(shares) >= 0.99
    assert min(shares) >= 0.95
