"""Every decider on tasks that none of them was written for."""

import pathlib

import jax
import numpy as np
import pytest
from flax import struct
from scipy import stats

import jaxcal
from benchmarks.sequential.deciders import Rollouts, TwoStep
from benchmarks.sequential.sequence import Static
from jaxcal.adaptive.grid import GridBelief, GridTask
from jaxcal.adaptive.history import after
from jaxcal.adaptive.policy.network import PolicyDecider, initial
from jaxcal.adaptive.rules import Gain, GainRate, Priced, Random, StateRule
from jaxcal.adaptive.session import _classes, jit_by_class

RULE = StateRule(0.1, 1.0, 1.0)


def three_joints():
    """Three joints, three outcomes, nothing countable; one design tells nothing."""
    axes = np.arange(3.0), np.arange(4.0), np.arange(2.0)
    theta = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    # What each design depends on: one coordinate, two of them, or none.
    seen = [theta[:, 1], theta[:, 0], theta[:, 0] + 5 * theta[:, 2], 0 * theta[:, 0]]
    seen += [theta[:, 1] % 2, theta[:, 2]]
    rng = np.random.default_rng(1)
    tables = rng.dirichlet(np.ones(3), size=(6, 8)).transpose(0, 2, 1)
    table = [t[:, s.astype(int)] for t, s in zip(tables, seen, strict=True)]
    return GridTask.make(
        theta,
        rng.normal(size=(6, 2)),
        np.stack(table),
        prior=rng.uniform(size=24),
        groups=[0, 1, 1, 2, 0, 2],
        travel=rng.uniform(0.5, 3, (7, 6)),
        extra=[0.0, 2.0, 0.3],
        seconds=(4.0, 9.0),
        horizon=12,
    )


def no_clock():
    """Unknowns that are no grid, uneven uses, a place of its own, no limit of time."""
    rng = np.random.default_rng(0)
    return GridTask.make(
        rng.normal(size=(5, 2)),
        rng.normal(size=(4, 1)),
        rng.dirichlet(np.ones(3), size=(4, 5)).transpose(0, 2, 1),
        travel=rng.uniform(1, 3, (6, 4)),
        place_after=np.full((4, 3), 5),
        uses=[0, 1, 2],
        num_uses=4,
        horizon=6,
    )


@pytest.fixture(params=[three_joints, no_clock])
def task(request):
    return request.param()


def test_gains_are_those_of_the_whole_table(task):
    rng = np.random.default_rng(2)
    weights = rng.dirichlet(np.ones(len(task.prior)))
    table = np.asarray(task.likelihood, np.float64)
    wanted = stats.entropy(table @ weights, axis=1)
    wanted -= stats.entropy(table, axis=1) @ weights
    belief = GridBelief(weights.astype(np.float32))
    found = jax.jit(GridBelief.gains)(belief, task, None)
    np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_entropies_after_are_of_what_a_design_depends_on():
    task = three_joints()
    weights = np.random.default_rng(3).dirichlet(np.ones(24)).astype(np.float32)
    found = np.asarray(jax.jit(GridBelief.entropies_after)(GridBelief(weights), task))
    for design, axes in ((0, (0, 2)), (1, (1, 2)), (2, (1,)), (3, (0, 1, 2))):
        table = np.asarray(task.likelihood)[design]
        after = (weights * table).reshape(3, 3, 4, 2).sum(tuple(1 + i for i in axes))
        wanted = stats.entropy(after.reshape(3, -1), axis=1)
        np.testing.assert_allclose(found[design], wanted, atol=1e-5)


def chosen(task, deciders):
    """What each picks after one measurement; one program."""

    @jax.jit
    def choose(task, deciders, key):
        belief = GridBelief(task.prior).update(task, 1, 2)
        session = task.spend(task.session(7.0, 4), 1, 2)
        options = task.options(belief, session)
        return options.allowed, {
            name: decider(task, belief, session, options, key)
            for name, decider in deciders.items()
        }

    allowed, found = choose(task, deciders, jax.random.key(3))
    assert all(0 <= int(index) < len(task.designs) for index in found.values())
    assert all(allowed[index] for index in found.values())
    return found


def policy(task):
    begun = jax.jit(initial, static_argnums=(1, 2, 3))
    return PolicyDecider(begun(jax.random.key(0), 4, task.num_groups, 8), RULE, 4, 8)


def test_a_policy_begins_as_its_rule():
    task = three_joints()
    found = chosen(task, {"state": RULE, "policy": policy(task)})
    assert found["policy"] == found["state"]


@pytest.mark.slow
def test_all_deciders_run_unchanged(task):
    found = chosen(
        task,
        {
            "random": Random(),
            "gain": Gain(),
            "rate": GainRate(),
            "priced": Priced(0.1, 1.0, 1.0),
            "state": RULE,
            "two_step": TwoStep(RULE, per_group=2),
            "rollouts": Rollouts(RULE, rollouts=2, depth=3, per_group=2),
            "static": Static((3, 0)),
            "policy": policy(task),
        },
    )
    assert len(found) == 9
    assert found["policy"] == found["state"]  # a policy begins as its rule


def named(of_class=(), fields=(), **methods):
    """A pytree of a class of its own, which always has the same name."""
    kind = type("Named", (), {**methods, "__annotations__": dict.fromkeys(fields, int)})
    return struct.dataclass(kind)(*of_class)


@pytest.mark.parametrize("fields", [(), ("at",)])
def test_a_compiled_function_is_told_every_class(fields):
    """Those of a model within a task too, in lists, and where all have a field."""
    values = [0.0] * len(fields)
    classes = {
        _classes(jax.tree.structure(([named(values, fields)], 1))) for _ in range(200)
    }
    assert len(classes) == 200


def test_what_is_compiled_for_tasks_is_told_their_classes():
    package = pathlib.Path(jaxcal.__file__).parent
    files = [*package.glob("adaptive/**/*.py"), *package.glob("evaluation/**/*.py")]
    plain = [file.name for file in files if "jax.jit(" in file.read_text()]
    assert len(files) > 20 and plain == ["session.py"]
    assert not any("@jax.jit" in file.read_text() for file in files)


def decide(number):
    decider = named(__call__=lambda self, at: at + number)
    return _decided(decider, 0)


_decided = jit_by_class(lambda decider, at: decider(at))


def update(number):
    """Its task's model says how long the measurement took."""
    task = named(
        [named(cost=lambda self: number)], ["model"],
        spend=lambda self, session, design, outcome: session + self.model.cost(),
    )  # fmt: skip
    belief = named(update=lambda self, task, design, outcome, key: self)
    return after(task, belief, 0, 0, 0, 0)[1]


@pytest.mark.slow
@pytest.mark.parametrize("compiled", [decide, update])
def test_classes_of_the_same_structure_are_not_mixed_up(compiled):
    """``jax.jit`` itself ran another class for three to seven of these forty."""
    assert [int(compiled(n)) for n in range(40)] == list(range(40))
