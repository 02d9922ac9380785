"""A solver and a criterion of one's own: one class or function, one row in a table."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest

import jaxcal
from jaxcal.checks import numbers
from jaxcal.commands import main
from jaxcal.selection.criteria import CRITERIA, Coordinates, Criterion, positions
from jaxcal.selection.problem import Problem, Solution
from jaxcal.selection.solvers import SOLVERS


class C(Criterion):
    """Variance of one combination of the parameters."""

    name, kind, says = "c", "trace", "variance"
    by_name = True

    def __init__(self, weights) -> None:
        self.weights = numbers("weights", weights)

    def rows(self, at: Coordinates) -> np.ndarray:
        if self.weights.shape != (len(at.names),):
            raise ValueError(f"weights must be ({len(at.names)},)")
        return self.weights[None] @ at.basis


class Cs(Criterion):
    """Variance of the sum of the parameters of interest."""

    name, kind, says = "Cs", "trace", "variance"
    by_name = of_parameters = True

    def __init__(self, parameters) -> None:
        self.parameters = parameters

    def rows(self, at: Coordinates) -> np.ndarray:
        return at.basis[positions(self.parameters, at.names)].sum(0, keepdims=True)


class L(C):
    """The worst known of some combinations."""

    name, kind, says, per_output = "L", "least", "precision", True

    def rows(self, at: Coordinates) -> np.ndarray:
        return self.weights @ at.basis


def largest(problem: Problem, *, seed: int) -> Solution:
    """The largest candidates, whatever is required."""
    size = (problem.blocks**2).sum(axis=(1, 2)) * problem.available
    return Solution(size.argsort()[::-1][: problem.k], seed=seed)


@pytest.mark.parametrize("seed", range(3))
def test_a_criterion_of_ones_own_is_solved_and_proven(monkeypatch, seed) -> None:
    monkeypatch.setitem(CRITERIA, "c", C)
    rng = np.random.default_rng(seed)
    blocks, weights = rng.normal(size=(9, 2, 4)), rng.normal(size=4)

    def variance(chosen) -> float:
        rows = blocks[list(chosen)].reshape(-1, 4)
        return float(weights @ np.linalg.solve(rows.T @ rows, weights))

    best = min(map(variance, itertools.combinations(range(9), 3)))
    design = jaxcal.Design.from_blocks(blocks)
    for method in ("exact", "auto", "exchange", "greedy", "random"):
        found = design.select(3, C(weights), method)
        assert found.value == pytest.approx(variance(found.indices))
        assert found.bound <= best * (1 + 1e-9)
        if method in ("exact", "auto"):
            assert found.value == pytest.approx(best, rel=2e-3)
        assert found.proven or method != "exact"
    assert "variance" in str(found) and found.criterion == "c"
    with pytest.raises(
        ValueError, match=r"criterion c needs its parameters: jaxcal\.C"
    ):
        design.select(3, "c")


def test_a_criterion_by_name_sees_every_parameter_of_the_affine_model(monkeypatch):
    monkeypatch.setitem(CRITERIA, "c", C)
    rng = np.random.default_rng(0)
    candidates, weights = rng.random((9, 2)), rng.normal(size=6)
    found = jaxcal.select(candidates, 4, "exact", criterion=C(weights))

    def variance(chosen) -> float:
        rows = jaxcal.regression_matrix(candidates[list(chosen)])
        return float(weights @ np.linalg.solve(rows.T @ rows, weights))

    best = min(map(variance, itertools.combinations(range(9), 4)))
    assert found.value == pytest.approx(best)
    with pytest.raises(ValueError, match=r"weights must be \(6,\)"):
        jaxcal.select(candidates, 4, criterion=C(weights[:3]))


def test_a_criterion_of_ones_own_takes_parameters_on_the_command_line(
    monkeypatch, tmp_path, capsys
):
    monkeypatch.setitem(CRITERIA, "Cs", Cs)
    candidates = np.random.default_rng(0).random((8, 2))
    file = tmp_path / "candidates.csv"
    np.savetxt(file, candidates, delimiter=",", header="u_a,u_b", comments="")
    words = ["select", str(file), "-k4", "--method=exact", "--criterion=Cs", "--json"]
    assert main([*words, "--parameters=a11,a12"]) == 0
    best = json.loads(capsys.readouterr().out)["value"]

    def variance(chosen) -> float:
        rows = np.c_[candidates[list(chosen)], np.ones(4)]
        return float(np.linalg.inv(rows.T @ rows)[:2, :2].sum())

    assert best == pytest.approx(
        min(map(variance, itertools.combinations(range(8), 4)))
    )
    assert main(words) == 2
    assert "--criterion Cs needs --parameters" in capsys.readouterr().err


def test_the_worst_of_some_combinations(monkeypatch) -> None:
    monkeypatch.setitem(CRITERIA, "L", L)
    rng = np.random.default_rng(0)
    blocks, some = rng.normal(size=(8, 2, 4)), rng.normal(size=(4, 4))

    def precision(chosen) -> float:
        rows = blocks[list(chosen)].reshape(-1, 4)
        covariance = some @ np.linalg.solve(rows.T @ rows, some.T)
        return 1.0 / float(np.linalg.eigvalsh(covariance)[-1])

    best = max(map(precision, itertools.combinations(range(8), 3)))
    design = jaxcal.Design.from_blocks(blocks)
    for method in ("exact", "exchange"):
        found = design.select(3, L(some), method)
        assert found.value == pytest.approx(precision(found.indices))
        assert found.value <= best * (1 + 1e-9) and found.bound >= best * (1 - 1e-9)
        if method == "exact":
            assert found.proven and found.value == pytest.approx(best)


def test_a_solver_of_ones_own_is_asked_by_its_name(monkeypatch) -> None:
    monkeypatch.setitem(SOLVERS, "largest", largest)
    candidates = np.random.default_rng(0).random((12, 3))
    available = np.arange(12) != 3
    found = jaxcal.select(candidates, 5, "largest", available=available, seed=7)
    chosen = np.c_[candidates, np.ones(12)]
    hat = chosen @ np.linalg.solve(chosen[available].T @ chosen[available], chosen.T)
    order = np.argsort(-np.where(available, np.diag(hat), 0.0))
    assert sorted(found.indices) == sorted(order[:5])
    assert found.method == "largest" and found.seed == 7 and found.efficiency <= 1.0
    with pytest.raises(ValueError, match="best is not an option of method"):
        jaxcal.select(candidates, 5, "largest", best=2)
    with pytest.raises(RuntimeError, match="'largest' must return 5 candidates within"):
        jaxcal.select(
            candidates, 5, "largest", available=available, required=[order[-2]]
        )


def test_a_criterion_of_ones_own_is_refined_without_a_row_in_the_table():
    rng = np.random.default_rng(0)
    candidates, weights = rng.uniform(-1.0, 1.0, (9, 1)), rng.normal(size=3)
    design = jaxcal.Design(candidates, jaxcal.models.Polynomial(2, 1, 1))
    first = design.select(4, C(weights), "exact")
    better = design.refine(first.indices, criterion=C(weights), starts=1)
    u = better.commands[:, 0]
    rows = np.stack([np.ones(4), u, u * u], axis=1)
    variance = weights @ np.linalg.solve(rows.T @ rows, weights)
    assert better.value == pytest.approx(variance) and variance <= first.value
    with pytest.raises(ValueError, match="criterion c must be repeated"):
        design.refine(first)
