"""Every criterion on blocks, against brute force and designs of the literature."""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from questions import make_block_problem, make_problem, of, score

import jaxcal
from jaxcal.models import Affine, FromJax, Linear
from jaxcal.selection import select
from jaxcal.selection.criteria import CRITERIA
from jaxcal.selection.exchange.exchange import exchange_from

laws = settings(max_examples=20, deadline=None)
NAMES = st.sampled_from(tuple(CRITERIA))
SIGN = {
    "D": 1,
    "Ds": 1,
    "E": 1,
    "A": -1,
    "As": -1,
    "I": -1,
    "G": -1,
}  # 1: larger is better


def definition(name, blocks, prior, chosen, region=None):
    """The reported value, by the inverse alone; None where singular."""
    m = prior + sum(blocks[i].T @ blocks[i] for i in chosen)
    if np.linalg.cond(m) > 1e11:
        return None
    v = np.linalg.inv(m)
    if name == "D":
        return -np.linalg.slogdet(v)[1]
    if name == "A":
        return np.trace(v)
    if name == "E":
        return np.linalg.eigvalsh(m)[0]
    if name == "Ds":
        return -np.linalg.slogdet(v[:2, :2])[1]
    if name == "As":
        return np.trace(v[:2, :2])
    where = blocks if region is None else region
    variances = np.einsum("iqa,ab,iqb->iq", where, v, where)
    return variances.max() if name == "G" else variances.mean()


def brute_force(name, blocks, prior, k, cap=1, available=None, required=()):
    usable = [i for i in range(len(blocks)) if available is None or available[i]]
    region = None if available is None else blocks[available]
    found = []
    for chosen in itertools.combinations_with_replacement(usable, k):
        if max(map(chosen.count, chosen)) <= cap and set(required) <= set(chosen):
            value = definition(name, blocks, prior, chosen, region)
            if value is not None:
                found.append(SIGN[name] * value)
    return SIGN[name] * max(found)


def drawn(seed, m, q, p, weight=0.0):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(p, p))
    return rng.normal(size=(m, q, p)), weight * root.T @ root


CASES = [
    (9, 1, 3, 3, 0.0),
    (9, 1, 3, 5, 0.2),
    (9, 1, 4, 2, 0.3),
    (9, 2, 4, 2, 0.0),
    (9, 2, 4, 4, 0.1),
    (9, 3, 4, 2, 1e-4),
    (9, 3, 2, 2, 0.0),
]


@pytest.mark.parametrize("name", CRITERIA)
def test_heuristics_never_beat_brute_force_and_exchange_reaches_it(name):
    reached = []
    for m, q, p, k, weight in CASES:
        for seed in range(2):
            blocks, prior = drawn(seed, m, q, p, weight)
            best = brute_force(name, blocks, prior, k)
            for method in ("random", "greedy", "exchange"):
                found = select(
                    blocks=blocks, prior=prior, k=k, method=method, criterion=of(name),
                )  # fmt: skip
                value = definition(name, blocks, prior, found.indices)
                assert found.value == pytest.approx(value, rel=1e-7, abs=1e-9)
                assert SIGN[name] * (best - value) >= -1e-8 * abs(best)
            reached.append(value == pytest.approx(best, rel=1e-7))
    assert np.mean(reached) >= 0.9, reached


@pytest.mark.parametrize("name", CRITERIA)
def test_rules_are_kept_and_used_by_every_criterion(name):
    for seed, (q, k, weight) in enumerate([(1, 4, 0.0), (2, 3, 0.2)]):
        blocks, prior = drawn(seed, 8, q, 3, weight)
        available = np.arange(8) != 5
        rules = {"available": available, "required": [2], "max_replicates": 2}
        best = brute_force(name, blocks, prior, k, 2, available, [2])
        blocks[5] = np.nan
        for method in ("greedy", "exchange"):
            found = select(
                blocks=blocks, prior=prior, k=k, method=method, criterion=of(name),
                **rules,
            )  # fmt: skip
            assert available[found.indices].all()
            assert 2 in found.indices
            assert np.bincount(found.indices).max() <= 2
            assert SIGN[name] * (best - found.value) >= -1e-8 * abs(best)
        assert found.value == pytest.approx(best, rel=1e-7)


