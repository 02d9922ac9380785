"""Commands between the candidates: published designs, grids, laws, bounds."""

import itertools

import numpy as np
import pytest

import jaxcal
from jaxcal.designs import continuous
from jaxcal.models import (
    Affine,
    Board,
    FromFunction,
    FromJax,
    Polynomial,
    SerialChain,
    Socket,
)

jnp = pytest.importorskip("jax.numpy")

# -- published -------------------------------------------------------------------------
# Models and values of the comparison with Pyomo.DoE of discopt-doe, 2026 (t_design.py,
# t2_constraints_batch.py, t3_structure.py); Michaelis and Menten: K S / (2 K + S).


def exponentials(u, theta):
    return sum(theta[i] * jnp.exp(-theta[i + 1] * u) for i in range(0, len(theta), 2))


@pytest.mark.parametrize(
    ("k", "log_det"), [(2, 12.655), pytest.param(4, 14.0414, marks=pytest.mark.slow)]
)
def test_michaelis_menten_has_the_two_points_of_the_textbook(k, log_det):
    def reading(u, theta):
        return theta[0] * u[:, :1] / (theta[1] + u[:, :1])

    model = FromFunction(reading, [2.0, 0.3], batch=True, noise=jaxcal.Noise(0.05))
    if k == 4:  # by JAX
        model = FromJax(lambda u, t: reading(u[None], t)[0], [2.0, 0.3], num_inputs=1)
    best = jaxcal.optimise(
        [[0.01, 5.0]], k, model, noise=jaxcal.Noise(0.05), criterion="D", starts=2
    )
    assert best.log_det == pytest.approx(log_det, abs=1e-3)
    points = np.repeat([0.3 * 5.0 / (2 * 0.3 + 5.0), 5.0], k // 2)
    np.testing.assert_allclose(np.sort(best.commands[:, 0]), points, atol=1e-3)
    assert 0.9999 < best.efficiency <= 1.0
    assert "not a proof" in str(best) and not best.proven


@pytest.mark.slow
@pytest.mark.parametrize(
    ("theta", "k", "limits", "log_det"),
    [([1.0, 5.0, 0.5, 0.8, 0.2, 0.05], 6, [0.01, 60.0], 42.87)],
)
def test_tri_exponential_decay(theta, k, limits, log_det):
    model = FromJax(lambda u, t: exponentials(u[0], t), theta, num_inputs=1)
    best = jaxcal.optimise([limits], k, model, noise=jaxcal.Noise(0.01), criterion="D")
    assert best.log_det == pytest.approx(log_det, abs=5e-3)
    assert best.efficiency > 0.999


@pytest.mark.slow
def test_bi_exponential_decay_with_five_minutes_in_all():
    model = FromJax(exponentials, [1.0, 2.0, 0.5, 0.1], num_inputs=4)
    best = jaxcal.optimise(
        [[0.05, 30.0]] * 4, 1, model, noise=jaxcal.Noise(0.01), criterion="D",
        allowed=lambda u: u.sum() <= 5.0,
    )  # fmt: skip
    assert best.commands.sum() <= 5.0
    assert best.log_det == pytest.approx(30.4335, abs=2e-3)


@pytest.mark.slow
def test_a_sine_of_many_local_optima():
    model = FromJax(lambda u, t: t[0] * jnp.sin(t[1] * u[0]), [1.0, 3.0], num_inputs=1)
    best = jaxcal.optimise(
        [[0.0, 10.0]], 1, model, noise=jaxcal.Noise(0.1), criterion="D",
        prior=jaxcal.Prior([0.1, 1.0]),
    )  # fmt: skip
    assert best.log_det == pytest.approx(13.70, abs=5e-3)


# -- grids and laws --------------------------------------------------------------------


def log_det(rows):
    return np.linalg.slogdet(rows.T @ rows)[1]


@pytest.mark.parametrize(
    "criterion", ["I", *(pytest.param(x, marks=pytest.mark.slow) for x in "DAE")]
)
def test_a_parabola_is_measured_as_a_grid_says(criterion):
    """Oracle: four of 11 points, by numpy."""
    grid = np.linspace(-1.0, 1.0, 11)
    features = np.stack([grid**0, grid, grid**2], axis=1)
    region = features.T @ features / len(grid)
    best = -np.inf
    for chosen in itertools.combinations_with_replacement(range(11), 4):
        information = features[list(chosen)].T @ features[list(chosen)]
        if np.linalg.matrix_rank(information) < 3:
            continue
        inverse = np.linalg.inv(information)
        best = max(best, {
            "D": np.linalg.slogdet(information)[1],
            "A": -np.trace(inverse),
            "I": -np.trace(inverse @ region),
            "E": np.linalg.eigvalsh(information)[0],
        }[criterion])  # fmt: skip
    found = jaxcal.optimise(
        [[-1.0, 1.0]], 4, Polynomial(2, 1), criterion=criterion, starts=3,
        region=grid[:, None] if criterion == "I" else None,
    )  # fmt: skip
    sign = 1.0 if criterion in "DE" else -1.0
    assert sign * found.value >= best - 1e-6 * abs(best)
    assert sign * found.bound >= sign * found.value - 1e-9
    again = jaxcal.Design(found.commands, Polynomial(2, 1))
    if criterion != "I":
        assert again.score([0, 1, 2, 3], criterion).value == pytest.approx(found.value)


@pytest.mark.slow
def test_the_bound_of_e_is_that_of_the_weighted_optimum():
    """Of all quadratics on the square: a fifth of an eigenvalue for each command."""
    model = Polynomial(2, 2)
    found = jaxcal.optimise([[-1.0, 1.0]] * 2, 10, model, criterion="E", starts=3)
    assert 2.0 - 1e-6 <= found.bound < 2.002 and found.value <= found.bound
    assert found.value > 1.5


def test_the_bound_takes_no_round_twice(monkeypatch):
    """It took twelve here, ten of them from the same weights of the same support."""
    rounds, weighted = [], continuous._weights

    def noted(ascent, blocks, weights):
        rounds.append(weights)
        return weighted(ascent, blocks, weights)

    monkeypatch.setattr(continuous, "_weights", noted)
    jaxcal.optimise([[-1.0, 1.0]] * 3, 6, Affine(3, 1), criterion="I", starts=2)
    pairs = itertools.pairwise(rounds)
    steps = [np.abs(a - b).max() for a, b in pairs if len(a) == len(b)]
    assert min(steps) > 1e-6


def test_an_affine_map_is_measured_at_corners_and_that_is_proven():
    """Four of the cube's corners, of which no two share an edge: Hadamard's bound."""
    found = jaxcal.optimise([[0.0, 2.0], [-1.0, 1.0], [5.0, 7.0]], model=Affine(3, 1))
    signs = found.commands - [1.0, 0.0, 6.0]
    np.testing.assert_allclose(np.abs(signs), 1.0, atol=1e-9)
    assert found.log_det == pytest.approx(4 * np.log(4.0), abs=1e-9)
    assert found.certain and found.efficiency == pytest.approx(1.0, abs=1e-6)


@pytest.mark.slow
def test_refining_is_never_worse_and_keeps_the_rules():
    rng = np.random.default_rng(0)
    model = Polynomial(2, 2)
    candidates = rng.uniform(-1.0, 1.0, (30, 2))
    design = jaxcal.Design(candidates, model, noise=jaxcal.Noise(0.1))
    first = design.select(7)  # I over the candidates

    def round_table(u):
        return u @ u <= 1.0

    inside = [i for i in range(30) if round_table(candidates[i])][:7]
    better = design.refine(first, starts=2)
    assert better.criterion == "I" and better.value <= first.value
    assert better.began == pytest.approx(first.value)
    low, high = candidates.min(axis=0), candidates.max(axis=0)
    assert ((better.commands >= low) & (better.commands <= high)).all()
    kept = design.refine(inside, allowed=round_table, criterion="D", starts=1)
    assert all(round_table(u) for u in kept.commands)
    assert kept.value > design.score(inside, "D").value
    assert kept.bound >= kept.value
    assert "started at" in str(kept) and set(kept.to_dict()) >= {"commands", "began"}
    # Outside a circle of radius .2 a better one than any of the grid inside is found.
    rows = np.stack([np.ones(7), *kept.commands.T, *(kept.commands**2).T,
                     kept.commands.prod(axis=1)], axis=1)  # fmt: skip
    assert kept.value == pytest.approx(log_det(rows) - 12 * np.log(0.1), abs=1e-8)


def test_a_function_that_can_only_be_run_is_refined():
    def decay(u, theta):
        return theta[0] * np.exp(-theta[1] * u)

    model = FromFunction(decay, [2.0, 0.5], batch=True, noise=jaxcal.Noise(0.01))
    best = jaxcal.optimise([[0.0, 8.0]], 2, model, criterion="D", starts=1)
    # 1 / rate after the first, by hand.
    np.testing.assert_allclose(np.sort(best.commands[:, 0]), [0.0, 2.0], atol=1e-3)


SCENARIOS = np.array([[1.0, 0.1], [1.0, 0.3], [1.0, 3.0]])


def enzyme():
    def reading(u, theta):
        return theta[0] * u / (theta[1] + u)

    return FromFunction(reading, [1.0, 0.3], batch=True, quiet=True)


@pytest.mark.parametrize(
    ("joined", "name"),
    [
        ("Worst", "D"),
        *(
            pytest.param(joined, name, marks=pytest.mark.slow)
            for joined, name in itertools.product(["Mean", "Worst"], "DAE")
        ),
    ],
)
def test_two_commands_for_several_scenarios_are_those_of_a_fine_grid(joined, name):
    """Every pair of 250 commands, in numpy; the bound is above them all."""
    x = np.linspace(0.02, 5.0, 250)
    k = SCENARIOS[:, 1:]
    slopes = np.stack([x / (k + x), -x / (k + x) ** 2], axis=-1)  # (S, N, 2)
    i, j = np.triu_indices(len(x), 1)
    pairs = slopes[:, np.stack([i, j], axis=1)]  # (S, pairs, 2, 2)
    sizes = np.linalg.svd(pairs, compute_uv=False)
    each = {
        "D": lambda: 2.0 * np.log(sizes).sum(axis=-1),
        "A": lambda: -(sizes**-2.0).sum(axis=-1),
        "E": lambda: sizes[..., -1] ** 2,
    }[name]()
    worth = (each.mean(axis=0) if joined == "Mean" else each.min(axis=0)).max()
    design = jaxcal.Design(
        np.linspace(0.5, 5.0, 10)[:, None], enzyme(), jaxcal.Prior(np.inf),
        scenarios=SCENARIOS,
    )  # fmt: skip
    first = design.select(2, getattr(jaxcal, joined)(name), "exact")
    better = design.refine(first, [[0.02, 5.0]], starts=2)
    sign = -1.0 if name == "A" else 1.0
    assert sign * better.value > sign * first.value
    assert better.began == pytest.approx(first.value, rel=1e-9)
    near = 1e-3 if name == "D" else 1e-3 * abs(worth)
    assert sign * better.value > worth - 0.02 * near
    assert sign * better.value < worth + near  # the grid is this fine
    assert sign * better.bound > worth
    assert "scenarios     3" in str(better)


def test_bad_input_is_named():
    design = jaxcal.Design(np.random.default_rng(0).random((9, 2)), Affine(2, 1))
    with pytest.raises(ValueError, match=r"limits must be \(n, 2\), lower below"):
        jaxcal.optimise([[1.0, 0.0]], 2, Affine(1, 1))
    with pytest.raises(ValueError, match=r"limits must be \(2, 2\) for this model"):
        design.refine([0, 1, 2], [[0.0, 0.1]])
    with pytest.raises(ValueError, match="allowed must be a function of one command"):
        design.refine([0, 1, 2], allowed=3)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"whole numbers, got 1\.5"):
        design.refine([0, 1.5, 2])
    some = np.random.default_rng(0).random((9, 2))
    masked = jaxcal.Design(some, Affine(2, 1), available=np.arange(9) > 0)
    with pytest.raises(ValueError, match="available candidates, got 0"):
        masked.refine([0, 1, 2])
    with pytest.raises(ValueError, match="selection must be within the limits"):
        design.refine([0, 1, 2], [[0.0, 0.1]] * 2)
    with pytest.raises(ValueError, match=r"selection must lie in \[0, 9\), got 9"):
        design.refine([0, 1, 9])
    with pytest.raises(ValueError, match="allowed is False at all"):
        jaxcal.optimise([[0.0, 1.0]], 2, Affine(1, 1), allowed=lambda u: False)
    with pytest.raises(ValueError, match="allowed is False for the starting command"):
        design.refine([0, 1, 2], allowed=lambda u: False)
    with pytest.raises(ValueError, match="refine needs candidates and a model"):
        jaxcal.Design.from_blocks(np.ones((3, 1, 1))).refine([0])
    best = jaxcal.Worst("D", efficiency=True)
    cases = ([[0.0, 1.0]], 2, enzyme())
    with pytest.raises(ValueError, match="refine does not support criterion"):
        jaxcal.optimise(*cases, criterion=best, scenarios=SCENARIOS)


