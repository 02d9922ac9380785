"""Caps of single rows and ``A w <= b``, and criterion G, against brute force."""

import itertools

import numpy as np
import pytest

import jaxcal
from jaxcal import Design


def _selections(count, k, caps):
    """Every selection of k of ``count`` candidates within caps, as counts."""
    for chosen in itertools.combinations_with_replacement(range(count), k):
        counts = np.bincount(chosen, minlength=count)
        if (counts <= caps).all():
            yield counts


def _value(rows, counts, name, at=None):
    """phi of counts; of I and G over the rows ``at``, all when not given."""
    information = (rows * counts[:, None]).T @ rows
    if np.linalg.matrix_rank(information) < rows.shape[1]:
        return -np.inf
    covariance = np.linalg.inv(information)
    at = rows if at is None else at
    variances = ((at @ covariance) * at).sum(axis=1)
    return {
        "D": np.linalg.slogdet(information)[1],
        "A": -np.trace(covariance),
        "E": 1.0 / np.linalg.eigvalsh(covariance)[-1],
        "G": -variances.max(),
        "I": -variances.mean(),
    }[name]


def _problem(seed):
    """Rows, k, caps, A, b: of many shapes, with a selection that keeps the rules."""
    rng = np.random.default_rng(seed)
    count, p = int(rng.integers(7, 10)), int(rng.integers(2, 4))
    k = p + int(rng.integers(1, 3))
    rows = rng.normal(size=(count, p))
    caps = rng.integers(0, 4, count) if rng.random() < 0.5 else np.ones(count, int)
    caps[rng.permutation(count)[:5]] += 1
    costs = [rng.uniform(0.0, 3.0, count)]
    if rng.random() < 0.6:
        costs.append(1.0 * (rng.random(count) < 0.5))
    if rng.random() < 0.3:
        costs.append(rng.normal(size=count))
    costs = np.array(costs)
    totals = np.array([costs @ w for w in _selections(count, k, caps)])
    most = np.quantile(totals, rng.uniform(0.05, 0.6), axis=0)
    return rows, k, caps, costs, most