@pytest.mark.parametrize("name", CRITERIA)
def test_no_single_swap_improves_an_exchange(name):
    blocks, prior = drawn(3, 14, 2, 6, 0.01)
    problem = make_block_problem(blocks, 4, prior=prior, criterion=of(name))
    start = select(blocks=blocks, prior=prior, k=4, method="random").indices
    chosen = exchange_from(problem, start)
    best = SIGN[name] * problem.values(chosen[None])[0][0]
    assert best >= SIGN[name] * problem.values(start[None])[0][0]
    for position, new in itertools.product(range(4), range(14)):
        swapped = chosen.copy()
        swapped[position] = new
        if len(set(swapped.tolist())) == 4:
            value = SIGN[name] * problem.values(swapped[None])[0][0]
            assert value <= best + 1e-8 * abs(best)


@laws
@given(st.integers(0, 10**6), NAMES, st.sampled_from([0.0, 0.1]))
def test_order_of_the_candidates_and_knowledge(seed, name, weight):
    """Permuting the blocks permutes the answer; knowing more is never worse."""
    blocks, prior = drawn(seed, 10, 2, 4, weight)
    rules = {"k": 3, "method": "exchange", "criterion": of(name)}
    plain = select(blocks=blocks, prior=prior, **rules)
    order = np.random.default_rng(seed).permutation(10)
    moved = select(blocks=blocks[order], prior=prior, **rules)
    assert moved.value == pytest.approx(plain.value, rel=1e-6)
    assert set(order[moved.indices]) == set(plain.indices)
    known = select(blocks=blocks, prior=prior + np.eye(4), **rules)
    assert SIGN[name] * (known.value - plain.value) >= -1e-8 * abs(plain.value)


@laws
@given(st.integers(0, 10**6), st.sampled_from(["D", "I"]))
def test_d_and_i_do_not_depend_on_the_parameters_chosen(seed, name):
    blocks, prior = drawn(seed, 12, 2, 5, 0.1)
    rng = np.random.default_rng(seed)
    matrix = (rng.normal(size=(5, 5)) + 3 * np.eye(5)) * 10.0 ** np.linspace(-4, 4, 5)
    if np.linalg.cond(matrix) > 1e11:
        return
    rules = {"k": 4, "method": "greedy", "criterion": name}
    plain = select(blocks=blocks, prior=prior, **rules)
    mapped = select(blocks=blocks @ matrix, prior=matrix.T @ prior @ matrix, **rules)
    np.testing.assert_array_equal(mapped.indices, plain.indices)
    shift = 2 * np.linalg.slogdet(matrix)[1] if name == "D" else 0.0
    assert mapped.value == pytest.approx(plain.value + shift, rel=1e-5)


@pytest.mark.parametrize("name", CRITERIA)
def test_what_was_measured_counts_as_if_it_were_required(name):
    blocks, prior = drawn(1, 12, 2, 4, 0.01)
    about = {"prior": prior, "criterion": of(name), "region": None}
    if name == "I":
        about["region"] = blocks
    rules = {"blocks": blocks, "method": "exchange", **about}
    again = select(k=4, required=[3, 8], **rules)
    rules["available"] = ~np.isin(np.arange(12), [3, 8])
    new = select(k=2, measured=blocks[[3, 8]], **rules)
    assert new.value == pytest.approx(again.value, rel=1e-8)
    assert set(again.indices) == {3, 8, *new.indices}


def test_the_affine_model_is_judged_as_its_kronecker_blocks():
    candidates = np.random.default_rng(0).uniform(-3, 3, (12, 2))
    whole = Affine(2, 3).jacobian(candidates)
    for name in ("D", "A", "I", "E"):
        few = score(candidates, [0, 3, 5, 8], model=Affine(2, 3), criterion=name)
        many = score(None, [0, 3, 5, 8], blocks=whole, criterion=name)
        assert few.value == pytest.approx(many.value, rel=1e-9), name
        kept = dataclasses.asdict(few.criteria)
        # Its O1 to O5 and D are those of S too; A, I, E as the criterion has them.
        assert kept == pytest.approx(dataclasses.asdict(many.criteria), rel=1e-7)
        if name != "D":
            assert kept[name] == pytest.approx(few.value, rel=1e-9)
    slopes = jaxcal.As(["a11", "a21"])
    found = score(candidates, [0, 3, 5], model=Affine(2, 3), criterion=slopes)
    v = np.linalg.inv(sum(whole[i].T @ whole[i] for i in (0, 3, 5)))
    assert found.value == pytest.approx(v[0, 0] + v[2, 2])


