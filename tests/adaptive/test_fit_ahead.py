"""Constants found by simulating a task, and what is said of tasks beyond the tests."""

import jax
import numpy as np
import pytest

from benchmarks.sequential.family.draws import draw
from benchmarks.sequential.family.structures import Limits
from jaxcal.adaptive import fit_ahead, next_measurement
from jaxcal.adaptive.episodes import compare
from jaxcal.adaptive.fit_ahead import fit, outside
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.lookahead import AHEAD
from jaxcal.adaptive.rules import SHARES, Gain
from jaxcal.adaptive.tasks.knee import knee


@pytest.fixture(scope="module", params=[True, False], ids=["overrun", "hard"])
def task(request):
    limits = Limits(64, 24, 3, measurements=8)
    return jax.device_get(
        draw(21, "thresholds", "time+uses", limits, overrun=request.param)
    )


def of(task):
    return fit_ahead._Task(
        "", task, np.asarray(task.seconds), np.asarray(task.num_uses)
    )


def test_the_kernels_sessions_are_those_of_the_other_simulator(task):
    gains, chosen = of(task).play(AHEAD, 1024, 5)
    found = compare(task, {"ahead": AHEAD}, 1024, seed=5)
    mean, error = found.mean("ahead")
    mine = gains.sum(axis=1)
    spread = np.hypot(error, mine.std() / 32.0)
    assert abs(mine.mean() - mean) < 4.0 * spread
    made = (chosen >= 0).sum(axis=1)
    assert abs(made.mean() - found.choices.mean()) < 0.3
    assert (gains[chosen < 0] == 0.0).all() and chosen.max() < len(task.designs)
    # A session is not interrupted by measurements that were not made.
    assert (np.diff((chosen >= 0).astype(int), axis=1) <= 0).all()


def test_the_same_task_and_budget_have_the_same_constants(task):
    one, same = fit(task, 9.0, 1), fit(task, 9.0, 1)
    fit_ahead._fit.cache_clear()
    again = fit(task, 9.0, 1)
    assert one is same
    assert one.nats == again.nats and one.more == again.more
    chosen = [of(task).play(f.decider, 64, 3)[1] for f in (one, again)]
    np.testing.assert_array_equal(*chosen)


def test_the_rule_decides_where_the_tree_loses(task, monkeypatch):
    rng = np.random.default_rng(0)

    def play(self, decider, count, seed):
        nats = 1.0 + (decider.effort == 0.0) + 0.1 * rng.random((count, 1))
        return nats, np.zeros((count, 1), np.int32)

    monkeypatch.setattr(fit_ahead._Task, "play", play)
    fit_ahead._fit.cache_clear()
    found = fit(task)
    fit_ahead._fit.cache_clear()
    assert found.decider is SHARES and found.more == 0.0 and found.nats > 1.9


def test_what_lies_beyond_the_tests_is_named():
    assert outside(knee(8)) == ()
    assert outside(knee()) == ("62 designs, tested up to 48",)
    many = GridTask.make(
        np.arange(1100.0), np.arange(3.0), np.full((3, 5, 1100), 0.2), uses=1,
        num_uses=[2, 7], horizon=40, groups=[0, 4, 1],
    )  # fmt: skip
    assert outside(many) == (
        "1,100 states, tested up to 1,024", "5 outcomes, tested up to 4",
        "7 uses, tested up to 5", "40 measurements, tested up to 32",
        "5 groups, tested up to 4",
    )  # fmt: skip
    few = GridTask.make(
        np.arange(8.0), np.arange(3.0), np.full((3, 5, 8), 0.2), uses=1, horizon=2
    )
    assert next_measurement(few).outside == ("5 outcomes, tested up to 4",)
    assert next_measurement(few, decider=Gain()).outside == ()


@pytest.mark.slow
def test_what_is_fitted_gains_on_sessions_that_it_never_saw():
    limits = Limits(512, 48, 4, measurements=32)
    hard = draw(2 * 10**7 + 10, "band", "time+uses+number", limits)
    deciders = {"fitted": fit(hard).decider, "ahead": AHEAD, "shares": SHARES}
    found = compare(hard, jax.tree.map(np.asarray, deciders), 1024, seed=11, batch=256)
    more, error = found.paired("fitted", "ahead")
    assert more > 2.0 * error
    assert found.paired("fitted", "shares")[0] > 0.2
