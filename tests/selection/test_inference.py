"""The policy without JAX against the policy in JAX, and what a rig relies on."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.extras import MissingExtraError
from jaxcal.learning.config import NetworkConfig
from jaxcal.learning.core.network import build
from jaxcal.learning.environments.selection import SelectionConfig
from jaxcal.learning.policies import scorer
from jaxcal.learning.runtime import weights
from jaxcal.learning.training import checkpoint
from jaxcal.selection.policy import select_batch
from jaxcal.selection.policy.by_checkpoint import CompactScorer
from jaxcal.selection.policy.policy_kernel import look_ahead
from jaxcal.selection.problem import make_problems


def drawn(rng, sets, m, n, k, masked=0.0, required=0):
    """Random problems, and their candidates, mask and required postures."""
    candidates = rng.uniform(size=(sets, m, n))
    available = rng.uniform(size=(sets, m)) >= masked
    available[:, : k + 1] = True
    kept = rng.permuted(np.tile(np.arange(k), (sets, 1)), axis=1)[:, :required]
    given = {"available": available, "required": kept}
    return make_problems(candidates, k, **given), candidates, available, kept


def whitened(problems):
    """(B, M, n) what JAX is given: it whitens again."""
    return np.stack([p.rows[:, :-1] * np.sqrt(p.available.sum()) for p in problems])


def drawn_parameters(network, *call):
    """Random weights; flax's own initialisation compiles for seconds."""
    shapes = jax.eval_shape(network.init, jax.random.key(0), *call)["params"]
    rng = np.random.default_rng(1)
    return jax.tree.map(
        lambda leaf: (0.3 * rng.normal(size=leaf.shape)).astype(np.float32), shapes
    )


SHAPES = [  # M, n, k, masked, required, decoding
    (16, 3, 6, 0.3, 2, "greedy"),
    *(
        pytest.param(*shape, marks=pytest.mark.slow)
        for shape in (
            (12, 2, 3, 0.2, 0, "first"),
            (20, 3, 4, 0.0, 0, "greedy"),
            (50, 3, 4, 0.0, 0, "greedy"),
            (50, 3, 12, 0.0, 0, "greedy"),
            (30, 4, 7, 0.2, 1, "first"),
            (30, 5, 6, 0.2, 0, "greedy"),
            (30, 6, 8, 0.0, 0, "greedy"),
            (1100, 3, 4, 0.0, 0, "greedy"),
        )
    ),
]


@pytest.mark.parametrize(("m", "n", "k", "masked", "required", "how"), SHAPES)
def test_the_picks_are_those_of_jax(rng, m, n, k, masked, required, how):
    number = 20 if m > 1000 else 200
    problems, sets, available, kept = drawn(rng, number, m, n, k, masked, required)
    policy = checkpoint.load()
    with jax.enable_x64(True):  # in float32 it picks another of two near ties
        double = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), policy.params)
        expected = scorer.choose(
            policy.network,
            double,
            whitened(problems),
            available,
            kept,
            k=k,
            decoding=how,
            num=4,
        )
    found = select_batch(
        sets, k, available=available, required=kept, decoding=how, num=4
    )
    np.testing.assert_array_equal(found[:, :required], kept)
    # The last two are one pair: rounding decides which of them is named first.
    np.testing.assert_array_equal(np.sort(found), np.sort(expected))


VARIANTS = [
    None,  # the one that ships
    NetworkConfig(width=8, encoder_rounds=1, decoder_rounds=2),
    NetworkConfig(width=8, encoder_rounds=0, lookahead=2),
]


