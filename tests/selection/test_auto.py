"""``select(method="auto")``: what it proves, and how little it does for it."""

from __future__ import annotations

import functools
import itertools
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from questions import make_problem

import jaxcal
from jaxcal.selection import design
from jaxcal.selection.exact.exact import solve_auto as solve
from jaxcal.selection.solvers import SOLVERS

OPTIONS = {"seed": 0, "restarts": None, "time_limit": None}


def brute_force(candidates, k, required=(), available=None):
    usable = range(len(candidates)) if available is None else np.flatnonzero(available)
    subsets = [s for s in itertools.combinations(usable, k) if set(required) <= set(s)]
    z = np.c_[candidates, np.ones(len(candidates))][np.array(subsets)]
    return 3 * np.linalg.slogdet(np.swapaxes(z, 1, 2) @ z)[1].max()


def sphere(m, seed=3):
    points = np.random.default_rng(seed).normal(size=(m, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def test_auto_is_the_default_and_exact_on_small_problems(rng):
    for k in (4, 6, 12):
        candidates = rng.uniform(size=(50, 3))
        found = jaxcal.select(candidates, k)
        best = jaxcal.select(candidates, k, "exact")
        assert (found.method, found.proven) == ("exact", True)
        assert found.value == pytest.approx(best.log_det, abs=1e-9)
        assert found.reason == "the exact search proved this optimum"


@given(st.integers(0, 2**31), st.sampled_from([4, 5]), st.floats(0.5, 1.0))
@settings(max_examples=30)
def test_auto_keeps_its_promise_against_brute_force(seed, k, least):
    rng = np.random.default_rng(seed)
    candidates = rng.uniform(size=(11, 3))
    available = rng.permutation(11) < 9
    required = np.flatnonzero(available)[:1]
    found = jaxcal.select(
        candidates,
        k,
        available=available,
        required=required,
        least_efficiency=least,
    )
    best = brute_force(candidates, k, required, available)
    assert np.exp((found.log_det - best) / 12) >= least - 1e-9
    assert found.bound >= best - 1e-9
    assert set(required.tolist()) <= set(found.indices.tolist())
    assert available[found.indices].all()
    if found.proven:
        assert found.value == pytest.approx(best, abs=1e-8)


@pytest.mark.parametrize("k", [5, 8])
def test_auto_stops_where_the_bound_proves_enough(k):
    """The optimum among postures on a sphere takes longer than anybody waits."""
    problem = make_problem(sphere(400), k)
    found = solve(problem, least_efficiency=0.99, **OPTIONS)
    assert (found.method, found.proven) == ("exchange", False)
    assert np.exp((found.value - found.bound) / 12) >= 0.99
    assert "the bound proves a D-efficiency of at least 0.99" in found.reason
    assert found.value == pytest.approx(problem.log_det(found.indices))


def test_a_large_hull_is_not_enumerated_where_the_bound_suffices():
    found = jaxcal.select(sphere(500), 4, least_efficiency=0.9)
    assert (found.method, found.nodes) == ("exchange", 1)
    assert found.efficiency >= 0.9


def test_out_of_time_is_said_and_bounded():
    found = jaxcal.select(sphere(300), 9, least_efficiency=1.0, time_limit=1e-6)
    assert (found.method, found.proven) == ("exact", False)
    assert found.bound > found.log_det
    assert "stopped after 1e-06 s" in found.reason


def test_replicates_and_priors_are_no_exception(rng):
    candidates = rng.uniform(size=(12, 3))
    found = jaxcal.select(candidates, 6, max_replicates=2)
    best = jaxcal.select(candidates, 6, "exact", max_replicates=2)
    assert found.value == pytest.approx(best.log_det)
    blocks = rng.normal(size=(12, 2, 5))
    found = jaxcal.select(blocks=blocks, k=2, prior=np.eye(5))
    best = jaxcal.select(blocks=blocks, k=2, prior=np.eye(5), method="exact")
    assert found.value == pytest.approx(best.log_det)


def test_the_gap_of_another_method_is_to_the_proven_optimum_when_asked(rng):
    for method in ("greedy", "random"):
        candidates = rng.uniform(size=(11, 3))
        chosen = jaxcal.select(candidates, 5, method).indices
        found = jaxcal.Design(candidates).score(chosen, reference="exact")
        best = jaxcal.select(candidates, 5, "exact")
        assert found.bound == pytest.approx(best.log_det, abs=1e-8)
        assert found.proven == (found.log_det >= best.log_det - 1e-9)


@pytest.mark.parametrize("value", [0.0, -1, 1.01, np.nan, "high", None, True])
def test_a_senseless_efficiency_is_refused(value):
    with pytest.raises(ValueError, match=r"least_efficiency must be in \(0, 1\], got"):
        jaxcal.select(np.eye(4)[:, :3], method="auto", least_efficiency=value)


def test_unknown_methods_name_auto_too():
    with pytest.raises(ValueError, match="auto, got 'best'"):
        jaxcal.select(np.eye(4)[:, :3], method="best")


def test_the_search_is_no_worse_than_the_exchange(rng):
    model = jaxcal.models.Polynomial(2, 3, 1)
    design = jaxcal.Design(rng.uniform(-1.0, 1.0, (600, 3)), model)
    for criterion in ("D", "A"):
        exchange = design.select(14, criterion, "exchange")
        better = exchange.value if criterion == "D" else -exchange.value
        for method in ("exact", "auto"):
            found = design.select(14, criterion, method, time_limit=0.3)
            value = found.value if criterion == "D" else -found.value
            assert value >= better - 1e-9 * abs(better)


def test_the_time_that_a_problem_takes_is_part_of_the_limit(monkeypatch, rng):
    asked, exchange, make = [], SOLVERS["exchange"], design.problem_of

    @functools.wraps(exchange)  # whose options it has
    def solver(problem, **options):
        asked.append(options["time_limit"])
        return exchange(problem, **options)

    def problem_of(*arguments):
        time.sleep(0.2)
        return make(*arguments)

    monkeypatch.setitem(SOLVERS, "exchange", solver)
    monkeypatch.setattr(design, "problem_of", problem_of)
    for limit in (50.0, 0.1, 1e-6):
        jaxcal.select(rng.random((20, 2)), 4, method="exchange", time_limit=limit)
    assert asked[0] <= 49.8
    assert asked[1:] == pytest.approx([0.01, 1e-7])
