"""Bounds where few readings are left, and what the library logs."""

from __future__ import annotations

import itertools
import logging
import time
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal.commands import main
from jaxcal.deadline import Deadline
from jaxcal.selection import select
from jaxcal.selection.criteria import CRITERIA, Criterion
from jaxcal.selection.exact.branch_and_bound import Scenario, branch_and_bound

Array = np.ndarray
laws = settings(max_examples=60, deadline=None)


def drawn(seed: int, m: int, q: int, p: int, name: str, weight: float) -> Any:
    """Blocks of very different sizes, a prior that is weak in some directions."""
    rng = np.random.default_rng(seed)
    blocks = rng.normal(size=(m, q, p)) * 10.0 ** rng.uniform(-1, 1, (m, 1, 1))
    root = np.eye(p)
    if name in ("I", "As"):
        root = rng.normal(size=(p if name == "I" else p - 2, p))
        root *= 10.0 ** rng.uniform(-1, 1, (len(root), 1))
    known = rng.normal(size=(p, p)) * 10.0 ** rng.uniform(-0.5, 0, p)[:, None]
    return blocks, weight * known.T @ known, CRITERIA[name].of_rows(root)


def phi(blocks: Array, prior: Array, criterion: Criterion, counts: Array) -> float:
    rows = np.repeat(blocks, counts, axis=0).reshape(-1, blocks.shape[2])
    return float(criterion.value(prior + rows.T @ rows))


@laws
@given(
    st.integers(0, 10**6),
    st.sampled_from(["D", "A", "As", "I"]),
    st.integers(1, 3),
    st.integers(1, 3),
    st.integers(5, 9),
    st.sampled_from([1e-3, 0.3]),
    st.sampled_from([1, 3]),
    st.sampled_from([1, 2]),
    st.booleans(),
)
def test_few_readings_of_many_parameters_are_brute_force(
    seed: int, name: str, q: int, k: int, p: int, weight: float, best: int, cap: int,
    ruled: bool,
) -> None:  # fmt: skip
    m = 7
    blocks, prior, criterion = drawn(seed, m, q, p, name, weight)
    lower, upper = np.zeros(m, dtype=np.int64), np.full(m, cap)
    if ruled:
        lower[0], upper[-1] = 1, 0
    every = itertools.combinations_with_replacement(range(m), k)
    counts = [np.bincount(s, minlength=m) for s in every]
    counts = [c for c in counts if (c >= lower).all() and (c <= upper).all()]
    values = np.array([phi(blocks, prior, criterion, c) for c in counts])
    order = np.argsort(-values)
    scenario = Scenario(blocks, prior, criterion)
    arguments = (scenario, lower, upper, counts[order[-1]])
    root = branch_and_bound(*arguments, root_only=True)
    assert root.bound >= values.max() - 1e-8 * max(1.0, abs(values.max()))
    found = branch_and_bound(*arguments, best=best)
    assert found.proven
    np.testing.assert_allclose(found.values, values[order[:best]], rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("name", ["A", "I"])
def test_variances_that_no_reading_is_left_for_stay(name: str) -> None:
    """6 readings of 12 parameters: the 6 smallest of W's eigenvalues are not reduced.

    The natural relaxation spreads the two blocks over all sixty, and reduces all. For
    I, the selection and the best mu are not settled together at the root.
    """
    rng = np.random.default_rng(0)
    blocks, whole = 1e3 * rng.normal(size=(60, 3, 12)), np.ones(60, dtype=np.int64)
    root = np.eye(12) if name == "A" else rng.normal(size=(12, 12))
    criterion = CRITERIA[name].of_rows(root)
    arguments = (0 * whole, whole, np.bincount([0, 1], minlength=60))
    scenario = Scenario(blocks, np.eye(12), criterion)
    bound = branch_and_bound(scenario, *arguments, root_only=True).bound
    stays = np.linalg.eigvalsh(root.T @ root)[:6].sum()
    natural = -criterion.value(np.eye(12) + np.einsum("iqa,iqb->ab", blocks, blocks))
    assert natural < 1e-3 * stays
    assert -bound >= (1.0 - 1e-9 if name == "A" else 0.8) * stays


def test_a_time_limit_is_kept_while_nodes_are_slow() -> None:
    """60 parameters: a look at the clock every few nodes would be too late."""
    rng = np.random.default_rng(1)
    blocks, whole = rng.normal(size=(120, 3, 60)), np.ones(120, dtype=np.int64)
    criterion = CRITERIA["A"].of_rows(np.eye(60))
    arguments = (Scenario(blocks, 1e-2 * np.eye(60), criterion), 0 * whole)
    start = np.bincount(np.arange(15), minlength=120)
    first = branch_and_bound(*arguments, whole, start, deadline=Deadline(0.0))
    assert first.nodes == 1
    found, limit = first, 0.25
    while found.nodes == 1:  # a loaded machine gives less of its time
        assert limit < 60.0
        limit *= 2.0
        began, deadline = time.thread_time(), Deadline(limit)
        found = branch_and_bound(*arguments, whole, start, deadline=deadline)
        assert time.thread_time() - began < limit + 0.1
    assert not found.proven
    assert found.values[0] < found.bound <= first.bound


def test_the_console_shows_what_the_library_logs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log = logging.getLogger("jaxcal.selection.exact")

    def said(file: str, *, k: int) -> None:
        log.info("said once")

    monkeypatch.setattr("jaxcal.commands.questions.select", said)
    for _ in range(2):
        assert main(["select", "-", "-k", "4"]) == 0
        assert capsys.readouterr() == ("", "said once\n")


def monomials(points: Array) -> Array:
    """(M, 1, p) all terms of degree at most 2."""
    n = points.shape[1]
    pairs = itertools.combinations_with_replacement(range(n), 2)
    columns = [np.ones(len(points)), *points.T]
    columns += [points[:, a] * points[:, b] for a, b in pairs]
    return np.column_stack(columns)[:, None]


@pytest.mark.parametrize(("name", "value"), [("A", 1.0), ("I", None)])
def test_a_and_i_optimal_parabolas_have_half_their_points_in_the_middle(
    name: str, value: float | None
) -> None:
    """Weights 1/4, 1/2, 1/4 at -1, 0, 1 for both (Pukelsheim, 6.10 and 9.5)."""
    grid = np.linspace(-1.0, 1.0, 21)
    blocks = np.vander(grid, 3)[:, None]
    found = select(blocks=blocks, k=8, method="exact", criterion=name, max_replicates=8)
    assert found.proven
    ends, counts = np.unique(grid[found.indices], return_counts=True)
    np.testing.assert_allclose(ends, [-1.0, 0.0, 1.0], atol=1e-12)
    assert counts.tolist() == [2, 4, 2]
    if value is not None:
        assert found.value == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize(("k", "determinant"), [(6, 256.0), (9, 5184.0)])
def test_d_optimal_second_order_on_the_square(k: int, determinant: float) -> None:
    """Three levels (Box and Draper 1971): 9 runs are the factorial."""
    square = np.array(list(itertools.product([-1.0, 0.0, 1.0], repeat=2)))
    found = select(blocks=monomials(square), k=k, method="exact", max_replicates=k)
    assert found.proven
    assert np.exp(found.log_det) == pytest.approx(determinant, rel=1e-9)
    if k == 9:
        assert sorted(found.indices) == list(range(9))


def test_algdesigns_example_of_14_trials() -> None:
    """``optFederov(~quad(.), gen.factorial(3, 3), nTrials=14)``: D 0.4630447."""
    cube = np.array(list(itertools.product([-1.0, 0.0, 1.0], repeat=3)))
    found = select(blocks=monomials(cube), k=14, method="exact")
    assert found.proven
    assert np.exp(found.log_det / 10) / 14 == pytest.approx(0.4630447, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "value"), [("D", 8 * np.log(8)), ("A", 1), ("E", 8)])
