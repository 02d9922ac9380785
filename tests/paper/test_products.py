"""The network of products: what it sees, and how its preset plays."""

from __future__ import annotations

import collections
import dataclasses
import itertools
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcal
from jaxcal.learning.config import NetworkConfig
from jaxcal.learning.core.network import build, decode, encode, initial
from jaxcal.learning.core.postures import Postures
from jaxcal.learning.environments import selection
from jaxcal.learning.environments.task import Task
from jaxcal.learning.policies import scorer
from jaxcal.learning.training import checkpoint
from jaxcal.paper.preset import OBSERVATION

TASK = Task()
PLAIN = dataclasses.replace(OBSERVATION.network, mirrored=False)
NETWORK = build(PLAIN)  # as it is trained

SHIPPED = pathlib.Path(__file__).parents[2] / "checkpoints" / "paper.npz"


@pytest.fixture(scope="module")
def params():
    return initial(NETWORK, jax.random.key(0), 50, 3, 4)


def _state(seed: int, *chosen: int):
    state = TASK.reset(jax.random.key(seed))
    for action in chosen:
        state = TASK.step(state, jnp.asarray(action))[0]
    return state


def _logits(params, state):
    features = NETWORK.candidate_features(state.candidates, state.available)
    decision = NETWORK.decision_features(features, state.chosen, state.available, 0)
    return decode(NETWORK, params, encode(NETWORK, params, features), decision)[0]


@pytest.mark.parametrize("chosen", [(), (7,), (7, 3), (7, 3, 40)])
def test_the_210_numbers_are_all_that_it_sees(params, chosen) -> None:
    state = _state(len(chosen), *chosen)
    observation = selection.observe(state, TASK.environment)
    assert observation.shape == (210,)
    logits, value = NETWORK.apply(
        {"params": params}, observation, 50, 3, method="from_observation"
    )
    assert logits.shape == (50,)
    assert value.shape == ()
    np.testing.assert_allclose(logits, _logits(params, state), rtol=1e-5, atol=1e-5)
    assert (np.asarray(logits)[list(chosen)] < -1e8).all()
    # Of the ten numbers of the context, which follow from the others, it uses none.
    other = NETWORK.apply(
        {"params": params}, observation.at[200:].set(9.0), 50, 3,
        method="from_observation",
    )  # fmt: skip
    np.testing.assert_array_equal(other[0], logits)


