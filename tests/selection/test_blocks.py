"""Problems given as information blocks, against float64 numpy and brute force."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from questions import make_block_problem, make_problem, of

from jaxcal.models import Affine, Polynomial
from jaxcal.selection import select
from jaxcal.selection.exchange.exchange import exchange_indices

SOLVERS = ("random", "greedy", "exchange", "exact", "auto")
laws = hypothesis_settings(max_examples=25, deadline=None)


def value_of(blocks, prior, chosen):
    gram = prior + sum(blocks[i].T @ blocks[i] for i in chosen)
    sign, value = np.linalg.slogdet(gram)
    return value if sign > 0 and np.linalg.cond(gram) < 1e13 else -np.inf


def brute_force(blocks, prior, k, cap=1, available=None, required=()):
    usable = [i for i in range(len(blocks)) if available is None or available[i]]
    best = -np.inf
    for chosen in itertools.combinations_with_replacement(usable, k):
        if max(map(chosen.count, chosen)) <= cap and set(required) <= set(chosen):
            best = max(best, value_of(blocks, prior, chosen))
    return best


def drawn(seed, m, q, p, weight=0.0):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(p, p))
    return rng.normal(size=(m, q, p)), weight * root.T @ root


@pytest.mark.parametrize(
    ("m", "q", "p", "k", "weight"),
    [
        (10, 1, 3, 3, 0.0),
        (10, 1, 3, 5, 0.0),
        (10, 1, 4, 2, 0.3),
        (10, 2, 5, 3, 0.0),
        (9, 2, 4, 2, 0.0),
        (9, 2, 4, 4, 0.1),
        (9, 3, 5, 2, 0.0),
        (9, 3, 7, 1, 0.5),
        (9, 3, 2, 2, 0.0),  # more readings than parameters
        (8, 3, 6, 4, 1e-6),
    ],
)
def test_every_solver_judges_itself_and_exact_is_brute_force(m, q, p, k, weight):
    for seed in range(3):
        blocks, prior = drawn(seed, m, q, p, weight)
        best = brute_force(blocks, prior, k)
        for method in SOLVERS:
            found = select(blocks=blocks, prior=prior, k=k, method=method)
            assert found.log_det == pytest.approx(
                value_of(blocks, prior, found.indices), abs=1e-8
            )
            assert len(set(found.indices.tolist())) == k
            assert found.bound >= best - 1e-8
            if method in ("exact", "auto"):
                assert found.proven
                assert found.log_det == pytest.approx(best, abs=1e-8)
            elif method == "exchange":
                assert found.log_det == pytest.approx(best, abs=1e-8)


@pytest.mark.parametrize(("q", "p", "k", "weight"), [(1, 3, 4, 0), (2, 4, 3, 0.2)])
def test_mask_required_replicates_and_runners_up(q, p, k, weight):
    for seed in range(4):
        blocks, prior = drawn(seed, 8, q, p, weight)
        available = np.arange(8) != seed
        blocks[seed] = np.nan
        required = [(seed + 1) % 8]
        rules = {"available": available, "required": required, "max_replicates": 2}
        best = brute_force(blocks, prior, k, 2, available, required)
        for method in SOLVERS:
            found = select(blocks=blocks, prior=prior, k=k, method=method, **rules)
            assert available[found.indices].all()
            assert required[0] in found.indices
            assert np.bincount(found.indices).max() <= 2
            assert found.log_det <= best + 1e-9
        assert found.log_det == pytest.approx(best, abs=1e-8)
        found = select(blocks=blocks, prior=prior, k=k, method="exact", best=5, **rules)
        values = [value_of(blocks, prior, a.indices) for a in found.alternatives]
        assert values == pytest.approx([a.log_det for a in found.alternatives])
        assert np.all(np.diff(values) <= 1e-9)


def test_no_single_swap_improves_an_exchange_of_blocks():
    blocks, prior = drawn(1, 15, 2, 6, 0.01)
    problem = make_block_problem(blocks, 4, prior=prior)
    chosen = exchange_indices(problem, restarts=1)
    best = value_of(blocks, prior, chosen)
    for position, new in itertools.product(range(4), range(15)):
        swapped = chosen.copy()
        swapped[position] = new
        if len(set(swapped.tolist())) == 4:
            assert value_of(blocks, prior, swapped) <= best + 1e-8


sizes = st.tuples(st.integers(0, 10**6), st.integers(1, 3), st.integers(2, 5))


@laws
@given(sizes, st.sampled_from([0.0, 0.1]))
def test_a_linear_map_of_the_parameters_changes_only_the_constant(size, weight):
    seed, q, p = size
    blocks, prior = drawn(seed, 12, q, p, weight)
    k = -(-p // q) + 1
    matrix = np.random.default_rng(seed).normal(size=(p, p)) + 3 * np.eye(p)
    matrix *= 10.0 ** np.linspace(-4, 4, p)  # parameters in very different units
    if np.linalg.cond(matrix) > 1e11:
        return
    plain = select(blocks=blocks, prior=prior, k=k, method="exact")
    mapped = select(
        blocks=blocks @ matrix, prior=matrix.T @ prior @ matrix, k=k, method="exact"
    )
    shift = 2 * np.linalg.slogdet(matrix)[1]
    assert mapped.log_det == pytest.approx(plain.log_det + shift, abs=1e-5)
    again = value_of(blocks, prior, mapped.indices)
    assert again == pytest.approx(plain.log_det, abs=1e-6)


@laws
@given(sizes)
def test_permuting_the_blocks_permutes_the_answer(size):
    seed, q, p = size
    blocks, _ = drawn(seed, 12, q, p)
    order = np.random.default_rng(seed).permutation(12)
    k = -(-p // q) + 1
    plain = select(blocks=blocks, k=k, method="exact")
    moved = select(blocks=blocks[order], k=k, method="exact")
    assert moved.log_det == pytest.approx(plain.log_det, abs=1e-8)
    assert set(order[moved.indices]) == set(plain.indices.tolist())


@laws
@given(sizes)
def test_a_measurement_or_prior_knowledge_never_lowers_log_det(size):
    seed, q, p = size
    blocks, prior = drawn(seed, 12, q, p, 0.1)
    k = -(-p // q)
    less = select(blocks=blocks, k=k, method="exact").log_det
    assert select(blocks=blocks, k=k + 1, method="exact").log_det >= less - 1e-9
    known = select(blocks=blocks, prior=prior, k=k, method="exact")
    assert known.log_det >= less - 1e-9
    problem = make_block_problem(blocks, k, prior=prior)
    more = np.append(known.indices, (known.indices[0] + 1) % 12)
    assert problem.log_det(more) >= known.log_det - 1e-9


@laws
@given(st.integers(0, 10**6), st.integers(2, 3))
def test_the_affine_problem_is_that_of_its_kronecker_blocks(seed, m):
    """m outputs share [u, 1]: one reading counted m times, or blocks of m readings."""
    candidates = np.random.default_rng(seed).uniform(-20, 20, (10, 2))
    whole = Affine(2, m).jacobian(candidates)
    assert whole.shape == (10, m, 3 * m)
    affine = select(candidates, 4, "exact", model=Affine(2, m))
    blocks = select(blocks=whole, k=4, method="exact")
    assert affine.log_det == pytest.approx(blocks.log_det, abs=1e-7)
    assert set(affine.indices.tolist()) == set(blocks.indices.tolist())
    counted = select(blocks=Affine(2, m).blocks(candidates), k=4, method="exact")
    assert m * counted.log_det == pytest.approx(affine.log_det, abs=1e-9)


def test_offsets_lose_no_digits():
    rng = np.random.default_rng(0)
    pulses = rng.integers(0, 1000, (14, 2)).astype(float)
    near = Affine(2, 2).jacobian(pulses)
    far = Affine(2, 2).jacobian(pulses + 2.0**40)
    expected = select(blocks=near, k=4, method="exact")
    for method in ("exact", "exchange", "auto"):
        found = select(blocks=far, k=4, method=method)
        assert set(found.indices) == set(expected.indices)
        assert found.log_det == pytest.approx(expected.log_det, abs=1e-9)


def test_the_judge_agrees_with_the_affine_one():
    candidates = np.random.default_rng(2).random((9, 3)) * 300 + 1e6
    problem = make_block_problem(Affine(3, 1).blocks(candidates), 5)
    affine = make_problem(candidates, 5)
    for chosen in itertools.combinations(range(9), 5):
        assert 3 * problem.log_det(chosen) == pytest.approx(affine.log_det(chosen))


def test_zero_and_rank_deficient_blocks_are_worked_with():
    rng = np.random.default_rng(0)
    blocks = rng.normal(size=(12, 2, 4))
    blocks[:4] = 0.0
    blocks[4:8, 1] = blocks[4:8, 0]  # two equal readings
    best = brute_force(blocks, np.zeros((4, 4)), 3)
    for method in SOLVERS:
        found = select(blocks=blocks, k=3, method=method)
        assert np.isfinite(found.log_det)
    assert found.log_det == pytest.approx(best, abs=1e-8)
    lean = rng.normal(size=(9, 2, 1)) * rng.normal(size=(9, 1, 4))  # rank one each
    assert len(select(blocks=lean, method="exact").indices) == 4
    axis = np.eye(3)[np.arange(9) % 3][:, None, :]  # only one of each axis will do
    for seed in range(5):
        found = select(blocks=axis, method="random", seed=seed)
        assert sorted(found.indices % 3) == [0, 1, 2]


@pytest.mark.parametrize("criterion", ["D", "A", "I"])
@pytest.mark.parametrize("size", [1.0, 3.0, 10.0, 1e3])
def test_greedy_answers_where_its_own_picks_are_singular(criterion, size):
    """The widest block fits into no regular pair, and only one pair is regular."""
    axes = np.eye(6)
    wide, mate, pair = axes[[0, 1, 3]], axes[[3, 4, 5]], axes[[0, 1, 2]]
    blocks = np.array([size * wide, mate, pair, 0.9 * size * wide])
    for method in ("greedy", "exchange"):
        found = select(blocks=blocks, k=2, method=method, criterion=criterion)
        assert sorted(found.indices) == [1, 2]


@pytest.mark.parametrize("criterion", ["D", "A", "I", "Ds", "As"])
def test_greedy_and_exchange_ignore_order_and_units_of_many_blocks(criterion):
    """More candidates than fit into a group of the kernel, and a prior."""
    blocks, prior = drawn(3, 150, 2, 5, 0.1)
    order = np.random.default_rng(1).permutation(150)
    scale = np.array([1.0, 1.0, 1e3, 1e-2, 1.0])
    if criterion in ("A", "As"):  # a sum over parameters depends on their units
        scale = np.ones(5)
    for method in ("greedy", "exchange"):
        rules = {"k": 4, "method": method, "criterion": of(criterion, [0, 3])}
        plain = select(blocks=blocks, prior=prior, **rules)
        moved = select(
            blocks=blocks[order] * scale, prior=prior * np.outer(scale, scale), **rules
        )
        assert set(order[moved.indices]) == set(plain.indices)


def test_greedy_leaves_room_for_the_rest_with_fewer_readings_than_parameters():
    """Each of them as if it were the last had 0.57 of the exchange's I-efficiency."""
    shares = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        blocks = rng.normal(size=(120, 2, 12)) * np.logspace(0, 2, 12)
        rules = {"blocks": blocks, "prior": np.eye(12), "k": 4, "criterion": "I"}
        greedy = select(**rules, method="greedy")
        best = select(**rules, method="exchange")
        shares.append(best.problem.criterion.efficiency(greedy.value, best.value))
    assert np.mean(shares) > 0.8


