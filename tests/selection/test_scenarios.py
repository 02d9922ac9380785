"""Designs over scenarios, against brute force and against scenario by scenario."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from jaxcal import Design, I, Mean, Prior, Worst, select
from jaxcal.models import Affine
from jaxcal.models.model import Model
from jaxcal.selection.problem import ScenarioProblem

Array = np.ndarray


class MichaelisMenten(Model):
    """Rate ``V x / (K + x)`` of an enzyme."""

    names = ("V", "K")
    nominal = np.array([1.0, 0.3])
    num_inputs = num_outputs = 1

    def predict(self, commands: Array, parameters: Array | None = None) -> Array:
        v, k = self.nominal if parameters is None else parameters
        return v * commands / (k + commands)

    def jacobian(self, commands: Array, parameters: Array | None = None) -> Array:
        v, k = self.nominal if parameters is None else parameters
        slopes = [commands / (k + commands), -v * commands / (k + commands) ** 2]
        return np.stack(slopes, axis=-1)

    def command_jacobian(
        self, commands: Array, parameters: Array | None = None
    ) -> Array:
        v, k = self.nominal if parameters is None else parameters
        return (v * k / (k + commands) ** 2)[..., None]


def phi(blocks: Array, chosen: object, name: str, region: Array) -> Array:
    """(S,) of a selection, larger is better, of blocks (S, M, q, p)."""
    some = blocks[:, list(chosen)]  # type: ignore[call-overload]
    information = np.einsum("snqa,snqb->sab", some, some)
    if name == "D":
        return np.linalg.slogdet(information)[1]
    if name == "E":
        return np.linalg.eigvalsh(information)[:, 0]
    weight = np.eye(blocks.shape[3])
    if name == "I":
        region = region.reshape(-1, *region.shape[-2:])
        weight = np.einsum("rqa,rqb->ab", region, region) / region[:, :, 0].size
    return -np.trace(np.linalg.inv(information) @ weight, axis1=1, axis2=2)


def joined(values: Array, weights: Array, criterion: Mean | Worst, name: str) -> Array:
    """(N,) what counts of selections (N, S), larger is better."""
    if getattr(criterion, "of_efficiency", False):
        best = values.max(axis=0)
        shares = values / best if name == "E" else best / values
        if name == "D":
            shares = np.exp((values - best) / 3)
        return shares.min(axis=1)
    return values @ weights if isinstance(criterion, Mean) else values.min(axis=1)


@pytest.mark.parametrize("name", "DAIE")
def test_exact_is_brute_force(name) -> None:
    rng = np.random.default_rng(ord(name))
    for q, (s, m, p, k) in ((1, (4, 8, 3, 4)), (2, (3, 7, 3, 3))):
        blocks, weights = rng.standard_normal((s, m, q, p)), rng.dirichlet(np.ones(s))
        design = Design.from_blocks(blocks, weights=weights)
        region = rng.standard_normal((5, q, p))
        subsets = list(itertools.combinations(range(m), k))
        each = np.array([phi(blocks, c, name, region) for c in subsets])
        letter = I(region) if name == "I" else name
        for criterion in (Mean(letter), Worst(letter), Worst(letter, efficiency=True)):
            worth = joined(each, weights, criterion, name)
            order = np.argsort(-worth)[:3]
            answer = design.select(k, criterion, "exact", best=3)
            sign = 1.0
            if name in "AI" and not getattr(criterion, "of_efficiency", False):
                sign = -1.0
            assert answer.proven
            assert answer.indices.tolist() == list(subsets[order[0]])
            values = [subset.value for subset in answer.alternatives]
            np.testing.assert_allclose(values, sign * worth[order], rtol=1e-8)
            auto = design.select(k, criterion)
            assert auto.efficiency > 0.999 - 1e-9
            for method in ("greedy", "exchange", "random"):
                other = design.select(k, criterion, method)
                assert sign * other.value <= sign * answer.value + 1e-9
                bound = sign * other.bound  # true, though from the relaxation
                assert bound >= sign * answer.value - 1e-9 * abs(answer.value)


def test_the_worst_measurement_that_fails_is_a_scenario() -> None:
    """Every choice by brute force; candidate i fails in scenario i."""
    blocks = np.random.default_rng(6).standard_normal((7, 1, 3))
    fails = blocks * ~np.eye(7, dtype=bool)[:, :, None, None]
    subsets = list(itertools.combinations(range(7), 5))
    each = np.array([phi(fails, c, "D", blocks)[list(c)].min() for c in subsets])
    answer = Design.from_blocks(fails).select(5, Worst("D"), "exact")
    assert answer.proven and answer.value == pytest.approx(each.max(), rel=1e-9)
    assert answer.indices.tolist() == list(subsets[each.argmax()])


def test_what_is_left_without_each_is_that_of_the_scenario_that_loses_most() -> None:
    blocks = np.random.default_rng(7).standard_normal((3, 8, 1, 3))
    answer = Design.from_blocks(blocks).select(5, Mean("D"))
    chosen = answer.indices.tolist()
    rest = [phi(blocks, [j for j in chosen if j != i], "D", blocks) for i in chosen]
    shares = np.exp(np.array(rest) - phi(blocks, chosen, "D", blocks)).min(axis=1)
    np.testing.assert_allclose(answer.left_without, shares, rtol=1e-9)


@pytest.mark.parametrize("name", "DA")
def test_many_scenarios_are_brute_force_too(name) -> None:
    """Twenty, of which the search looks at the curvature of some at a time."""
    blocks = np.random.default_rng(ord(name)).standard_normal((20, 12, 1, 3))
    subsets = list(itertools.combinations(range(12), 4))
    each = np.array([phi(blocks, c, name, blocks) for c in subsets])
    for criterion in (Mean(name), Worst(name)):
        worth = joined(each, np.full(20, 0.05), criterion, name)
        answer = Design.from_blocks(blocks).select(4, criterion, "exact")
        assert answer.proven and answer.nodes > 1
        assert answer.indices.tolist() == list(subsets[worth.argmax()])


def test_rules_hold_and_the_best_within_them_is_found() -> None:
    """Masks, must-keep, replicates, what was measured, a prior: against brute force."""
    rng = np.random.default_rng(5)
    blocks, seen = rng.standard_normal((3, 6, 1, 3)), rng.standard_normal((3, 2, 1, 3))
    prior, available = np.diag([0.1, 0.0, 0.2]), [1, 1, 0, 1, 1, 1]
    design = Design.from_blocks(
        blocks, prior, measured=seen, available=available, required=[4],
        max_replicates=2,
    )  # fmt: skip
    known = prior + np.einsum("snqa,snqb->sab", seen, seen)
    best: dict[str, tuple[float, list[int]]] = {}
    for chosen in itertools.combinations_with_replacement([0, 1, 3, 4, 5], 3):
        if 4 in chosen and max(np.bincount(chosen)) <= 2:
            some = blocks[:, chosen]
            both = known + np.einsum("snqa,snqb->sab", some, some)
            value = np.linalg.slogdet(both)[1]
            for name, worth in (("mean", value.mean()), ("worst", value.min())):
                if name not in best or worth > best[name][0]:
                    best[name] = worth, list(chosen)
    for name, criterion in (("mean", "D"), ("worst", Worst("D"))):
        answer = design.select(3, criterion, "exact")
        assert answer.proven and sorted(answer.indices.tolist()) == best[name][1]
        assert answer.value == pytest.approx(best[name][0], rel=1e-10)


@pytest.mark.parametrize("name", "DAIE")
def test_one_scenario_changes_nothing(name) -> None:
    rng = np.random.default_rng(3)
    blocks = rng.standard_normal((20, 2, 4))
    plain = Design.from_blocks(blocks)
    for one in (blocks[None], np.stack([blocks, blocks])):
        for criterion in (Mean(name), Worst(name)):
            assert repr(criterion).endswith(f"({name!r})")
            answer = Design.from_blocks(one).select(4, criterion)
            same = plain.select(4, name)
            assert answer.indices.tolist() == same.indices.tolist()
            assert answer.value == same.value and answer.bound == same.bound
            assert answer.criterion == name


def test_the_published_design_of_michaelis_and_menten() -> None:
    """{.268, 5}, log det 12.655 with V n / (2 std^2) = 800, on a grid of .001."""
    x = np.linspace(0.001, 5.0, 5000)[:, None]
    one = Design(x, MichaelisMenten(), prior=Prior(np.inf)).select(2, "D", "exact")
    assert np.allclose(x[one.indices, 0], [0.268, 5.0]) and one.proven
    assert one.log_det + 2.0 * np.log(800.0) == pytest.approx(12.655, abs=5e-4)


def test_a_worst_case_design_pays_at_the_nominal_and_is_worth_it_elsewhere() -> None:
    x = np.linspace(0.05, 5.0, 60)[:, None]
    ks = np.array([[1.0, 0.03], [1.0, 0.3], [1.0, 3.0]])
    design = Design(x, MichaelisMenten(), prior=Prior(np.inf), scenarios=ks)
    answer = design.select(3, Worst("D", efficiency=True), "exact")
    assert answer.proven and isinstance(answer.problem, ScenarioProblem)
    report = answer.in_scenarios
    jacobian = np.stack([MichaelisMenten().jacobian(x, k) for k in ks])
    subsets = list(itertools.combinations(range(0, 60), 3))
    assert report.proven.all()
    assert report.least == pytest.approx(answer.value, rel=1e-9)
    some = jacobian[:, np.array(subsets)]  # (S, N, 3, 1, 2)
    information = np.einsum("snkqa,snkqb->snab", some, some)
    log_det = np.linalg.slogdet(information)[1]
    best = log_det.max(axis=1)
    shares = np.exp((log_det - best[:, None]) / 2.0)
    worth = shares.min(axis=0).max()
    assert answer.value == pytest.approx(worth, rel=1e-3)
    nominal = shares[:, log_det[1].argmax()]
    np.testing.assert_allclose(report.nominal_efficiencies, nominal, rtol=2e-3)
    assert report.least > 1.2 * nominal.min()
    text = str(answer)
    assert "scenarios     3" in text and "nominal's" in text
    assert len(str(report).splitlines()) == 3
    assert answer.to_dict()["in_scenarios"]["efficiencies"][0] > 0.0


def test_scenarios_of_a_number_are_drawn_from_the_prior() -> None:
    x = np.linspace(0.05, 5.0, 30)[:, None]
    prior = Prior({"V": 0.1, "K": 0.05})
    design = Design(x, MichaelisMenten(), prior, scenarios=6)
    again = Design(x, MichaelisMenten(), prior, scenarios=6)
    assert (design.scenarios.parameters == again.scenarios.parameters).all()
    by_hand = Design(x, MichaelisMenten(), prior, scenarios=design.scenarios.parameters)
    assert design.select(3).value == by_hand.select(3).value
    short = select(x, 3, model=MichaelisMenten(), prior=prior, scenarios=6)
    assert short.value == by_hand.select(3).value
    # What is linear in its parameters is one problem, whatever they are.
    affine = Design(x, Affine(1, 1), scenarios=np.ones((3, 2)))
    assert affine.select(2).criterion == "D"


@pytest.mark.parametrize(
    ("scenarios", "says"),
    [
        (np.ones((3, 3)), "scenarios must have shape"),
        (4, "finite std"),
        (0, "scenarios must be"),
        ((np.ones((2, 2)), [0.5, 0.6]), "weights must sum to 1"),
        ((np.ones((2, 2)), [1.5, -0.5]), "weights must be positive"),
        ((np.ones((2, 2)), [1.0]), "weights must have shape"),
        ([[1.0, np.nan]], "finite"),
        ([[1.0, 0.3], [0.0, 0.3]], "in scenario 1: "),
    ],
)
def test_bad_scenarios_are_named(scenarios, says) -> None:
    x = np.linspace(0.05, 5.0, 10)[:, None]
    with pytest.raises(ValueError, match=says):
        Design(x, MichaelisMenten(), Prior(np.inf), scenarios=scenarios).select(2)


def test_the_fewest_by_default_identify_in_every_scenario() -> None:
    """Two readings tell the same in one scenario, and two things in the other."""
    blocks = np.random.default_rng(0).standard_normal((2, 9, 2, 4))
    blocks[1, :, 1] = blocks[1, :, 0]
    answer = Design.from_blocks(blocks).select()
    assert len(answer.indices) == 4 and np.isfinite(answer.log_det)
    exact = Design.from_blocks(blocks).score(answer.indices, reference="exact")
    assert exact.efficiency >= answer.efficiency - 1e-9


def test_units_beyond_double_precision_are_refused_by_name() -> None:
    blocks = np.random.default_rng(0).standard_normal((2, 6, 1, 3)) * 1e200
    with pytest.raises(
        ValueError, match=r"criterion Mean.A. in a scenario is out of range in dou"
    ):
        Design.from_blocks(blocks).select(4, "A")
    assert Design.from_blocks(blocks * 1e-300).select(4, "D").proven


def test_bad_blocks_of_scenarios_are_named() -> None:
    blocks = np.random.default_rng(0).standard_normal((2, 6, 1, 3))
    with pytest.raises(ValueError, match="weights need blocks"):
        Design.from_blocks(blocks[0], weights=[1.0])
    with pytest.raises(ValueError, match="measured must have shape"):
        Design.from_blocks(blocks, measured=blocks[0]).select(3)
    with pytest.raises(ValueError, match="criterion of one scenario"):
        Mean(Worst("D"))
    blocks[1, :, :, 2] = 0.0
    with pytest.raises(ValueError, match="in scenario 1: blocks must inform every"):
        Design.from_blocks(blocks).select(3)


def test_the_smallest_plan_holds_in_every_scenario() -> None:
    """Against all subsets: the largest variance at the candidates, in any scenario."""
    rng = np.random.default_rng(2)
    blocks = rng.standard_normal((3, 7, 1, 3))
    worst = {}
    for k in range(3, 8):
        for chosen in itertools.combinations(range(7), k):
            some = blocks[:, chosen]
            inverse = np.linalg.inv(np.einsum("snqa,snqb->sab", some, some))
            variance = np.einsum("smqa,sab,smqb->sm", blocks, inverse, blocks)
            worst[k] = min(worst.get(k, np.inf), np.sqrt(variance.max()))
    design = Design.from_blocks(blocks)
    for k in (4, 5):
        plan = design.plan(worst[k] * 1.0001)
        assert plan.k == k
        for row in plan.rows:
            assert row.least_error.max() <= worst[row.k] * (1.0 + 1e-9)
            assert row.standard_error.max() >= worst[row.k] * (1.0 - 1e-9)
