"""The tree of the next measurements, against every tree there is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from benchmarks.sequential.family.draws import draw
from benchmarks.sequential.family.padded import pad
from benchmarks.sequential.family.structures import Limits
from benchmarks.sequential.optimum import solve
from jaxcal.adaptive import lookahead
from jaxcal.adaptive.episodes import compare
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.lookahead import Ahead
from jaxcal.adaptive.rules import SHARES
from jaxcal.adaptive.tasks.knee import knee

choose = jax.jit(
    lambda task, decider, belief, session: decider(
        task, belief, session, task.options(belief, session), jax.random.key(0)
    )
)
WHOLE = Ahead(effort=1e9)


def values(task, weights, place, seconds, uses, made):
    """(A,) nats of a measurement and the best of all that may follow, by recursion.

    Without overrun, one of which some outcome cannot be paid is worth nothing.
    """
    if seconds <= 0 or uses <= 0 or made >= task.horizon:
        return np.zeros(len(task.designs))
    table = np.asarray(task.likelihood, np.float64)
    chances = table @ weights
    gains = (
        special.entr(chances).sum(axis=1) - special.entr(table).sum(axis=1) @ weights
    )
    for a, y in np.ndindex(chances.shape):
        left = seconds - float(task.travel[place, a]) - float(task.extra[a, y])
        more = uses - int(task.uses[a, y])
        if table[a, y].any() and not task.overrun and (left < -1e-4 or more < 0):
            gains[a] = -np.inf
        if chances[a, y] > 0:
            then = weights * table[a, y] / chances[a, y]
            at = int(task.place_after[a, y])
            gains[a] += (
                chances[a, y] * values(task, then, at, left, more, made + 1).max()
            )
    return np.maximum(gains, 0.0)


def random_task(seed, designs, outcomes, horizon, overrun):
    """Noise, travel, extra seconds and uses of all sizes; 8 values of theta."""
    rng = np.random.default_rng(seed)
    return GridTask.make(
        np.arange(8.0), np.arange(designs, dtype=float),
        rng.dirichlet(np.full(outcomes, 0.3), (designs, 8)).transpose(0, 2, 1),
        prior=rng.dirichlet(np.ones(8)),
        travel=rng.uniform(0.2, 2.0, (designs + 1, designs)),
        extra=rng.uniform(0.0, 1.0, (designs, outcomes)),
        uses=rng.integers(0, 2, (designs, outcomes)),
        seconds=rng.uniform(1.0, 6.0) + 1.5 * (not overrun),
        num_uses=int(rng.integers(1, 4)), horizon=horizon, overrun=overrun,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("designs", "outcomes", "horizon"), [(6, 2, 2), (4, 3, 2), (6, 2, 1), (2, 2, 4)]
)
@pytest.mark.parametrize("overrun", [True, False])
def test_what_ends_within_the_tree_is_decided_as_by_all_trees(
    designs, outcomes, horizon, overrun
):
    for seed in range(4):
        task = random_task(seed, designs, outcomes, horizon, overrun)
        belief, session = task.begin(jax.random.key(0))
        chosen = int(choose(task, WHOLE, belief, session))
        weights = np.asarray(task.prior, np.float64)
        worth = values(
            task, weights, int(task.place), float(session.seconds), int(session.uses), 0
        )
        assert worth[chosen] == pytest.approx(worth.max(), abs=2e-5)


@pytest.mark.slow
def test_nearly_the_optimum_where_it_is_known():
    task = knee(5, sigma=1e-9, slip=0.0, seconds=(4.0, 12.0), trips=(1, 2))
    best = solve(task, 0.2)
    found = compare(task, {"ahead": Ahead(), "shares": SHARES}, 1024, seed=3)
    mean, error = found.mean("ahead")
    assert mean > 0.99 * best.mean - 3.0 * error
    assert mean < best.mean + 4.0 * error
    assert found.paired("ahead", "shares")[0] > 0.01


def test_other_kinds_are_decided_as_by_shares_and_a_batch_of_tasks_is_refused():
    limits = Limits(64, 24, 4, measurements=12)
    padded = jax.tree.map(jnp.asarray, pad(draw(1, limits=limits), limits))
    belief, session = padded.begin(jax.random.key(0))
    chosen = choose(padded, WHOLE, belief, session)
    assert int(chosen) == int(choose(padded, SHARES, belief, session))
    task = random_task(0, 4, 2, 3, True)
    both = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), task)
    keys = jax.random.split(jax.random.key(0), 2)
    begun = jax.vmap(lambda task, key: choose(task, WHOLE, *task.begin(key)))
    with pytest.raises((RuntimeError, ValueError), match="one task at a time"):
        begun(both, keys).block_until_ready()


@pytest.mark.parametrize("overrun", [True, False])
def test_one_tree_serves_the_sessions_of_a_batch(monkeypatch, overrun):
    """Making it takes thirty times as long as a choice."""
    made = []
    tree = lookahead.tree
    monkeypatch.setattr(lookahead, "tree", lambda *of: made.append(1) or tree(*of))
    task = random_task(0, 4, 2, 3, overrun)

    @jax.jit
    def first(task, keys):
        def one(key):
            belief, session = task.begin(key)
            options = task.options(belief, session)
            return Ahead()(task, belief, session, options, key)

        return jax.vmap(one)(keys)

    first(task, jax.random.split(jax.random.key(0), 16)).block_until_ready()
    assert len(made) == 1
