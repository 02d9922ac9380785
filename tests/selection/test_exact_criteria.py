"""Exact selection for every criterion on blocks: brute force, laws, known designs."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from questions import make_block_problem, make_problem, of
from scipy.linalg import hadamard
from scipy.optimize import minimize

from jaxcal.deadline import Deadline
from jaxcal.models import Affine
from jaxcal.selection import select
from jaxcal.selection.criteria import CRITERIA, Criterion
from jaxcal.selection.exact.branch_and_bound import Scenario, branch_and_bound
from jaxcal.selection.exact.exact import upper_bound

Array = np.ndarray
NAMES = ("D", "Ds", "A", "As", "I", "E")


def subsets(count: int, k: int, cap: int = 1) -> list[tuple[int, ...]]:
    chosen = itertools.combinations_with_replacement(range(count), k)
    return [s for s in chosen if max(map(s.count, s)) <= cap]


def drawn(
    seed: int, m: int, q: int, p: int, name: str, weight: float
) -> tuple[Array, Array, Criterion]:
    """Blocks, a prior precision and a criterion."""
    rng = np.random.default_rng(seed)
    root = np.eye(p)
    if name in ("Ds", "As"):
        root = rng.normal(size=(max(1, p - 1), p))
    elif name == "I":
        root = rng.normal(size=(p, p))
    known = rng.normal(size=(p, p))
    criterion = CRITERIA[name].of_rows(root)
    return rng.normal(size=(m, q, p)), weight * known.T @ known, criterion


def phi(blocks: Array, prior: Array, criterion: Criterion, chosen: object) -> float:
    rows = blocks[list(chosen)].reshape(-1, blocks.shape[2])  # type: ignore[call-overload]  # any iterable
    return float(criterion.value(prior + rows.T @ rows))


laws = settings(max_examples=60, deadline=None)
sizes = st.tuples(
    st.integers(0, 10**6),
    st.integers(6, 9),
    st.integers(1, 3),
    st.integers(2, 5),
    st.integers(2, 5),
)


@laws
@given(
    sizes,
    st.sampled_from(NAMES),
    st.sampled_from([1e-3, 0.3]),
    st.sampled_from([1, 4]),
    st.sampled_from([1, 2]),
    st.booleans(),
)
def test_branch_and_bound_is_brute_force(
    size: tuple[int, ...], name: str, weight: float, best: int, cap: int, ruled: bool
) -> None:
    seed, m, q, p, k = size
    blocks, prior, criterion = drawn(seed, m, q, p, name, weight)
    lower, upper = np.zeros(m, dtype=np.int64), np.full(m, cap)
    if ruled:  # the first must be chosen, the last must not
        lower[0], upper[-1] = 1, 0
    counts = [np.bincount(s, minlength=m) for s in subsets(m, k, cap)]
    counts = [c for c in counts if (c >= lower).all() and (c <= upper).all()]
    values = np.array(
        [phi(blocks, prior, criterion, np.repeat(range(m), c)) for c in counts]
    )
    order = np.argsort(-values)
    start = counts[order[len(order) // 2]]
    arguments = (Scenario(blocks, prior, criterion), lower, upper, start)
    found = branch_and_bound(*arguments, best=best)
    wanted = values[order[:best]]
    assert found.proven
    np.testing.assert_allclose(found.values, wanted, rtol=1e-7, atol=1e-8)
    assert (found.counts >= lower).all() and (found.counts <= upper).all()
    assert (found.counts.sum(axis=1) == k).all()
    assert len(np.unique(found.counts, axis=0)) == len(wanted)
    late = branch_and_bound(
        *arguments, deadline=Deadline(0.0)
    )  # a limit of no time at all
    assert late.nodes == 1
    assert late.bound >= values.max() - 1e-8 * max(1.0, abs(values.max()))


@pytest.mark.parametrize("name", NAMES)
def test_the_relaxation_is_that_of_a_general_solver(name: str) -> None:
    blocks, prior, criterion = drawn(3, 12, 2, 4, name, 0.3)
    gram = np.einsum("iqa,iqb->iab", blocks, blocks)
    solved = minimize(
        lambda c: -criterion.value(prior + np.tensordot(c, gram, 1)),
        np.full(12, 0.5),
        bounds=[(0.0, 1.0)] * 12,
        constraints={"type": "eq", "fun": lambda c: c.sum() - 6.0},
        method="SLSQP",
        options={"ftol": 1e-12, "maxiter": 1000},
    )
    # A start as good as the relaxed optimum leaves the climb no reason to stop early.
    counts = [np.bincount(s, minlength=12) for s in subsets(12, 6)]
    start = max(counts, key=lambda c: phi(blocks, prior, criterion, np.flatnonzero(c)))
    whole = np.ones(12, dtype=np.int64)
    scenario = Scenario(blocks, prior, criterion)
    found = branch_and_bound(scenario, 0 * whole, whole, start, root_only=True)
    optimum = phi(blocks, prior, criterion, np.flatnonzero(start))
    relaxed = -float(solved.fun)
    slack = 0.06 * (relaxed - optimum) + 1e-3 * abs(relaxed) * (name == "E") + 1e-7
    assert optimum - 1e-9 <= found.bound <= relaxed + slack
    assert found.proven or found.bound >= relaxed - 1e-6 * max(1.0, abs(relaxed))


@pytest.mark.parametrize("name", NAMES)
def test_select_proves_the_best_and_bounds_are_bounds(name: str) -> None:
    blocks, prior, _ = drawn(5, 9, 2, 4, name, 0.1)
    problem = make_block_problem(blocks, 3, prior=prior, criterion=of(name))
    found = select(blocks=blocks, k=3, prior=prior, criterion=of(name), method="exact")
    values = {
        s: select(
            blocks=blocks, k=3, prior=prior, criterion=of(name), method="greedy",
            required=s,
        ).value
        for s in subsets(9, 3)
    }  # fmt: skip
    better = max if problem.criterion.larger_is_better else min
    best = better(values.values())
    assert found.proven
    assert found.value == pytest.approx(best, rel=1e-8)
    assert problem.criterion.efficiency(best, upper_bound(problem)) <= 1.0 + 1e-9


def test_few_readings_are_bounded_far_below_the_natural_relaxation() -> None:
    """Two blocks of 3 readings for 12 parameters: 6 of 12 eigenvalues can grow."""
    rng = np.random.default_rng(0)
    blocks, whole = rng.normal(size=(20, 3, 12)), np.ones(20, dtype=np.int64)
    start = np.bincount([0, 1], minlength=20)
    plain = CRITERIA["D"].of_rows(np.eye(12))
    prior = 1e-4 * np.eye(12)
    scenario = Scenario(blocks, prior, plain)
    sharp = branch_and_bound(scenario, 0 * whole, whole, start, root_only=True)
    spread = prior + np.einsum("iqa,iqb->ab", blocks, blocks) * 0.1
    assert sharp.bound < float(np.linalg.slogdet(spread)[1]) - 10.0


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_d_optimal_polynomials_are_at_the_zeros_of_legendre(degree: int) -> None:
    """The support is +-1 and the zeros of P_d' (Guest 1958; Hoel 1958)."""
    roots = np.polynomial.legendre.Legendre.basis(degree).deriv().roots().real
    support = np.concatenate([[-1.0], roots, [1.0]])
    grid = np.unique(np.concatenate([np.linspace(-1.0, 1.0, 41), support]))
    blocks = np.vander(grid, degree + 1)[:, None]
    k = 2 * (degree + 1)  # twice at each
    found = select(blocks=blocks, k=k, method="exact", max_replicates=k)
    assert found.proven
    np.testing.assert_allclose(np.unique(grid[found.indices]), support, atol=1e-9)
    assert (np.unique(found.indices, return_counts=True)[1] == 2).all()


