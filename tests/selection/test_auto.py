"""``select(method="auto")``: which of policy and exact answers, and what it proves."""

from __future__ import annotations

import itertools
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxcal
from jaxcal.selection.auto import solve_auto
from jaxcal.selection.problem import make_problem


def brute_force(candidates, k, required=(), available=None):
    usable = range(len(candidates)) if available is None else np.flatnonzero(available)
    subsets = [s for s in itertools.combinations(usable, k) if set(required) <= set(s)]
    z = np.c_[candidates, np.ones(len(candidates))][np.array(subsets)]
    return 3 * np.linalg.slogdet(np.swapaxes(z, 1, 2) @ z)[1].max()


def test_auto_keeps_the_policy_where_it_is_proven_good(rng):
    answers = [
        jaxcal.select(rng.uniform(size=(50, 3)), method="auto") for _ in range(40)
    ]
    assert all(a.efficiency >= 0.999 for a in answers)
    assert sum(a.method == "policy" for a in answers) >= 30
    for a in answers:
        assert a.method in ("policy", "exact")
        assert a.proven == (a.gap <= 1e-9)
        assert a.method in a.reason


@pytest.mark.parametrize("k", [4, 5])
@pytest.mark.parametrize("reference", ["bound", "exact"])
def test_auto_keeps_its_promise_against_brute_force(rng, k, reference):
    for _ in range(10):
        candidates = rng.uniform(size=(11, 3))
        available = rng.permutation(11) < 9
        required = np.flatnonzero(available)[:1]
        found = jaxcal.select(
            candidates,
            k,
            "auto",
            available=available,
            required=required,
            least_efficiency=0.99,
            reference=reference,
        )
        best = brute_force(candidates, k, required, available)
        assert np.exp((found.log_det - best) / 12) >= 0.99 - 1e-9
        assert found.bound >= best - 1e-9
        assert set(required.tolist()) <= set(found.indices.tolist())
        assert available[found.indices].all()
        if found.proven:
            assert found.log_det == pytest.approx(best, abs=1e-8)


@given(st.integers(0, 2**31), st.floats(0.2, 1.0))
@settings(max_examples=60)
def test_a_pick_answers_if_and_only_if_its_efficiency_suffices(seed, least):
    """Any pick at all, k = n + 1, where the bound is the optimum."""
    rng = np.random.default_rng(seed)
    candidates = rng.uniform(size=(9, 3))
    problem = make_problem(candidates, 4)
    picked = rng.permutation(9)[:4]
    found = solve_auto(problem, lambda: picked, least)
    best = brute_force(candidates, 4)
    share = np.exp((problem.log_det(picked) - best) / 12)
    assert (found.method == "policy") == (share >= least or share > 1 - 1e-10)
    assert found.efficiency >= least - 1e-12
    if found.method == "exact":
        assert found.proven
        assert found.log_det == pytest.approx(best, abs=1e-8)
    assert found.policy_log_det == pytest.approx(problem.log_det(picked))


def test_a_singular_pick_goes_to_the_exact_search():
    axis = np.linspace(0.0, 1.0, 3)
    grid = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    found = solve_auto(make_problem(grid, 4), lambda: np.array([0, 1, 2, 3]), 0.5)
    assert found.method == "exact"
    assert "singular" in found.reason
    assert found.policy_log_det is None


def test_replicates_are_left_to_the_exact_search(rng):
    candidates = rng.uniform(size=(12, 3))
    found = jaxcal.select(candidates, 6, "auto", max_replicates=2)
    best = jaxcal.select(candidates, 6, "exact", max_replicates=2)
    assert found.method == "exact"
    assert "replicates" in found.reason
    assert found.proven
    assert found.log_det == pytest.approx(best.log_det)


def test_a_loose_bound_is_settled_by_the_exact_search(rng):
    """k > n + 1: the relaxation cannot show 1.0, the search can, for either answer."""
    for _ in range(6):
        candidates = rng.uniform(size=(30, 3))
        found = jaxcal.select(candidates, 8, "auto", least_efficiency=1.0)
        best = jaxcal.select(candidates, 8, "exact")
        assert found.proven
        assert found.log_det == pytest.approx(best.log_det, abs=1e-8)


def test_out_of_time_is_said_and_bounded():
    rng = np.random.default_rng(3)
    sphere = rng.normal(size=(300, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    problem = make_problem(sphere, 9)
    picked = np.arange(9)
    found = solve_auto(problem, lambda: picked, 1.0, time_limit=1e-6)
    assert not found.proven
    assert found.bound > found.log_det
    assert "ran out of time" in found.reason


def test_the_policys_gap_is_to_the_proven_optimum_when_asked(rng):
    for _ in range(10):
        candidates = rng.uniform(size=(11, 3))
        found = jaxcal.select(candidates, 5, "policy", reference="exact")
        best = jaxcal.select(candidates, 5, "exact")
        assert found.method == "policy"
        assert found.bound == pytest.approx(best.log_det, abs=1e-8)
        assert found.efficiency == pytest.approx(
            np.exp((found.log_det - best.log_det) / 12), abs=1e-9
        )
        assert found.proven == (found.log_det >= best.log_det - 1e-9)


@pytest.mark.parametrize("value", [0.0, -1, 1.01, np.nan, "high", None, True])
def test_a_senseless_efficiency_is_refused(value):
    with pytest.raises(ValueError, match=r"least_efficiency must be in \(0, 1\], got"):
        jaxcal.select(np.eye(4)[:, :3], method="auto", least_efficiency=value)


def test_unknown_methods_name_auto_too():
    with pytest.raises(ValueError, match="auto, got 'best'"):
        jaxcal.select(np.eye(4)[:, :3], method="best")


def test_auto_itself_loads_no_jax():
    code = (
        "import sys, numpy, jaxcal.selection.auto as a\n"
        "from jaxcal.selection.problem import make_problem\n"
        "p = make_problem(numpy.random.default_rng(0).random((9, 3)), 4)\n"
        "a.solve_auto(p, lambda: numpy.arange(4), 0.9)\n"
        "print(sorted({'jax', 'matplotlib', 'numba'} & set(sys.modules)))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"