def test_eight_chemical_weighings_are_a_hadamard_design(
    name: str, value: float
) -> None:
    signs = np.array(list(itertools.product([-1.0, 1.0], repeat=7)))
    rows = np.column_stack([np.ones(128), signs])
    found = select(blocks=rows[:, None], k=8, criterion=name, method="exact")
    assert found.proven
    assert found.value == pytest.approx(value, rel=1e-8)
    gram = rows[found.indices].T @ rows[found.indices]
    np.testing.assert_allclose(gram, 8 * np.eye(8), atol=1e-12)


def test_seven_spring_weighings_are_a_block_design() -> None:
    """0/1 weighings, D and A: four objects each, every two together twice (Fano)."""
    rows = np.array(list(itertools.product([0.0, 1.0], repeat=7)))[1:]
    for name, value in (("D", 2 * np.log(32.0)), ("A", 49 / 16)):
        found = select(blocks=rows[:, None], k=7, criterion=name, method="exact")
        assert found.proven
        assert found.value == pytest.approx(value, rel=1e-9)
        gram = rows[found.indices].T @ rows[found.indices]
        np.testing.assert_allclose(gram, 2 * np.eye(7) + 2, atol=1e-12)


def test_optimaldesigns_example_of_nine_blocks_of_two() -> None:
    """``od_MISOCP(Fx_blocks(6), b3=9, crit="A", bin=TRUE)``: each of 3 with each of 3.

    A is the sum of 1 / the nonzero eigenvalues of the graph: 3, 3, 3, 3 and 6.
    """
    pairs = list(itertools.combinations(range(6), 2))
    rows = np.array([np.eye(6)[a] - np.eye(6)[b] for a, b in pairs])
    contrasts = np.linalg.svd(np.ones((1, 6)))[2][1:]
    found = select(
        blocks=(rows @ contrasts.T)[:, None], k=9, criterion="A", method="exact"
    )
    assert found.proven
    assert found.value == pytest.approx(1.5, rel=1e-9)