def test_a_model_with_prior_noise_and_held_parameters():
    def answer(u, theta):
        import jax.numpy as jnp

        return jnp.stack([theta[0] * u[0] + theta[1], theta[2] * jnp.sin(u[1])])

    model = FromJax(answer, [1.0, 0.0, 2.0], names=("gain", "bias", "swing"))
    u = np.random.default_rng(0).uniform(-1, 1, (30, 2))
    prior = jaxcal.Prior({"gain": 0.5, "swing": 2.0}, fixed=["bias"])
    noise = jaxcal.Noise(std=[0.1, 0.4])
    jacobian = np.zeros((30, 2, 2))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = u[:, 0] / 0.1, np.sin(u[:, 1]) / 0.4
    precision = np.diag([4.0, 0.25])
    for name in ("D", "A", "I", "E"):
        found = select(
            u, 3, "exchange", model=model, prior=prior, noise=noise, criterion=name
        )
        bare = select(
            blocks=jacobian, k=3, method="exchange", prior=precision, criterion=name
        )
        assert found.value == pytest.approx(bare.value, rel=1e-6)
        assert set(found.indices) == set(bare.indices)
    assert select(u, 3, "greedy", model=model, prior=prior).criterion == "I"
    assert len(select(u, model=model, method="greedy", prior=prior).indices) == 1
    kept = select(
        u, 2, "exchange", model=model, prior=prior, region=u[:3], measured=u[:4],
        noise=noise,
    )  # fmt: skip
    bare = select(
        blocks=jacobian, k=2, method="exchange", prior=precision, criterion="I",
        region=jacobian[:3], measured=jacobian[:4],
    )  # fmt: skip
    assert kept.value == pytest.approx(bare.value, rel=1e-6)
    blind = FromJax(
        lambda u, t: u[:1] * t[0] + 0 * t[1], [1, 0], names=("gain", "bias")
    )
    with pytest.raises(
        ValueError, match=r"every parameter.*do not inform bias; give a"
    ):
        select(u, model=blind)


def test_a_scalar_noise_of_the_affine_model_only_scales():
    u = np.random.default_rng(0).random((20, 2))
    plain = select(u, 4, "exact")
    noisy = select(u, 4, "exact", noise=jaxcal.Noise(std=0.1))
    np.testing.assert_array_equal(noisy.indices, plain.indices)
    assert noisy.log_det == pytest.approx(plain.log_det + 12 * np.log(10.0))
    known = select(u, 2, "exchange", measured=u[:2])
    assert known.log_det == pytest.approx(
        make_problem(u, 4).log_det(np.array([0, 1, *known.indices])), rel=1e-9
    )


def polynomial(points, degree):
    return np.vander(points, degree + 1, increasing=True)[:, None, :]


GRID = np.linspace(-1, 1, 201)


def test_optimal_polynomials_on_an_interval():
    """Fedorov 1972: D-optimal weights are equal; A-optimal quadratic is 1:2:1."""
    quadratic = select(
        blocks=polynomial(GRID, 2), k=6, method="exchange", max_replicates=6
    )
    assert sorted(GRID[quadratic.indices]) == pytest.approx([-1, -1, 0, 0, 1, 1])
    points = np.append(GRID, [-np.sqrt(0.2), np.sqrt(0.2)])
    cubic = select(blocks=polynomial(points, 3), k=4, method="exchange")
    support = [-1, -np.sqrt(0.2), np.sqrt(0.2), 1]
    assert sorted(points[cubic.indices]) == pytest.approx(support)
    variances = select(
        blocks=polynomial(GRID, 2), k=4, method="exchange", criterion="A",
        max_replicates=4,
    )  # fmt: skip
    assert sorted(GRID[variances.indices]) == pytest.approx([-1, 0, 0, 1])
    assert variances.value == pytest.approx(2.0)  # 8 / 4


@pytest.mark.parametrize("n", [4, 8])
def test_weighing_designs_are_hadamard_matrices(n):
    """n objects on two pans, n weighings: det n^n, every variance 1 / n."""
    signs = np.array(list(itertools.product([-1.0, 1.0], repeat=n - 1)))
    rows = np.column_stack([np.ones(len(signs)), signs])[:, None, :]
    for name, best in (("D", n * np.log(n)), ("A", 1.0), ("E", n)):
        found = select(blocks=rows, k=n, method="exchange", criterion=name)
        assert found.value == pytest.approx(best), name


@pytest.mark.parametrize("name", ["D", "A", "I", "E"])
def test_a_linear_model_on_a_cube_is_measured_at_its_corners(name):
    axis = np.linspace(-1, 1, 3)
    cube = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    model = Linear("1 + a + b + c", 1, inputs=("a", "b", "c"))
    found = select(cube, 8, "exchange", model=model, criterion=name)
    assert sorted(map(tuple, cube[found.indices])) == sorted(
        itertools.product([-1, 1], repeat=3)
    )