@pytest.mark.parametrize("name", ["D", "A", "E"])
def test_chemical_weighing_is_a_hadamard_design(name: str) -> None:
    """4 objects in 4 weighings: every criterion is best at X.T X = 4 I (Hotelling)."""
    signs = np.array(list(itertools.product([-1.0, 1.0], repeat=3)))
    rows = np.column_stack([np.ones(8), signs])
    found = select(blocks=rows[:, None], k=4, criterion=name, method="exact")
    assert found.proven
    best = {"D": 4 * np.log(4.0), "A": 1.0, "E": 4.0}[name]
    assert found.value == pytest.approx(best, rel=1e-8)
    assert np.allclose(hadamard(4).T @ hadamard(4), 4 * np.eye(4))
    np.testing.assert_allclose(
        rows[found.indices].T @ rows[found.indices], 4 * np.eye(4), atol=1e-12
    )


def test_corners_of_the_cube_are_d_and_a_optimal_for_first_order() -> None:
    cube = np.array(list(itertools.product([-1.0, 0.0, 1.0], repeat=3)))
    found = make_problem(cube, 8, model=Affine(3, 1))
    for name in ("D", "A"):
        blocks = np.column_stack([cube, np.ones(27)])[:, None]
        best = select(blocks=blocks, k=8, criterion=name, method="exact")
        assert best.proven
        assert (np.abs(cube[best.indices]) == 1.0).all()
        assert found.log_det(best.indices) == pytest.approx(4 * np.log(8.0))