# -- arms ------------------------------------------------------------------------------

UR5 = [
    [0.0, 90.0, 89.2, 0.0],
    [-425.0, 0.0, 0.0, 0.0],
    [-392.0, 0.0, 0.0, 0.0],
    [0.0, 90.0, 109.3, 0.0],
    [0.0, -90.0, 94.75, 0.0],
    [0.0, 0.0, 82.5, 0.0],
]


@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["position", "socket", "board"])
def test_postures_of_an_arm_are_refined_where_it_can_be_measured(sensor):
    arm = SerialChain.from_dh(UR5)
    rules = {"floor": -50.0}
    if sensor == "socket":
        place = np.array([[400.0, 200.0, 100.0], [300.0, -300.0, 150.0]])
        arm = arm.measured_with(Socket(count=2, places=place))
    elif sensor == "board":
        place = np.eye(4)
        place[:3, 3] = 500.0, 0.0, 0.0
        arm = arm.measured_with(Board(place=place, extent=(150.0, 100.0)))
        rules |= {"camera": (60.0, 45.0)}
    where = arm.reachable(**rules)
    candidates = arm.postures(40, **rules)
    assert all(where(u) for u in candidates[:5])
    design = jaxcal.Design(candidates, arm)
    first = design.select(16 if sensor == "socket" else 9, method="greedy")
    better = design.refine(first, allowed=where, starts=1, time_limit=20.0)
    assert better.value < first.value  # the mean variance of predictions
    j, (low, high) = arm.num_joints, where.limits.T
    joints = better.commands[:, :j]
    assert ((joints >= low - 1e-9) & (joints <= high + 1e-9)).all()
    assert all(where(u) for u in better.commands)
    if sensor == "socket":
        assert (
            np.abs(arm.predict(better.commands)).max() < 1e-3
        )  # the ball in its place
