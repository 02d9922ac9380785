"""The benchmarks' peers compute the same thing as jaxcal. No timing is asserted."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.learning.config import NetworkConfig
from jaxcal.learning.core import network as networks
from jaxcal.learning.core.network import build
from jaxcal.learning.environments import selection as environment
from jaxcal.learning.environments.selection import SelectionConfig

CONFIG = SelectionConfig()
ACTIONS = np.array([[3, 17, 49, 8], [0, 1, 2, 40]])


def played_by_jaxcal(sets):
    """Observations (B, 5, 210) and rewards (B, 4) of the fixed actions."""

    def play(candidates, actions):
        state = environment.start(
            candidates, jnp.ones(50, bool), CONFIG, jax.random.key(0)
        )
        seen, paid = [environment.observe(state, CONFIG)], []
        for step in range(4):
            state, reward, _ = environment.step(state, actions[step], CONFIG)
            seen.append(environment.observe(state, CONFIG))
            paid.append(reward)
        return jnp.stack(seen), jnp.stack(paid)

    return jax.jit(jax.vmap(play))(jnp.asarray(sets), jnp.asarray(ACTIONS))


def peers_environments():
    pytest.importorskip("gymnasium", reason="the extra bench is not installed")
    from benchmarks.peers import environments

    return environments


def test_the_gymnasium_peer_sees_and_pays_the_same(rng):
    peers = peers_environments()
    sets = rng.random((2, 50, 3)).astype(np.float32)
    seen, paid = played_by_jaxcal(sets)
    for number, candidates in enumerate(sets):
        env = peers.SelectionGym()
        observation, _ = env.reset(seed=0, options={"candidates": candidates})
        np.testing.assert_allclose(observation, seen[number, 0], atol=1e-5)
        for step, action in enumerate(ACTIONS[number]):
            observation, reward, done, cut, _ = env.step(action)
            np.testing.assert_allclose(observation, seen[number, step + 1], atol=1e-5)
            np.testing.assert_allclose(reward, paid[number, step], atol=1e-4)
            assert done == (step == 3)
            assert not cut
            assert not env.action_masks()[action]


def test_the_numpy_peer_sees_and_pays_the_same(rng):
    peers = peers_environments()
    sets = rng.random((2, 50, 3)).astype(np.float32)
    seen, paid = played_by_jaxcal(sets)
    env = peers.SelectionNumpy(2)
    np.testing.assert_allclose(env.reset(sets), seen[:, 0], atol=1e-5)
    for step in range(4):
        observation, reward, done = env.step(ACTIONS[:, step])
        np.testing.assert_allclose(observation, seen[:, step + 1], atol=1e-5)
        np.testing.assert_allclose(reward, paid[:, step], atol=1e-4)
        assert done == (step == 3)


@pytest.mark.parametrize("folded", [False, True])
def test_the_pytorch_peer_has_the_same_network(rng, folded):
    torch = pytest.importorskip("torch", reason="the extra bench is not installed")
    from benchmarks.peers.torch_ppo import PaperTorch, context_of

    sets = jnp.asarray(rng.random((3, 50, 3)), jnp.float32)
    everything = jnp.ones((3, 50), bool)
    chosen = jnp.asarray([[3, 9, -1, -1]] * 3)
    free = everything.at[:, chosen[0, :2]].set(False)
    network = build(NetworkConfig(kind="paper", width=48))

    @jax.jit
    def scored(key):
        params = network.init(key, sets, everything, chosen)["params"]
        params = jax.tree.map(
            lambda leaf: leaf + 0.05 * jax.random.normal(key, leaf.shape), params
        )
        features = network.candidate_features(sets, everything)
        memory = networks.encode(network, params, features)
        decision = network.decision_features(features, chosen, free, 2)
        return params, networks.decode(network, params, memory, decision)

    params, (logits, value) = scored(jax.random.key(1))
    peer = PaperTorch(48, folded=folded)
    peer.load_flax(params)
    context = context_of(torch.tensor(np.asarray(sets[:, jnp.asarray([3, 9])])), 2)
    with torch.no_grad():
        other, worth = peer.decode(
            peer.encode(torch.tensor(np.asarray(sets))),
            context[:, None],
            torch.tensor(np.asarray(free))[:, None],
        )

    # A number that all candidates share changes no choice: compare log probabilities.
    def log_softmax(x):
        return np.asarray(jax.nn.log_softmax(jnp.asarray(x)))[np.asarray(free)]

    mine, theirs = log_softmax(logits), log_softmax(other[:, 0].numpy())
    np.testing.assert_allclose(mine, theirs, atol=2e-4)
    np.testing.assert_allclose(value, worth[:, 0].numpy(), atol=2e-4)


def test_random_actions_are_uniform_over_what_is_left():
    peers_environments()
    pytest.importorskip("brax", reason="the row steps loads brax")
    from benchmarks.rows.steps import random_action

    chosen = jnp.asarray([[7, 0, 49, -1]])
    units = (jnp.arange(47) + 0.5) / 47
    actions = random_action(jnp.tile(chosen, (47, 1)), 3, units)
    assert sorted(np.asarray(actions).tolist()) == sorted(set(range(50)) - {7, 0, 49})


@pytest.mark.parametrize(("quick", "said"), [(False, "MISSED"), (True, "not judged")])
def test_a_quick_run_is_not_judged(quick, said):
    from benchmarks import report
    from benchmarks.harness import Row, Verdict

    row = Row("training", "title", verdicts=[Verdict("against brax", None, 10.0)])
    shown = report.as_json(row) | {"quick": quick}
    assert said in report.text(shown)
    assert ("MISSED" in report.text(shown)) is not quick


def test_a_collective_that_begins_and_ends_apart_is_counted_once():
    from benchmarks.scaling import exchanged

    program = """
  %sum = (f32[3,4]{1,0}, f32[]) all-reduce(%a, %b), replica_groups={{0,1}}
  %begun = (f32[5]{0}, f32[10]{0}) all-gather-start(%c), dimensions={0}
  %all = f32[10]{0} all-gather-done(%begun)
  %next.1 = f32[7]{0} fusion(%all, %all-reduce.2), kind=kLoop