@pytest.mark.parametrize("chosen", [(), (7,), (7, 12, 40)])
def test_the_order_of_the_candidates_does_not_matter(params, chosen) -> None:
    """But for that in which the chosen ones are read, which stays."""
    state = _state(5, *chosen)
    order = np.random.default_rng(0).permutation(50)
    kept = [i for i in order if i in chosen]
    order[np.isin(order, chosen)] = sorted(kept)
    moved = state.replace(
        candidates=state.candidates[order], available=state.available[order]
    )
    np.testing.assert_allclose(
        _logits(params, moved), _logits(params, state)[order], rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("k", [4, 6])
def test_the_shipped_agent_takes_back_and_votes(k):
    """Against loops over the plain network, one image and one posture at a time."""
    policy = checkpoint.load(SHIPPED)
    assert policy.network.config.mirrored
    rng = np.random.default_rng(3)
    sets, everything = rng.random((3, 20, 3)), np.ones((3, 20), bool)
    signs = np.array([*itertools.product((1.0, -1.0), repeat=3)])[:, None]

    @jax.jit
    def read(x, free, groups):
        variables = {"params": policy.params}
        return NETWORK.apply(variables, x, free, groups, method="_logits")

    def logits(x, chosen):
        groups = [*itertools.combinations(chosen, min(3, len(chosen)))]
        masks = np.array([np.isin(np.arange(20), group) for group in groups])
        return np.asarray(read(x, ~np.isin(np.arange(20), chosen), masks))

    def whole_choice(commands):
        images = 12.0**0.5 * signs * (commands - 0.5)
        images = np.append(images, np.ones((8, 20, 1)), -1)
        votes = collections.Counter()
        order = {}
        for x in images:
            chosen = []
            for _ in range(k):
                chosen = [*chosen, logits(x, chosen).argmax()]
            for _ in range(2 * k):
                chosen = [*chosen[1:], logits(x, chosen[1:]).argmax()]
            votes[frozenset(chosen)] += 1
            order.setdefault(frozenset(chosen), chosen)
        chosen = order[votes.most_common(1)[0][0]]
        for _ in range(k):
            some = chosen[1:]
            mean = np.mean([jax.nn.log_softmax(logits(x, some)) for x in images], 0)
            chosen = [*some, mean.argmax()]
        return sorted(chosen)

    def choose(sets):
        network = policy.network
        picks = scorer.choose(network, policy.params, sets, everything, k=k)
        return np.sort(picks, axis=1).tolist()

    own = choose(sets)
    assert own == [whole_choice(commands) for commands in sets]
    mirror = sets * [1.0, -1.0, 1.0] + [0.0, 1.0, 0.0]
    assert choose(mirror) == own


def test_a_state_that_is_not_its_own_is_continued(rng):
    """Of two given postures at its worst places the others are its best answer."""
    candidates = rng.random((50, 3))
    order = np.argsort(np.abs(candidates - 0.5).max(axis=1))
    options = {"checkpoint": SHIPPED, "required": order[:2]}
    chosen = jaxcal.select(candidates, 4, "policy", **options)
    assert set(order[:2]) <= {*chosen.indices.tolist()}
    best = jaxcal.select(candidates, 4, "exact", required=order[:2])
    assert chosen.log_det > best.log_det - 1.0


def test_another_number_of_inputs_and_candidates_runs() -> None:
    network = build(NetworkConfig(kind="observation", decoder_rounds=1, width=8))
    weights = initial(network, jax.random.key(0), 12, 2, 3)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(weights))
    with pytest.raises(ValueError, match=r"at most num_inputs \+ 1 = 3, got 4"):
        initial(network, jax.random.key(0), 12, 2, 4)


@pytest.mark.parametrize("given", [0, 2])
def test_episodes_of_a_row_part_in_one_state_and_go_on_greedily(given) -> None:
    small = NetworkConfig(kind="observation", decoder_rounds=0, width=8)
    ppo = dataclasses.replace(OBSERVATION.ppo, episodes_per_update=8 * 16)
    learner = Postures(ppo, Task(num_given=given), build(small))
    weights = learner.init(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), ppo.rows_per_update)
    rows, _, metrics = jax.jit(learner.rollout)(weights, learner.begin(keys))
    assert rows.action.shape == (8, 1, 16)
    free = np.asarray(rows.observations.decisions.available)
    assert free.shape == (8, 1, 50)
    assert (free.sum(-1) == 50 - given).all()
    actions = np.asarray(rows.action[:, 0])
    rewards = np.asarray(metrics["rewards"]).reshape(8, 16)
    for row in range(8):
        assert free[row, 0, actions[row]].all()
        for action in np.unique(actions[row]):
            assert len(np.unique(rewards[row][actions[row] == action])) == 1
    assert float(np.std(rewards, axis=1).min()) > 0.0
    np.testing.assert_allclose(np.asarray(rows.advantage).mean(), 0.0, atol=0.05)


def test_a_number_of_given_choices_that_leaves_none_is_named() -> None:
    with pytest.raises(ValueError, match=r"num_given must be in \[0, 4\), got 4"):
        Task(num_given=4)


def test_a_mask_and_another_number_of_inputs_are_refused_by_name(rng):
    options = {"checkpoint": SHIPPED}
    candidates, available = rng.random((50, 3)), np.arange(50) >= 20
    with pytest.raises(ValueError, match="all candidates available, but 20"):
        jaxcal.select(candidates, 4, "policy", available=available, **options)
    with pytest.raises(ValueError, match=r"chooses for 3 inputs, got 2$"):
        jaxcal.select(candidates[:, :2], 3, "policy", **options)
    assert jaxcal.select(candidates, 4, "policy", **options).efficiency > 0.5
