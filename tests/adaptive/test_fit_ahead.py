"""Constants found by simulating a task."""

import jax
import numpy as np
import pytest

from benchmarks.sequential.family.draws import draw
from benchmarks.sequential.family.structures import Limits
from jaxcal.adaptive import lookahead
from jaxcal.adaptive.episodes import compare
from jaxcal.adaptive.lookahead import AHEAD, fit
from jaxcal.adaptive.rules import SHARES


@pytest.fixture(scope="module", params=[True, False], ids=["overrun", "hard"])
def task(request):
    limits = Limits(64, 24, 3, measurements=8)
    return jax.device_get(
        draw(21, "thresholds", "time+uses", limits, overrun=request.param)
    )


def of(task):
    return lookahead._Task(
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
    lookahead._fit.cache_clear()
    again = fit(task, 9.0, 1)
    assert one is same
    chosen = [of(task).play(decider, 64, 3)[1] for decider in (one, again)]
    np.testing.assert_array_equal(*chosen)


def test_the_rule_decides_where_the_tree_loses(task, monkeypatch):
    rng = np.random.default_rng(0)

    def play(self, decider, count, seed):
        nats = 1.0 + (decider.effort == 0.0) + 0.1 * rng.random((count, 1))
        return nats, np.zeros((count, 1), np.int32)

    monkeypatch.setattr(lookahead._Task, "play", play)
    lookahead._fit.cache_clear()
    found = fit(task)
    lookahead._fit.cache_clear()
    assert found is SHARES


@pytest.mark.slow
def test_what_is_fitted_gains_on_sessions_that_it_never_saw():
    limits = Limits(512, 48, 4, measurements=32)
    hard = draw(2 * 10**7 + 10, "band", "time+uses+number", limits)
    deciders = {"fitted": fit(hard), "ahead": AHEAD, "shares": SHARES}
    found = compare(hard, jax.tree.map(np.asarray, deciders), 1024, seed=11, batch=256)
    more, error = found.paired("fitted", "ahead")
    assert more > 2.0 * error
    assert found.paired("fitted", "shares")[0] > 0.2
