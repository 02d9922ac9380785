"""The belief of a breakaway, against the product of both directions by brute force."""

import numpy as np
import pytest
from scipy import special, stats

from rig_workbench.commission.characterise import OUTLIERS, Breakaway

CELL, CELLS, SIGMA, SPREAD = 0.02, 16, 0.005, 0.008


def probability_moved(step, threshold):
    misread = stats.norm.cdf(-step / (2 * SIGMA))
    yields = stats.norm.cdf((step - threshold) / SPREAD)
    seen = misread + (1 - 2 * misread) * yields
    return OUTLIERS / 2 + (1 - OUTLIERS) * seen


def brute(history, limit, risk):
    """The joint belief of two thresholds, and the steps that tell most."""
    centres = (np.arange(CELLS) + 0.5) * CELL
    steps = np.arange(1, CELLS) * CELL
    up, down = np.meshgrid(centres, centres, indexing="ij")
    weights = np.ones((CELLS, CELLS))
    for direction, number, moved in history:
        p = probability_moved(steps[number], (up, down)[direction])
        weights *= p if moved else 1 - p
    weights /= weights.sum()
    best = []
    for direction in (0, 1):
        for number, step in enumerate(steps):
            threshold = (up, down)[direction]
            p = probability_moved(step, threshold)
            seen = (weights * p).sum()
            gain = special.entr([seen, 1 - seen]).sum()
            gain -= (weights * (special.entr(p) + special.entr(1 - p))).sum()
            past = (weights * (step - threshold > limit)).sum()
            best.append((gain, past, direction, number))
    least = min(past for _, past, *_ in best)
    safe = [one for one in best if one[1] <= max(risk, least + 1e-6)]
    most = max(gain for gain, *_ in safe)
    return weights, {tuple(one[2:]) for one in safe if one[0] > most - 1e-9}


@pytest.mark.parametrize("seed", range(4))
def test_steps_and_beliefs_are_those_of_the_whole_grid(seed):
    rng = np.random.default_rng(seed)
    true = rng.uniform(0.0, 0.3, 2)
    belief, history = Breakaway(CELL, CELLS, SIGMA, SPREAD), []
    for _ in range(12):
        weights, steps = brute(history, 0.06, 0.05)
        chosen = belief.propose(0.06, 0.05)
        assert chosen in steps  # as good as the best
        np.testing.assert_allclose(belief.weights[0], weights.sum(axis=1), atol=1e-12)
        np.testing.assert_allclose(belief.weights[1], weights.sum(axis=0), atol=1e-12)
        moved = bool(belief.steps[chosen[1]] > true[chosen[0]])
        history.append((*chosen, moved))
        belief.saw(*chosen, moved)
    for direction in (0, 1):
        found = belief.estimate(direction, 0.95)
        assert found.low - CELL <= true[direction] <= found.high + CELL
