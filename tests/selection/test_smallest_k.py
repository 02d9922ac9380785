"""A size at which one scenario of several cannot be identified."""

from __future__ import annotations

import numpy as np
import pytest

import jaxcal

# Rows 0, 1 tell the first scenario apart and rows 2, 3 the second.
BLOCKS = np.zeros((2, 6, 1, 2))
BLOCKS[0, [0, 1], 0] = BLOCKS[1, [2, 3], 0] = np.eye(2)


def test_select_without_k_takes_the_fewest_that_identify_in_all() -> None:
    design = jaxcal.Design.from_blocks(BLOCKS)
    chosen = design.select(criterion=jaxcal.Mean("D"))
    assert sorted(chosen.indices) == [0, 1, 2, 3]


def test_plan_goes_on_where_a_size_is_singular_in_a_scenario() -> None:
    design = jaxcal.Design.from_blocks(BLOCKS)
    region = np.eye(2)[:, None]
    plan = design.plan(1.1, criterion="G", region=region)
    assert plan.k == 4


@pytest.mark.parametrize("letter", ["D", "A", "E"])
def test_the_worst_efficiency_of_one_scenario_is_an_efficiency(letter, rng) -> None:
    design = jaxcal.Design.from_blocks(rng.normal(size=(12, 1, 3)))
    criterion = jaxcal.Worst(letter, efficiency=True)
    best = design.select(4, criterion=criterion)
    assert best.value == pytest.approx(1.0) and best.criterion.startswith("Worst")
    assert 0.0 < design.score([0, 1, 2, 3], criterion).value <= 1.0