@pytest.mark.parametrize("seed", range(24))
@pytest.mark.parametrize("name", ["D", "A", "E", "I", "G"])
def test_the_exact_choice_within_rules_is_the_best_of_all(seed, name):
    rows, k, caps, costs, most = _problem(seed)
    every = [
        (_value(rows, counts, name, rows[caps > 0]), counts)
        for counts in _selections(len(rows), k, caps)
        if (costs @ counts <= most + 1e-9).all()
    ]
    best = max((value for value, _ in every), default=-np.inf)
    if best == -np.inf:
        return  # no regular selection keeps these rules
    design = Design(
        blocks=rows[:, None], max_replicates=caps, constraints=(costs, most)
    )
    for method in ("exact", "exchange", "greedy", "random", "auto"):
        if method in ("greedy", "random") and name != "D":
            continue
        found = design.select(k, name, method)
        counts = np.bincount(found.indices, minlength=len(rows))
        assert (counts <= caps).all() and (costs @ counts <= most + 1e-6).all()
        value = _value(rows, counts, name, rows[caps > 0])
        reported = -found.value if name in "AIG" else found.value
        assert reported == pytest.approx(value, rel=1e-9)
        assert value <= best + 1e-9 * abs(best)
        side = -found.bound if name in "AIG" else found.bound
        assert side >= best - 1e-9 * abs(best)
        if method == "exact":
            assert found.proven and value == pytest.approx(best, rel=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_several_best_within_rules_are_those_of_brute_force(seed):
    rows, k, caps, costs, most = _problem(100 + seed)
    every = sorted(
        _value(rows, counts, "D")
        for counts in _selections(len(rows), k, caps)
        if (costs @ counts <= most + 1e-9).all()
    )
    design = Design.from_blocks(
        rows[:, None], max_replicates=caps, constraints=(costs, most)
    )
    found = design.select(k, "D", "exact", best=4)
    values = [subset.value for subset in found.alternatives]
    expected = [value for value in every[::-1][:4] if value > -np.inf]
    np.testing.assert_allclose(values, expected, rtol=1e-9)


def test_rules_hold_in_every_scenario():
    rng = np.random.default_rng(4)
    blocks = rng.normal(size=(3, 8, 1, 2))
    costs, most = rng.uniform(0.0, 1.0, 8), 1.2
    for joined in (jaxcal.Mean("D"), jaxcal.Worst("D"), jaxcal.Worst("A")):
        found = Design(blocks=blocks, constraints=(costs, most)).select(
            4, joined, "exact"
        )
        of_all = []
        for chosen in itertools.combinations(range(8), 4):
            if costs[list(chosen)].sum() > most:
                continue
            counts = np.bincount(chosen, minlength=8)
            each = [_value(one[:, 0], counts, joined.criterion) for one in blocks]
            worst = isinstance(joined, jaxcal.Worst)
            of_all.append(min(each) if worst else np.mean(each))
        value = -found.value if joined.criterion == "A" else found.value
        assert found.proven and value == pytest.approx(max(of_all), rel=1e-9)


def test_a_budget_is_kept_and_the_best_within_it_proven():
    rng = np.random.default_rng(6)
    x = rng.uniform(-1.0, 1.0, (100, 2))
    costs = 1.0 + 5.0 * (np.abs(x).max(axis=1) > 0.8)
    design = Design(x, constraints=(costs, 27.0))
    found = design.select(12, "D", "exact", time_limit=300.0)
    free = Design(x).select(12, "D")
    assert costs[found.indices].sum() <= 27.0 < costs[free.indices].sum()
    assert found.proven and found.value < free.value


def test_rules_that_leave_nothing_or_are_broken_are_said():
    x = np.random.default_rng(0).uniform(-1.0, 1.0, (9, 2))
    with pytest.raises(ValueError, match="constraints allow no selection of k = 4"):
        jaxcal.select(x, 4, constraints=(np.ones(9), 3.0))
    with pytest.raises(ValueError, match="A of constraints must have shape"):
        Design(x, constraints=(np.ones(8), 3.0))
    with pytest.raises(ValueError, match=r"constraints must be a pair \(A, b\)"):
        Design(x, constraints=np.ones(9))
    with pytest.raises(ValueError, match="max_replicates must be a whole number, or"):
        Design(x, max_replicates=np.ones(8, int))
    design = Design(x, constraints=(np.arange(9.0), 10.0))
    with pytest.raises(ValueError, match="row 0 of A w is 26, more than 10"):
        design.score([5, 6, 7, 8])
    with pytest.raises(ValueError, match="with select and score, not with plan"):
        design.plan(0.1, noise_std=0.1)
    with pytest.raises(ValueError, match="got constraints"):
        design.select(4, method="policy")
    with pytest.raises(ValueError, match=r'use jaxcal.Worst\("G"\)'):
        jaxcal.select(blocks=np.ones((2, 9, 1, 2)) * x[:, None], criterion="G", k=3)


def test_g_over_candidates_is_the_largest_variance_of_any_of_them():
    rng = np.random.default_rng(8)
    x = rng.uniform(-1.0, 1.0, (40, 3))
    found = jaxcal.select(x, 6, criterion="G", time_limit=20.0)
    rows = np.c_[x, np.ones(40)]
    value = -_value(rows, np.bincount(found.indices, minlength=40), "G")
    assert found.criterion == "G" and found.value == pytest.approx(value)
    assert found.value < jaxcal.select(x, 6, criterion="D").criteria.G
    at = jaxcal.select(x, 6, criterion="G", region=[[0.0, 0.0, 0.0]])
    assert at.value >= 1.0 / 6.0 - 1e-9 and "largest variance" in str(at)
