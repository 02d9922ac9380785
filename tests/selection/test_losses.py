"""Designs some of whose measurements fail, against brute force over every loss."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from jaxcal import Design, Mean, Worst, select

Array = np.ndarray


def phi(blocks: Array, chosen: object, name: str, weight: Array) -> float:
    """Of blocks (M, q, p), larger is better; -inf where singular."""
    some = blocks[list(chosen)].reshape(-1, blocks.shape[2])  # type: ignore[call-overload]
    if np.linalg.matrix_rank(some) < blocks.shape[2]:
        return -np.inf
    information = some.T @ some
    if name == "D":
        return float(np.linalg.slogdet(information)[1])
    if name == "E":
        return float(np.linalg.eigvalsh(information)[0])
    return -float(np.trace(np.linalg.inv(information) @ weight))


@pytest.mark.parametrize(
    ("name", "lost", "shape", "k"),
    [
        ("D", 1, (8, 1, 3), 5),
        ("A", 2, (7, 1, 2), 5),
        ("I", 1, (7, 2, 3), 3),
        ("E", 1, (7, 1, 2), 4),
    ],
)
def test_the_worst_loss_is_brute_force(name, lost, shape, k) -> None:
    blocks = np.random.default_rng(k + ord(name)).standard_normal(shape)
    count, q, p = shape
    weight = np.eye(p)
    if name == "I":
        weight = np.einsum("iqa,iqb->ab", blocks, blocks) / (count * q)
    subsets = list(itertools.combinations(range(count), k))
    worth = np.array(
        [
            min(
                phi(blocks, left, name, weight)
                for left in itertools.combinations(chosen, k - lost)
            )
            for chosen in subsets
        ]
    )
    sign = -1.0 if name in "AI" else 1.0
    design = Design.from_blocks(blocks, lost=lost)
    for method in ("exact", "auto", "exchange", "greedy", "random"):
        answer = design.select(k, name, method)
        own = worth[subsets.index(tuple(sorted(answer.indices.tolist())))]
        assert sign * answer.value == pytest.approx(own, rel=1e-8)
        assert sign * answer.bound >= worth.max() - 1e-9 * abs(worth.max())
        if method == "exact":
            assert answer.proven and own == pytest.approx(worth.max(), rel=1e-9)
    best = design.select(k, name, "exact", best=3).alternatives
    values = [sign * subset.value for subset in best]
    np.testing.assert_allclose(values, np.sort(worth)[::-1][:3], rtol=1e-8)


def test_the_worst_loss_in_the_worst_scenario() -> None:
    blocks = np.random.default_rng(4).standard_normal((3, 7, 1, 2))
    best = max(
        min(
            phi(blocks[s], left, "D", np.eye(2))
            for s in range(3)
            for left in itertools.combinations(chosen, 3)
        )
        for chosen in itertools.combinations(range(7), 4)
    )
    answer = Design.from_blocks(blocks, lost=1).select(4, Worst("D"), "exact")
    assert answer.proven and answer.value == pytest.approx(best, rel=1e-9)
    assert answer.criterion == "D with 1 lost"
    assert answer.left_without.min() > 0.0


@pytest.mark.parametrize("failing", [0, 4, 8])
def test_the_mean_over_what_arrives(failing: int) -> None:
    """Over every case of four that may fail, over 64 draws by seed 0 of eight."""
    rng = np.random.default_rng(8)
    blocks, prior = rng.standard_normal((8, 1, 3)), np.eye(3)
    reliability = np.ones(8)
    reliability[:failing] = np.array([0.9, 0.3, 0.9, 0.8, 0.7, 0.5, 0.9, 0.6])[:failing]
    if failing == 8:
        arrives = np.random.default_rng(0).random((64, 8)) < reliability
        chances = np.full(64, 1 / 64)
    else:
        arrives = np.array(list(itertools.product([True, False], repeat=8)))
        chances = np.prod(np.where(arrives, reliability, 1.0 - reliability), axis=1)
    worth = {}
    for chosen in itertools.combinations(range(8), 3):
        values = []
        for row in arrives[chances > 0.0]:
            some = blocks[[i for i in chosen if row[i]]].reshape(-1, 3)
            values.append(np.linalg.slogdet(prior + some.T @ some)[1])
        worth[chosen] = float(chances[chances > 0.0] @ values)
    design = Design.from_blocks(blocks, prior, reliability=reliability)
    answer = design.select(3, "D", "exact")
    best = max(worth, key=worth.__getitem__)
    assert answer.proven and tuple(sorted(answer.indices.tolist())) == best
    assert answer.value == pytest.approx(worth[best], rel=1e-10)
    assert answer.in_scenarios is None


def test_the_fewest_that_one_loss_leaves_identified_is_the_default() -> None:
    u = np.random.default_rng(1).uniform(size=(12, 3))
    answer = select(u, lost=1)
    assert len(answer.indices) == 5 and answer.left_without.min() > 0.0
    assert "with 1 lost" in answer.criterion


@pytest.mark.parametrize(
    ("rules", "criterion", "says"),
    [
        ({"lost": 3}, None, "lost must be at most 2"),
        ({"lost": 1, "max_replicates": 2}, None, "max_replicates = 1"),
        ({"lost": 1, "reliability": np.ones(6)}, None, "must not be given together"),
        ({"reliability": [0.5] * 5}, None, "reliability must have shape"),
        ({"reliability": [1, 1, 1, 1, 0, 1]}, None, "in .0, 1., got 0 for candidate 4"),
        ({"reliability": np.ones(6)}, Worst("D"), "must come with a mean"),
    ],
)
def test_bad_losses_are_named(rules, criterion, says) -> None:
    blocks = np.random.default_rng(0).standard_normal((6, 1, 3))
    with pytest.raises(ValueError, match=says):
        Design.from_blocks(blocks, **rules).select(4, criterion)


def test_losses_that_cannot_be_answered_are_named() -> None:
    blocks = np.random.default_rng(0).standard_normal((2, 6, 1, 3))
    with pytest.raises(ValueError, match=r"of k = 3 with 1 lost: k must be at least 3"):
        Design.from_blocks(blocks[0], lost=1).select(3)
    with pytest.raises(ValueError, match=r"lost must come with jaxcal\.Worst"):
        Design.from_blocks(blocks, lost=1).select(4, Mean("D"))
    with pytest.raises(ValueError, match="left out with plan"):
        Design.from_blocks(blocks[0], lost=1).plan(1.0)