def test_default_k_is_the_fewest_that_identify():
    assert len(select(blocks=drawn(0, 10, 2, 5)[0]).indices) == 3
    assert len(select(blocks=drawn(0, 10, 1, 4)[0]).indices) == 4
    assert len(select(blocks=drawn(0, 10, 3, 2)[0]).indices) == 1


def refused(message, **change):
    blocks, _ = drawn(0, 8, 2, 4)
    with pytest.raises(ValueError, match=message):
        select(**{"blocks": blocks, **change})


def test_bad_blocks_are_one_clear_error():
    blocks, _ = drawn(0, 8, 2, 4)
    refused("give either candidates or blocks, got neither", blocks=None)
    refused("got both", candidates=np.ones((8, 3)))
    refused(r"blocks must have shape \(M, q, p\).* got \(8, 4\)", blocks=blocks[:, 0])
    refused(r"none of them 0, got \(8, 0, 4\)", blocks=blocks[:, :0])
    refused("blocks must be finite, got nan at", blocks=blocks * np.nan)
    refused("blocks must be an array of numbers", blocks="abc")
    refused(r"k must be at least 2 for 4 parameters, at most 2 of them", k=1)
    refused(r"k must be at least 2 .* and 1 known", k=1, prior=np.diag([1.0, 0, 0, 0]))
    refused(r"prior must be a precision of shape \(4, 4\)", prior=np.eye(3))
    refused("prior must be a symmetric", prior=np.triu(np.ones((4, 4))))
    refused("prior must be a positive semidefinite", prior=-np.eye(4))
    bare = {"blocks": None, "candidates": np.ones((8, 3))}
    refused(r"prior must be a jaxcal.Prior\(std=...\), got int", **bare, prior=1)
    refused('"policy" is trained to choose .*got blocks', method="policy")
    blind = blocks * [1, 1, 0, 1]
    refused("do not inform the direction theta3", blocks=blind)
    blind[..., 2] = 2 * blind[..., 1]
    refused(r"the direction \(\+0.8944 theta2 -0.4472 theta3\)", blocks=blind)
    prior = np.diag([0, 0, 1.0, 0])
    assert select(blocks=blind, prior=prior).proven
    refused(
        "required candidates leave too little room .* span 2 of 4 regressors",
        blocks=np.concatenate([blocks[:1], blocks[:1], blocks[1:]]), required=[0, 1],
    )  # fmt: skip


@pytest.mark.parametrize("criterion", ["D", "I", "G"])
def test_an_offset_far_beyond_the_spread_changes_no_choice(rng, criterion):
    u, model = rng.uniform(-1.0, 1.0, (40, 2)), Polynomial(2, 2, 1)
    near, far = (
        select(u + offset, 6, "exchange", model=model, criterion=criterion)
        for offset in (0.0, [0.0, 1e5])
    )
    np.testing.assert_array_equal(np.sort(near.indices), np.sort(far.indices))
    assert far.value == pytest.approx(near.value, rel=1e-6)