@pytest.mark.parametrize(
    ("config", "n", "k", "made"),
    [
        (VARIANTS[0], 3, 6, 2),
        pytest.param(VARIANTS[0], 3, 6, 4, marks=pytest.mark.slow),
        (VARIANTS[1], 2, 3, 0),
        (VARIANTS[2], 2, 3, 0),
    ],
)
def test_the_scores_are_those_of_jax_in_double_precision(rng, config, n, k, made):
    problems, _, available, _ = drawn(rng, 5, 14, n, k, masked=0.3)
    if config is None:
        held = checkpoint.load()
        config, params = held.network.config, held.params
    else:
        points = jnp.zeros((1, 14, n)), jnp.ones((1, 14), bool)
        chosen = jnp.full((1, k), -1)
        params = drawn_parameters(build(config), *points, chosen)
    network = build(config)
    chosen = np.full((5, k), -1)
    chosen[:, :made] = np.arange(made)
    free = available.copy()
    free[:, :made] = False

    with jax.enable_x64(True):
        double = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), params)
        points = whitened(problems)
        regressors = np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)
        theirs = scorer.NetworkScorer(network, double)
        memory = theirs.encode(regressors, available)
        logits = theirs.scores(memory, chosen, free, made)
    arrays = checkpoint.as_weights(params, {"network": {}}).arrays
    ours = CompactScorer(dataclasses.asdict(config), arrays)
    own = ours.encode(np.stack([p.rows for p in problems]), available)
    np.testing.assert_allclose(own.encoded, memory[1], rtol=1e-4, atol=1e-4)
    scores = ours.scores(own, chosen, free, made)
    assert np.isneginf(scores[~free]).all()
    np.testing.assert_allclose(
        scores[free], np.asarray(logits)[free], rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("spanned", [True, False])
def test_the_look_ahead_is_greedy_choice_by_determinants(rng, spanned):
    p, m, depth = 4, 9, 4
    y = rng.normal(size=(p, m))
    active = np.arange(m) != 3
    y[:, ~active] = 0.0
    values = np.empty((4, m))
    look_ahead(y, active, spanned, depth, False, values)

    def log_volume(subset):
        gram = y[:, subset].T @ y[:, subset] + spanned * np.eye(len(subset))
        return np.linalg.slogdet(gram)[1]

    for i in np.flatnonzero(active):
        subset = [i]
        for d in range(depth):
            assert values[d, i] == pytest.approx(log_volume(subset), abs=1e-9)
            rest = [j for j in np.flatnonzero(active) if j not in subset]
            subset.append(max(rest, key=lambda j: log_volume([*subset, j])))
    assert (values[:, 3] == -30.0).all()


def test_of_many_candidates_the_512_of_largest_gain_are_starts(rng):
    y = rng.normal(size=(4, 1100))
    values = np.empty((4, 1100))
    look_ahead(y, np.ones(1100, bool), False, 2, False, values)
    started = values[1] > -30.0
    assert started.sum() == 512
    square = (y**2).sum(axis=0)
    assert square[started].min() > square[~started].max()


def test_what_is_chosen_depends_on_no_other_set(rng):
    sets = rng.uniform(size=(60, 20, 3))
    np.testing.assert_array_equal(
        select_batch(sets, 4),
        np.concatenate([select_batch(one[None], 4) for one in sets]),
    )
    drawn = select_batch(sets, 6, decoding="samples", num=2, seed=3)
    first = select_batch(sets[:1], 6, decoding="samples", num=2, seed=3)
    np.testing.assert_array_equal(drawn[:1], first)
    again = select_batch(sets, 6, decoding="samples", num=2, seed=3)
    np.testing.assert_array_equal(drawn, again)
    assert (drawn != select_batch(sets, 6, decoding="samples", num=2, seed=4)).any()


def test_weights_that_were_replaced_are_read_again(rng, tmp_path):
    path = tmp_path / "policy.npz"
    shutil.copy(weights.shipped(), path)
    sets = rng.uniform(size=(30, 20, 3))
    before = select_batch(sets, 6, checkpoint=path)
    held = weights.read(path)
    held.arrays["trust"] = np.float32(-1.0)  # away from the look-ahead
    weights.write(path, held)
    assert (select_batch(sets, 6, checkpoint=path) != before).any()


def test_a_runs_folder_gives_the_same_answer_as_its_policy_alone(
    rng, tmp_path, monkeypatch
):
    shipped = checkpoint.load()
    for name in ("run", "other"):
        checkpoint.save(tmp_path / name, 1, shipped.params, shipped.meta)
    sets = rng.uniform(size=(10, 20, 3))
    np.testing.assert_array_equal(
        select_batch(sets, 4, checkpoint=tmp_path / "run"), select_batch(sets, 4)
    )
    monkeypatch.delitem(sys.modules, "jaxcal.learning.training.checkpoint")
    monkeypatch.delattr(sys.modules["jaxcal.learning.training"], "checkpoint")
    monkeypatch.setitem(sys.modules, "orbax", None)
    monkeypatch.setitem(sys.modules, "orbax.checkpoint", None)
    with pytest.raises(MissingExtraError, match=r"training run.*\[policy\]"):
        select_batch(sets, 4, checkpoint=tmp_path / "other")


@pytest.fixture(scope="module")
def papers(tmp_path_factory):
    """A checkpoint of the paper's network, not trained."""
    config = NetworkConfig(kind="paper", width=16)
    network = build(config)
    points = jnp.zeros((1, 10, 3)), jnp.ones((1, 10), bool), jnp.full((1, 4), -1)
    params = drawn_parameters(network, *points)
    environment = dataclasses.asdict(SelectionConfig(num_candidates=10))
    folder = tmp_path_factory.mktemp("paper")
    meta = {
        "network": dataclasses.asdict(config),
        "tasks": [{"environment": environment}],
    }
    checkpoint.save(folder, 1, params, meta)
    return folder


def test_a_papers_pick_depends_on_no_other_set(rng, papers):
    inside = rng.uniform(0.3, 0.6, size=(7, 10, 3))
    outside = 100.0 * rng.uniform(size=(1, 10, 3))
    settings = dict(jax.config.values)
    alone = select_batch(inside, 4, checkpoint=papers)
    mixed = select_batch(np.concatenate([inside, outside]), 4, checkpoint=papers)
    np.testing.assert_array_equal(mixed[:7], alone)
    assert dict(jax.config.values) == settings  # the caller's own


def test_deciding_needs_no_jax():
    code = (
        "import json, sys, numpy as np, jaxcal\n"
        "points = np.random.default_rng(0).random((30, 3))\n"
        "chosen = jaxcal.select(points, 4, 'policy').indices.tolist()\n"
        "heavy = {'jax', 'flax', 'orbax', 'optax'} & set(sys.modules)\n"
        "print(json.dumps([chosen, sorted(heavy)]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    points = np.random.default_rng(0).random((1, 30, 3))
    assert json.loads(done.stdout) == [select_batch(points, 4)[0].tolist(), []]


@pytest.mark.slow
def test_commands_alone_have_jax_keep_compiled_code(tmp_path):
    code = (
        "import sys\n"
        "from jaxcal.learning.runtime import processes\n"
        "if 'late' in sys.argv: import jax\n"
        "processes.keep_compiled_programs()\n"
        "print('jax' in sys.modules)\n"
        "import jax\n"
        "print(jax.config.jax_compilation_cache_dir)"
    )
    environment = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    environment["XDG_CACHE_HOME"] = str(tmp_path)

    def run(*argv, **more):
        done = subprocess.run(
            [sys.executable, "-c", code, *argv],
            env=environment | more,
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout.split()

    ours = str(tmp_path / "jaxcal" / "jax")
    assert run() == ["False", ours]
    assert run("late") == ["True", ours]
    own = str(tmp_path / "own")
    assert run(JAX_COMPILATION_CACHE_DIR=own) == ["False", own]