def test_a_selection_says_by_which_criterion(capsys):
    blocks, prior = drawn(0, 12, 2, 4, 0.1)
    found = select(blocks=blocks, prior=prior, k=3, method="exchange", criterion="I")
    kept = found.to_dict()
    assert (kept["criterion"], kept["value"]) == ("I", found.value)
    assert kept["log_det"] == pytest.approx(
        definition("D", blocks, prior, found.indices)
    )
    scored = score(None, found.indices, blocks=blocks, prior=prior, criterion="I")
    assert scored.value == pytest.approx(found.value)
    assert found.criteria.I == pytest.approx(found.value)
    assert found.criteria.A == pytest.approx(
        definition("A", blocks, prior, found.indices)
    )


U = np.random.default_rng(0).random((9, 3))
BARE = {"blocks": None, "candidates": U}
HELD = jaxcal.Prior(1.0, fixed=("a11", "a12", "a13", "b1"))


@pytest.mark.parametrize(
    ("message", "change"),
    [
        (
            r"criterion must be one of D, A, I, G, E, Ds, As, got 'D\+A'",
            {"criterion": "D+A"},
        ),
        ("criterion must be one of", {"criterion": ["D", "A"]}),
        (r"criterion Ds needs its parameters: jaxcal.Ds\(\[", {"criterion": "Ds"}),
        (r"criterion Ds needs its parameters: jaxcal.Ds\(\[", {"criterion": jaxcal.Ds}),
        ("parameters must be names or indices, got 3", {"criterion": jaxcal.Ds(3)}),
        (r"required must have shape \(r,\), got \(1, 2\)", {"required": [[0, 1]]}),
        ("required must be one array", {"required": [[1, 2], [3]]}),
        ("there is no argument 'parameters'", {"parameters": [0]}),
        ("parameters must be indices or names", {"criterion": jaxcal.As([4])}),
        ("parameters must be indices .*'x'", {"criterion": jaxcal.As("x")}),
        ("parameters must be names, each once", {"criterion": jaxcal.As([1, 1])}),
        (
            "region works once, with criterion I or G only",
            {"region": np.ones((3, 2, 4)), "criterion": jaxcal.I(np.ones((3, 2, 4)))},
        ),
        (
            r"region must have shape \(N, 2, 4\)",
            {"region": np.ones((3, 4)), "criterion": "I"},
        ),
        (
            "region works once, with criterion I or G only, got criterion D",
            {"region": np.ones((3, 2, 4))},
        ),
        (r"measured must have shape \(N, 2, 4\)", {"measured": np.ones((3, 1, 4))}),
        ("prior must be a .* precision with blocks", {"prior": jaxcal.Prior(1.0)}),
        ("model needs candidates", {"model": Affine(3, 3)}),
        (r"candidates must have shape \(M, 2\)", BARE | {"model": Affine(2, 2)}),
        ("prior fixes all", BARE | {"model": Affine(3, 1), "prior": HELD}),
        (r"measured must have shape \(N, 3\)", BARE | {"measured": U[:, :2]}),
        (
            '"policy" is trained .*got criterion A',
            BARE | {"method": "policy", "criterion": "A"},
        ),
    ],
)
def test_bad_criteria_are_one_clear_error(message, change):
    blocks, _ = drawn(0, 8, 2, 4)
    with pytest.raises(ValueError, match=message):
        select(**{"blocks": blocks, "method": "greedy", **change})


def test_k_is_by_default_enough_to_identify():
    """ceil(p / q) is three here, but every third of a frequency is singular."""
    model = FromJax(
        lambda u, t: (
            u[0] * jnp.stack([jnp.cos(u[1] * t[4]), jnp.sin(u[1] * t[4])])
            + jnp.stack([t[0] + t[1] * u[0], t[2] + t[3] * u[0]])
        ),
        [0.1, 1.0, 0.2, 1.0, 0.7],
    )
    u = np.random.default_rng(0).uniform(0.5, 2.0, size=(20, 2))
    found = select(u, model=model, method="exchange", criterion="D")
    assert np.isfinite(found.log_det)
    alone = np.zeros((6, 2, 3))  # two readings, of which four candidates see one thing
    alone[:4, :, 0] = 1.0
    alone[4, 0, 1] = alone[5, 1, 2] = 1.0
    assert len(select(blocks=alone, method="greedy").indices) == 3


@pytest.mark.parametrize("name", ["D", "A", "I", "E"])
def test_exchange_where_all_are_required_returns_them(name):
    blocks = np.random.default_rng(0).normal(size=(9, 2, 3))
    found = select(
        blocks=blocks, k=2, required=[8, 5], prior=np.eye(3), method="exchange",
        criterion=name, restarts=3,
    )  # fmt: skip
    assert sorted(found.indices) == [5, 8]
