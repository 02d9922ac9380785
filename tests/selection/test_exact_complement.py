"""D of few candidates with a prior: chosen, left out, in as few dimensions as are left,
and some of very many."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxcal import Design
from jaxcal.models import Polynomial
from jaxcal.selection.exact import exact
from jaxcal.selection.exact.complement import complement


def _log_dets(blocks, prior, k, required=(), available=None, times=1):
    """Of every selection of k, the largest first."""
    usable = [i for i in range(len(blocks)) if available is None or available[i]]
    values = []
    for chosen in itertools.combinations_with_replacement(usable, k):
        often = max(chosen.count(i) for i in chosen)
        if often <= times and set(required) <= set(chosen):
            rows = blocks[list(chosen)].reshape(-1, blocks.shape[2])
            values.append(np.linalg.slogdet(prior + rows.T @ rows)[1])
    return np.sort(values)[::-1]


@settings(deadline=None, max_examples=150)
@given(
    seed=st.integers(0, 10**6),
    m=st.integers(4, 9),
    q=st.integers(1, 3),
    p=st.integers(2, 20),
    times=st.sampled_from([1, 1, 1, 2]),
)
def test_brute_force(seed, m, q, p, times):
    rng = np.random.default_rng(seed)
    blocks = rng.standard_normal((m, q, p)) * 10 ** rng.uniform(-1.5, 1.5)
    blocks[1, -1] = 0.0  # fewer readings than the others
    root = rng.standard_normal((p, p))
    prior = root @ root.T + 10 ** rng.uniform(-4, 1) * np.eye(p)
    k = int(rng.integers(2, m))
    required = [3] if seed % 3 == 0 else []
    available = np.ones(m, dtype=bool)
    available[0] = seed % 2 == 0 or m - 1 <= k
    found = Design.from_blocks(
        blocks, prior=prior, max_replicates=times, required=required,
        available=available,
    ).select(k, "D", "exact", best=3)  # fmt: skip
    best = _log_dets(blocks, prior, k, required, available, times)
    assert found.proven
    head = [one.log_det for one in found.alternatives]
    np.testing.assert_allclose(head, best[: len(head)], atol=1e-7)


@pytest.mark.parametrize("q", [1, 2])
def test_what_is_left_out_has_the_same_information(q):
    rng = np.random.default_rng(q)
    blocks, prior = rng.standard_normal((8, q, 12)), np.eye(12)
    problem = Design.from_blocks(blocks, prior=prior).problem(5, "D")
    other = complement(
        problem.blocks,
        problem.prior,
        problem.criterion,
        problem.lower,
        problem.upper,
        5,
    )
    assert other is not None and other.left_out == 3
    for chosen in itertools.combinations(range(8), 5):
        counts = np.bincount(chosen, minlength=8)
        rows = np.sqrt(counts)[:, None, None] * problem.blocks
        phi = problem.criterion.value(
            problem.prior + np.tensordot(rows, rows, ((0, 1), (0, 1)))
        )
        left = other.start(counts)
        assert left.sum() == 3
        np.testing.assert_array_equal(other.counts(left), counts)
        rows = left[:, None, None] * other.blocks
        apart = other.criterion.value(
            other.prior + np.tensordot(rows, rows, ((0, 1), (0, 1)))
        )
        assert phi == pytest.approx(apart + other.shift, abs=1e-9)


def test_what_is_nearly_singular_without_some_is_no_proof_by_what_is_left_out():
    """Rounding of its minors would be larger than what is called proven."""
    blocks = np.random.default_rng(0).standard_normal((8, 1, 12))
    for scale, applies in ((1.0, True), (1e-3, True), (1e-9, False)):
        problem = Design.from_blocks(blocks, prior=scale * np.eye(12)).problem(5, "D")
        asked = problem.blocks, problem.prior, problem.criterion
        other = complement(*asked, problem.lower, problem.upper, 5)
        assert (other is not None) == applies
        assert other is None or other.rounding < 1e-9


def test_it_is_searched_where_its_bound_is_sharper(monkeypatch):
    """32 of 40 whose precision is the covariance of a field: 8 are left out."""
    rng = np.random.default_rng(0)
    places = rng.uniform(size=(40, 2))
    apart = np.linalg.norm(places[:, None] - places, axis=-1)
    field = np.exp(-3.0 * apart) + 0.1 * np.eye(40)
    values, vectors = np.linalg.eigh(np.linalg.inv(field))
    rows = vectors * np.sqrt(values / values[0] - 1.0).clip(1e-9)
    design = Design.from_blocks(rows[:, None], prior=np.eye(40))
    searched = []

    def spied(scenario, *given, **options):
        if not options.get("root_only"):
            searched.append(len(scenario.blocks[0, 0]))
        return exact_search(scenario, *given, **options)

    exact_search = exact.branch_and_bound
    monkeypatch.setattr(exact, "branch_and_bound", spied)
    found = design.select(32, "D", "exact", time_limit=30.0)
    assert searched == [39]
    assert found.proven
    monkeypatch.setattr(exact, "complement", lambda *_: None)
    other = design.select(32, "D", "exact", time_limit=1.0)
    assert found.value >= other.value - 1e-9
    assert other.bound >= found.value - 1e-9


@pytest.mark.parametrize("criterion", ["D", "A", "I"])
@pytest.mark.parametrize("rules", ["none", "required", "constraints"])
def test_of_very_many_candidates(criterion, rules):
    """No worse than a climb among all from the greedy start."""
    rng = np.random.default_rng(1)
    commands = rng.uniform(-1.0, 1.0, (25_000, 2))
    more = {}
    if rules == "required":
        more["required"] = [17, 24_000]
    elif rules == "constraints":
        more["constraints"] = ((commands[:, 0] > 0.9)[None].astype(float), [1.0])
    design = Design(commands, Polynomial(2, 2, 1), max_replicates=2, **more)
    one = design.select(9, criterion, "exchange", restarts=1)
    found = design.select(9, criterion, "exchange", restarts=20)
    larger = criterion == "D"
    assert (
        found.value >= one.value - 1e-9 if larger else found.value <= one.value + 1e-9
    )
    assert np.bincount(found.indices).max() <= 2
    if rules == "required":
        assert {17, 24_000} <= set(found.indices.tolist())
    if rules == "constraints":
        assert (commands[found.indices, 0] > 0.9).sum() <= 1


def test_a_needle_among_very_many_is_found():
    """One candidate of 30,000 has what a parameter needs: some drawn hold it hardly."""
    blocks = np.random.default_rng(2).standard_normal((30_000, 1, 4))
    blocks[:, 0, 3] = 0.0
    blocks[12_345, 0, 3] = 1.0
    found = Design.from_blocks(blocks).select(6, "D", "exchange", restarts=5)
    assert 12_345 in found.indices