def test_the_mixture_design_of_algdesigns_vignette() -> None:
    """``optFederov(~-1+.^2, expand.mixture(4,3), nTrials=8)``: D 0.03623366."""
    thirds = [
        (a, b, 3 - a - b) for c in range(4) for b in range(4 - c) for a in [3 - b - c]
    ]
    x, y, z = np.array(thirds).T / 3.0
    blocks = np.column_stack([x, y, z, x * y, x * z, y * z])[:, None]
    found = select(blocks=blocks, k=8, method="exact")
    assert found.proven
    # D is det(X.T X / N)^(1 / p) there.
    assert np.exp(found.log_det / 6) / 8 == pytest.approx(0.03623366, rel=1e-6)


@pytest.mark.parametrize(("name", "theirs"), [("D", 3.675919), ("I", 8.096772)])
def test_the_response_surface_of_algdesigns_vignette(name: str, theirs: float) -> None:
    """``optFederov(~quad(.), gen.factorial(5,3), nTrials=15)``, and criterion="I"."""
    levels = np.arange(-2.0, 3.0)
    x, y, z = np.array(list(itertools.product(levels, repeat=3))).T
    columns = [0 * x + 1, x, y, z, x * x, y * y, z * z, x * y, x * z, y * z]
    blocks = np.column_stack(columns)[:, None]
    limit = 60.0 if name == "D" else 1.0
    found = select(
        blocks=blocks, k=15, method="exact", criterion=name, time_limit=limit
    )
    if name == "D":  # theirs is optimal
        assert found.proven
        assert np.exp(found.value / 10) / 15 == pytest.approx(theirs, rel=1e-6)
    else:
        assert 15 * found.value <= theirs * (1 + 1e-6)
        assert 15 * found.bound >= 7.5  # "7.57" of the continuous design


def test_alternatives_tell_their_log_det_under_every_criterion():
    candidates = np.random.default_rng(3).random((12, 2))
    rows = np.c_[candidates, np.ones(12)]
    for criterion in ("A", "I", "E"):
        found = select(candidates, 4, "exact", criterion=criterion, best=3)
        assert found.alternatives[0].log_det == found.log_det
        for each in found.alternatives:
            chosen = rows[each.indices]
            expected = 2 * np.linalg.slogdet(chosen.T @ chosen)[1]
            assert each.log_det == pytest.approx(expected)
