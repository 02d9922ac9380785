"""Decoding of any scorer: what is chosen from scores that the test gives."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from jaxcal.learning.policies import decoding


class Table:
    """Scores (B, M); of the candidate after a chosen one 3 lower."""

    def __init__(self, scores, piece_rows=None):
        self.table, self.piece_rows = scores, piece_rows

    def encode(self, rows, usable):
        self.usable = usable
        return self.table

    def part(self, memory, sets):
        return memory[sets]

    def scores(self, memory, chosen, free, count, best_only):
        near = np.zeros_like(memory)
        for made in range(count):
            np.put_along_axis(near, (chosen[:, [made]] + 1) % memory.shape[1], 3.0, 1)
        return memory - near

    def worth(self, rows, usable, tries):
        picked = np.array(
            [[sets[few] for few in of] for sets, of in zip(rows, tries, strict=True)]
        )
        return np.linalg.slogdet(np.swapaxes(picked, -1, -2) @ picked)[1]


def greedy(scores, free, begun, k):
    """One set, chosen by the definition."""
    chosen = list(begun)
    while len(chosen) < k:
        lowered = scores.copy()
        for choice in chosen:
            lowered[(choice + 1) % len(scores)] = scores[(choice + 1) % len(scores)] - 3
        rest = [i for i in range(len(scores)) if free[i] and i not in chosen]
        chosen.append(max(rest, key=lambda i: lowered[i]))
    return chosen


@pytest.mark.parametrize("piece_rows", [None, 20])
def test_greedy_and_best_first_pick_are_those_of_the_definition(rng, piece_rows):
    scores, rows = rng.normal(size=(6, 9)), rng.normal(size=(6, 9, 3))
    free = rng.random((6, 9)) < 0.8
    free[:, :5] = True
    required = np.tile([7, 2], (6, 1))
    scorer = Table(scores, piece_rows)
    found = decoding.choose(scorer, rows, free, required, 5)
    assert [list(picks) for picks in found] == [
        greedy(scores[b], free[b], [7, 2], 5) for b in range(6)
    ]
    assert scorer.usable[:, [7, 2]].all()
    found = decoding.choose(scorer, rows, free, required, 5, decoding="first", num=20)
    for b in range(6):
        starts = [i for i in range(9) if free[b, i] and i not in (7, 2)]
        tries = [greedy(scores[b], free[b], [7, 2, i], 5) for i in starts]

        def log_det(picks, b=b):
            return np.linalg.slogdet(rows[b, picks].T @ rows[b, picks])[1]

        assert log_det(found[b]) == pytest.approx(max(map(log_det, tries)))


def test_samples_are_drawn_from_the_softmax_of_the_scores(rng):
    scores, number = np.array([[0.0, 1.0, 2.0, -1.0]]), 4000
    free = np.array([[True, True, True, False]])
    nothing, rows = np.zeros((number, 0), np.int64), np.ones((number, 4, 1))
    picks = decoding.choose(
        *(Table(np.tile(scores, (number, 1))), rows, np.tile(free, (number, 1))),
        *(nothing, 2),
        decoding="samples",
        num=1,
        generators=[np.random.default_rng(b) for b in range(number)],
    )
    # The second is drawn from what the first has left.
    for first, second in itertools.permutations(range(3), 2):
        odds = np.exp(scores[0]) * free[0]
        chance = odds[first] / odds.sum()
        odds[(first + 1) % 4] *= np.exp(-3.0)
        odds[first] = 0.0
        chance *= odds[second] / odds.sum()
        share = (picks == [first, second]).all(axis=1).mean()
        assert abs(share - chance) < 4 * np.sqrt(chance / number)