"""
    assert exchanged(program) == 12 + 1 + 10


def test_the_table_says_what_versions_a_row_was_made_with():
    import json
    import pathlib

    from benchmarks import report

    kept = pathlib.Path(__file__).parents[1] / "docs/benchmarks/results.json"
    rows = json.loads(kept.read_text())
    _, *parts = report.table(rows).split("\n## ")
    for row, part in zip(rows.values(), parts, strict=True):
        assert f"JAX {row['machine']['versions']['jax']}, NumPy " in part


def test_figarohs_relaxation_reaches_the_known_optimum_and_its_weights():
    """The D-optimal measure of a parabola: a third each at both ends and the middle."""
    from benchmarks.peers import figaroh

    u = np.linspace(-1.0, 1.0, 21)
    powers = np.stack([np.ones_like(u), u, u**2, 2.0 * u], axis=1)  # one too many
    blocks = figaroh.identified(powers[:, None])
    assert blocks.shape == (21, 1, 3)
    weight, gap = figaroh.relaxed_weights(blocks, 1e-6)
    assert gap < 1e-6
    assert figaroh.chosen(weight).tolist() == [0, 10, 20]
    np.testing.assert_allclose(weight[[0, 10, 20]], 1 / 3, atol=1e-4)


@pytest.mark.slow
def test_the_row_of_the_accelerator_runs_on_what_is_there():
    """On a CPU in about a minute; every figure is positive and says its unit."""
    from benchmarks.harness import Budget
    from benchmarks.rows import accelerator

    row = accelerator.run(Budget(quick=True))
    cases = [line.case for line in row.lines]
    assert cases.count("roofline") == 3 and cases.count("update of 64 episodes") == 2
    assert all(line.value > 0.0 and line.unit for line in row.lines)
    updates = [line for line in row.lines if line.case.startswith("update")]
    assert all(float(line.note.split()[2]) > 0.0 for line in updates)  # its roofline


def test_an_instance_of_e_is_read_from_the_conic_benchmark_format(tmp_path):
    from benchmarks.suites import cbf

    rows = np.array([[1.0, 2.0], [0.5, -1.0], [3.0, 0.0]])
    entries = [
        f"0 {i} {a} {b} {float(row[a] * row[b])}"
        for i, row in enumerate(rows)
        for a in range(2)
        for b in range(a + 1)
        if row[a] * row[b]
    ] + ["0 3 0 0 -1", "0 3 1 1 -1"]
    text = ["VER", "3", "OBJSENSE", "MAX", "VAR", "4 2", "L+ 3", "F 1", "INT", "3"]
    text += ["0", "1", "2", "PSDCON", "1", "2", "OBJACOORD", "1", "3 1"]
    text += ["CON", "4 2", "L= 1", "L- 3", "ACOORD", "6"]
    text += ["0 0 1", "0 1 1", "0 2 1", "1 0 1", "2 1 1", "3 2 1"]
    text += ["BCOORD", "4", "0 -3", "1 -2", "2 -1", "3 -2"]
    text += ["HCOORD", str(len(entries)), *entries]
    path = tmp_path / "small.cbf"
    path.write_text("# written by hand\n" + "\n".join(text) + "\n")
    one = cbf(path)
    assert (one.name, one.criterion, one.size) == ("small", "E", 3)
    assert one.most.tolist() == [2, 1, 2]
    for read, row in zip(one.rows, rows, strict=True):
        np.testing.assert_allclose(np.outer(read, read), np.outer(row, row), atol=1e-12)
    path.write_text("VER\n3\nOBJSENSE\nMIN\nINT\n1\n0\nPSDCON\n1\n2\n")
    with pytest.raises(ValueError, match="not a choice by the least eigenvalue"):
        cbf(path)


def test_entropy_is_a_choice_by_d():
    from benchmarks.suites import covariance, entropy
    from jaxcal import Design

    matrix = covariance(None, 9)
    one = entropy(matrix, 4)
    chosen = Design.from_blocks(one.rows[:, None], prior=one.prior).select(
        4, "D", "exact"
    )
    best = max(
        np.linalg.slogdet(matrix[np.ix_(some, some)])[1]
        for some in itertools.combinations(range(9), 4)
    )
    these = np.ix_(chosen.indices, chosen.indices)
    assert np.linalg.slogdet(matrix[these])[1] == pytest.approx(best, abs=1e-10)
