"""``plan`` against every design of small problems, in exact fractions."""

from __future__ import annotations

import itertools
import math

import exactly
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxcal

WORST = {"G": max, "I": lambda values: sum(values) / len(values)}


class Brute:
    """Designs of blocks (M, q, p) and what they predict over the blocks or a region."""

    def __init__(self, blocks, prior, region, criterion, cap):
        self.blocks = [exactly.fractions(block) for block in blocks]
        self.prior = None if prior is None else exactly.fractions(prior)
        self.region = [exactly.fractions(block) for block in region]
        self.criterion, self.cap, self.best = criterion, cap, {}

    def errors(self, indices):
        """(m,) standard errors of a design; None where it is singular."""
        rows = [row for i in indices for row in self.blocks[i]]
        total = exactly.information(rows, self.prior)
        inverted = exactly.inverse(total)
        if inverted is None:
            return None
        if self.criterion == "parameters":
            covariance = inverted[0]
            return [math.sqrt(covariance[a][a]) for a in range(len(covariance))]
        outputs = zip(*self.region, strict=True)
        spread = [exactly.variances(inverted[0], list(rows)) for rows in outputs]
        return [math.sqrt(WORST[self.criterion](each)) for each in spread]

    def optimum(self, k):
        """The least of the largest errors over all designs of k; inf without any."""
        if k not in self.best:
            everything = itertools.combinations_with_replacement(
                range(len(self.blocks)), k
            )
            allowed = (
                design
                for design in everything
                if max(map(design.count, design)) <= self.cap
            )
            found = (self.errors(design) for design in allowed)
            self.best[k] = min((max(each) for each in found if each), default=math.inf)
        return self.best[k]


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    shape=st.sampled_from([(5, 1, 2), (4, 2, 2), (4, 3, 2), (4, 2, 1), (4, 4, 3)]),
    criterion=st.sampled_from(["G", "I", "parameters"]),
    cap=st.integers(1, 2),
    weak=st.sampled_from([None, 1.0, 1e-6]),
    share=st.floats(0.7, 2.0),
)
def test_a_plan_is_that_of_every_design(seed, shape, criterion, cap, weak, share):
    rng = np.random.default_rng(seed)
    blocks = np.round(rng.normal(size=shape), 2)
    prior = None if weak is None else weak * np.eye(shape[2])
    brute = Brute(blocks, prior, blocks, criterion, cap)
    most = min(cap * shape[0], 4)
    accuracy = share * brute.optimum(min(3, most))
    if not math.isfinite(accuracy):
        return
    design = jaxcal.Design.from_blocks(blocks, prior=prior, max_replicates=cap)
    try:
        plan = design.plan(accuracy, criterion=criterion, max_k=most)
    except ValueError as error:  # none is near it
        assert "cannot be reached" in str(error) or "must be at least" in str(error)
        assert brute.optimum(most) > accuracy * (1.0 - 1e-9)
        return
    wanted = accuracy * (1.0 + 1e-9)
    smallest = next(k for k in range(1, most + 1) if brute.optimum(k) <= wanted)
    assert plan.k == smallest if plan.smallest_proven else plan.k >= smallest
    assert "nan" not in str(plan)
    for row in plan.rows:
        errors = brute.errors(row.indices.tolist())
        np.testing.assert_allclose(row.standard_error, errors, rtol=1e-9)
        assert row.least_error.max() <= brute.optimum(row.k) * (1.0 + 1e-9)


def test_outputs_of_a_block_are_judged_each_by_itself():
    """Two readings of one parameter: not the root of the sum of their variances."""
    blocks = np.array([[[2.0], [1.0]], [[1.0], [3.0]]])
    plan = jaxcal.Design.from_blocks(blocks).plan(10.0, max_k=2, more=1)
    assert len(plan.rows) == 2
    # All four readings: variance 1 / 15, times the largest square of each output.
    np.testing.assert_allclose(
        plan.rows[1].standard_error, [2.0 / np.sqrt(15.0), 3.0 / np.sqrt(15.0)]
    )
    assert plan.names == ("output 1", "output 2")


def test_criteria_count_every_reading_of_a_block(rng):
    blocks = rng.normal(size=(6, 5, 3))
    scored = jaxcal.Design.from_blocks(blocks).score([0, 2])
    rows = blocks[[0, 2]].reshape(-1, 3)
    covariance = np.linalg.inv(rows.T @ rows)
    variances = np.einsum("mqa,ab,mqb->mq", blocks, covariance, blocks)
    assert scored.criteria.I == pytest.approx(variances.mean())
    assert scored.criteria.G == pytest.approx(variances.max())
