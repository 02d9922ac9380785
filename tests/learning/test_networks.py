"""The networks: size, invariances, masks."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcal.learning.config import NetworkConfig
from jaxcal.learning.core import network as networks
from jaxcal.learning.core.network import Network, build, initial
from jaxcal.learning.policies import scorer
from jaxcal.learning.training import checkpoint
from jaxcal.paper.network import HEADS

SMALL = NetworkConfig(width=8, encoder_rounds=1)
CLOSE = NetworkConfig(width=8, encoder_rounds=1, close_up=True)


@functools.cache
def made(config, m=12, n=3, k=4, seed=0):
    network = build(config)
    params = networks.initial(network, jax.random.key(seed), m, n, k)
    # Every parameter away from its initial zero, so that nothing is hidden by one.

    def noisy(leaf):
        added = 0.1 * np.cos(np.arange(leaf.size, dtype=leaf.dtype))
        return np.asarray(leaf) + added.reshape(leaf.shape)

    return network, jax.tree.map(noisy, params)


def score(network, params, points, chosen, k=4, usable=None):
    points = jnp.asarray(points, jax.tree.leaves(params)[0].dtype)
    picks = jnp.full((len(points), k), -1)
    picks = picks.at[:, : len(chosen)].set(jnp.asarray(chosen, int))
    usable = jnp.ones(points.shape[:2], bool) if usable is None else jnp.array(usable)
    free = usable.at[:, jnp.asarray(chosen, int)].set(False)
    return scored(network, params, points, usable, picks, free, len(chosen))


# One program, which the cache keeps: op by op it would be hundreds.
@functools.partial(jax.jit, static_argnames=("network", "count"))
def scored(network, params, points, usable, picks, free, count):
    features = network.candidate_features(points, usable)
    memory = networks.encode(network, params, features)
    decision = network.decision_features(features, picks, free, count)
    return networks.decode(network, params, memory, decision)


def test_the_papers_network_has_its_size_and_its_share():
    network = build(NetworkConfig(kind="paper", width=768))
    shapes = jax.eval_shape(
        lambda: networks.initial(network, jax.random.key(0), 50, 3, 4)
    )
    size = {name: sum(x.size for x in jax.tree.leaves(part)) for name, part in
            shapes.items()}  # fmt: skip
    total = sum(size.values())
    heads = sum(size[name] for name in HEADS)
    assert abs(total - 3.5e6) <= 0.03 * 3.5e6
    assert abs((1 - heads / total) - 0.71) <= 0.01


slow = pytest.mark.slow


@pytest.mark.slow
@pytest.mark.parametrize(
    ("k", "chosen"),
    [
        (4, [3, 7]),
        (7, [1, 2, 5, 8, 9]),
        pytest.param(4, [], marks=slow),
        pytest.param(7, [1, 2], marks=slow),
    ],
)
def test_compact_is_blind_to_affine_maps(rng, k, chosen):
    """In float64: a close-up magnifies the rounding of a look-ahead 2,048 times."""
    points = rng.uniform(size=(3, 12, 3))
    shear = np.array([[3.0, 1.0, 0.0], [0.0, 0.5, 2.0], [1.0, 0.0, 1.0]])
    with jax.enable_x64(True):
        network, params = made(CLOSE)
        params = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), params)
        logits, value = score(network, params, points, chosen, k)
        mapped, other = score(network, params, points @ shear.T + 5.0, chosen, k)
    np.testing.assert_allclose(logits, mapped, rtol=1e-6, atol=1e-6)
    # The value moves by the log-determinant of the map, squared.
    moved = 2.0 * np.log(abs(np.linalg.det(shear)))
    np.testing.assert_allclose(other - value, moved, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "config", [CLOSE, pytest.param(NetworkConfig(kind="paper", width=32), marks=slow)]
)
def test_permuting_the_candidates_permutes_the_logits(rng, config):
    network, params = made(config)
    points = rng.uniform(size=(3, 12, 3))  # the shape, and program, of the test above
    order = rng.permutation(12)
    logits, value = score(network, params, points, [4, 6])
    where = [int(np.flatnonzero(order == i)[0]) for i in (4, 6)]
    mixed, other = score(network, params, points[:, order], where)
    np.testing.assert_allclose(logits[:, order], mixed, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(value, other, atol=1e-3)


@slow
@pytest.mark.parametrize("k", [4, 7])
def test_a_network_can_begin_as_the_look_ahead_rule(rng, k):
    start = dataclasses.replace(CLOSE, initial_trust=4.0, initial_actor=0.0)
    network = build(start)
    params = networks.initial(network, jax.random.key(0), 12, 3, k)
    points = jnp.asarray(rng.uniform(size=(50, 12, 3)), jnp.float32)
    free = jnp.ones((50, 12), bool)
    own = scorer.choose(network, params, points, free, k=k)
    features = network.candidate_features(points, free)

    @jax.jit
    def rule():
        chosen, left = jnp.full((50, k), -1, jnp.int32), free
        for count in range(k):
            decision = network.decision_features(features, chosen, left, count)
            pick = network.lookahead_logits(decision)[0].argmax(axis=-1)
            chosen = chosen.at[:, count].set(pick.astype(jnp.int32))
            left = left & ~jax.nn.one_hot(pick, 12, dtype=bool)
        return chosen

    picks = rule()
    # The members of one set tie; which of them comes first is rounding.
    reached = [scorer.log_det_of(points, picked) for picked in (own, picks)]
    np.testing.assert_allclose(*reached, atol=1e-4)
    assert (np.sort(own) == np.sort(picks)).all(axis=1).mean() > 0.9


SHIPPED = json.loads((pathlib.Path(__file__).parent / "shipped_picks.json").read_text())


@pytest.mark.parametrize(
    ("name", "n", "mask", "how"),
    [
        pytest.param("k5", 3, 0.0, {}, marks=slow),
        pytest.param(
            *("n2k4first", 2, 0.2, {"decoding": "first", "num": 4}), marks=slow
        ),
    ],
)
def test_the_shipped_policy_chooses_what_it_always_chose(name, n, mask, how):
    policy, picks = checkpoint.load(), np.array(SHIPPED[name])
    batch, k = picks.shape
    rng = np.random.default_rng([20, n, k, 0])
    sets = rng.uniform(size=(batch, 20, n)).astype(np.float32)
    free = rng.uniform(size=(batch, 20)) >= mask
    found = scorer.choose(policy.network, policy.params, sets, free, k=k, **how)
    # The best of the last pair comes first; where they tie, rounding decides.
    assert (np.sort(found) == np.sort(picks)).all(axis=1).mean() > 0.98


@slow
@pytest.mark.parametrize(("k", "close"), [(4, False), (5, True)])
def test_the_last_pair_is_the_best_one_unless_little_is_spanned(rng, k, close):
    # Three inputs. At K = n + 2 the choices before the pair do not span the space: the
    # pair is rated with a ridge beside them, which counts where they nearly coincide.
    (network, params), m, batch = made(SMALL), 12, 300
    points = rng.uniform(size=(batch, m, 3)).astype(np.float32)
    if close:
        points[:, : k - 2] = points[:, :1] + 0.03 * points[:, : k - 2]
    begun = np.tile(np.arange(k - 2), (batch, 1))
    found = scorer.choose(
        network, params, points, np.ones((batch, m), bool), begun, k=k
    )

    def log_det(sets):
        z = np.concatenate([sets.astype(float), np.ones((*sets.shape[:2], 1))], -1)
        return np.linalg.slogdet(np.swapaxes(z, 1, 2) @ z)[1]

    pairs = itertools.combinations(range(k - 2, m), 2)
    best = np.max([log_det(points[:, [*range(k - 2), *p]]) for p in pairs], axis=0)
    own = log_det(np.take_along_axis(points, np.asarray(found)[..., None], axis=1))
    exact = best - own < 1e-4
    assert 0.5 < exact.mean() < 0.95 if close else exact.all()


def test_a_close_up_tells_near_equal_look_aheads_apart(rng):
    network = build(CLOSE)
    points = jnp.asarray(rng.uniform(size=(1, 12, 3)), jnp.float32)
    free = jnp.ones((1, 12), bool)
    vectors = jax.jit(network.candidate_features)(points, free).vectors
    plain = jax.jit(build(SMALL).candidate_features)(points, free).vectors
    np.testing.assert_allclose(vectors.columns[..., :13], plain.columns, atol=1e-6)
    shown, behind = np.asarray(vectors.columns)[0, :, 13:], vectors.to_the_end[0]
    best = int(np.argmax(behind))
    assert (shown[best] == 1.0).all() and shown.shape == (12, 3)
    for scale, column in zip((32.0, 256.0, 2048.0), shown.T, strict=True):
        wanted = np.exp(scale * np.maximum(np.asarray(behind, np.float64), -8.0))
        np.testing.assert_allclose(column, wanted, atol=1e-5)


@pytest.mark.parametrize("config", [SMALL, NetworkConfig(kind="paper", width=32)])
@slow
def test_masked_candidates_are_never_likely_and_gradients_stay_finite(rng, config):
    network, params = made(config)
    points = jnp.asarray(rng.uniform(size=(2, 12, 3)), jnp.float32)

    def loss(params):
        logits, value = score(network, params, points, [0, 1])
        log_probs = jax.nn.log_softmax(logits)
        entropy = -(jnp.exp(log_probs) * log_probs).sum()
        return entropy + value.sum(), jnp.exp(log_probs)

    grads, probabilities = jax.grad(loss, has_aux=True)(params)
    assert float(probabilities[:, :2].max()) == 0.0
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(grads))


@slow
def test_one_set_of_weights_serves_any_m_k_and_n(rng):
    network, params = made(SMALL)
    for m, n, k in ((5, 1, 2), (9, 2, 3), (30, 4, 5), (40, 3, 11)):
        logits, value = score(network, params, rng.uniform(size=(2, m, n)), [], k)
        assert logits.shape == (2, m) and bool(jnp.isfinite(value).all())


def test_a_masked_candidate_does_not_touch_the_others(rng):
    network, params = made(CLOSE)
    points = rng.uniform(size=(3, 12, 3))
    usable = np.broadcast_to(np.arange(12) < 9, (3, 12))
    logits, _ = score(network, params, points, [4, 6], usable=usable)
    points[:, 9:] = 50.0
    moved, _ = score(network, params, points, [4, 6], usable=usable)
    np.testing.assert_allclose(logits[:, :9], moved[:, :9], atol=1e-3)


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"kind": "big"}, "kind"),
        ({"width": 0}, "width"),
        ({"lookahead": 0}, "lookahead"),
    ],
)
def test_a_bad_configuration_is_named(values, named):
    with pytest.raises(ValueError, match=named):
        NetworkConfig(**values)


@slow
def test_the_papers_scores_are_those_of_keys_that_are_written_out(rng):
    # Attention as the paper has it: a key for every candidate, a query for the context.
    network, params = made(NetworkConfig(kind="paper", width=32), m=20)
    candidates = jnp.asarray(rng.uniform(size=(1, 20, 3)), jnp.float32)
    free = jnp.arange(20)[None] != 7
    chosen = jnp.array([[7, -1, -1, -1]])
    features = network.candidate_features(candidates, free)
    decision = network.decision_features(features, chosen, free, 1)
    poses = networks.encode(network, params, features)
    logits, _ = networks.decode(network, params, poses, decision)
    params, poses, context = jax.tree.map(np.asarray, (params, poses, decision.context))

    def dense(name, rows):
        return rows @ params[name]["kernel"] + params[name]["bias"]

    def relu(rows):
        return np.maximum(rows, 0.0)

    def norm(name, rows):
        centred = rows - rows.mean(-1, keepdims=True)
        unit = centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-6)
        return unit * params[name]["scale"] + params[name]["bias"]

    keys = dense("key", poses)[0]
    context = relu(dense("context_1", context))
    context = norm("context_norm", relu(dense("context_2", context)))
    scores = keys @ dense("query", context)[0] / 32**0.5
    weights = np.asarray(jax.nn.softmax(np.where(free[0], scores, -np.inf)))
    squeezed = relu(dense("squeeze", context + weights @ keys))
    shared = context + dense("expand", squeezed)
    expected = np.where(free[0], keys @ dense("actor", shared)[0] / 32**0.5, -np.inf)
    np.testing.assert_allclose(
        jax.nn.softmax(logits[0]), jax.nn.softmax(expected), rtol=1e-4, atol=1e-6
    )


class _Short(Network):
    """Logits of fewer candidates than there are."""

    def candidate_features(self, candidates, usable):
        return candidates

    def decision_features(self, features, chosen, available, count):
        return features, available

    def encode(self, features):
        return features

    def decode(self, memory, decision):
        return memory[..., :3, 0], memory.mean((-1, -2))


class _NoValue(_Short):
    """Logits and no value."""

    def decode(self, memory, decision):
        return memory[..., 0]


class _Unfinished(Network):
    """A network without methods."""


@pytest.mark.parametrize(
    ("network", "says"),
    [
        (
            _Short(),
            r"decode of _Short must return logits .*, 5\).*got \(1, 3\), \(1,\)",
        ),
        (_NoValue(), r"value .*got \(1, 5\)$"),
        (_Unfinished(), "must define candidate_features; _Unfinished does not"),
    ],
)
def test_a_network_of_ones_own_that_answers_wrongly_is_named(network, says):
    with pytest.raises(ValueError, match=says):
        initial(network, jax.random.key(0), 5, 3, 4)
