"""Posture selection as a sequential decision problem: pure functions for one episode.

| | |
|---|---|
| state | the candidate set, what was chosen, what is still available |
| action | the index of one available candidate |
| reward | ``reward_scale * log det S`` at each (n + 1)-th and the last choice, else 0 |
| end | after ``num_selected`` choices; a pure termination, nothing is truncated |
| version | 1 |

With ``reward_gain`` the reward is the increase of log det S since the last payment.
Functions take one episode; ``jax.vmap`` makes a batch. Source: paper, Section 2.3 and
Table 2; docs/environment.md discusses the reward's range.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from numpy.typing import ArrayLike

from jaxcal.learning.config import SHAPES, SelectionConfig
from jaxcal.learning.small_matrices import (
    factored,
    log_det_gram,
    picked,
    row_dot,
    row_parts,
    row_sum,
)

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA

CandidateSource = Callable[[jax.Array], tuple[jax.Array, jax.Array]]
"""key -> (M, n) candidates and (M,) bool available."""


@struct.dataclass
class SelectionState:
    """One calibration episode."""

    candidates: jax.Array  # (M, n) float32 commands, usually in [0, 1]
    chosen: jax.Array  # (K,) int32, -1 where nothing is chosen yet
    available: jax.Array  # (M,) bool, True = may be chosen
    count: jax.Array  # () int32, postures chosen so far
    paid: jax.Array  # () float32, log det S at the last payment, 0 before
    key: jax.Array  # () PRNG key of the next episode


def start(
    candidates: jax.Array, available: jax.Array, config: SelectionConfig, key: jax.Array
) -> SelectionState:
    """The state before the first choice from a given candidate set."""
    return SelectionState(
        candidates=candidates,
        chosen=jnp.full(config.num_selected, -1, jnp.int32),
        available=available,
        count=jnp.zeros((), jnp.int32),
        paid=jnp.zeros((), candidates.dtype),
        key=key,
    )


def reset(
    key: jax.Array, config: SelectionConfig, draw: CandidateSource | None = None
) -> SelectionState:
    """A new episode with fresh candidates of ``draw`` (``given``, ``mixture``),
    uniform in [0, 1] on every axis when None."""
    key_draw, key_next = jax.random.split(key)
    if draw is not None:
        return start(*draw(key_draw), config, key_next)
    m = config.num_candidates
    candidates = uniform(key_draw, (m, config.num_inputs))
    return start(candidates, jnp.ones(m, bool), config, key_next)


def step(
    state: SelectionState, action: jax.typing.ArrayLike, config: SelectionConfig
) -> tuple[SelectionState, jax.Array, jax.Array]:
    """Choose one posture: the next state, () reward, () bool done.

    ``action`` () int is an available candidate; the policy masks its logits. Choosing
    one again would count its information again.
    """
    p = config.num_regressors
    action = jnp.asarray(action, jnp.int32)
    chosen = jnp.where(
        jnp.arange(config.num_selected) == state.count, action, state.chosen
    )
    count = state.count + 1
    done = count >= config.num_selected
    pays = (count % p == 0) | done

    log_det = log_det_gram(picked(state.candidates, chosen), chosen >= 0)
    value = config.num_outputs * log_det

    before = state.paid if config.reward_gain else jnp.zeros_like(value)
    reward = jnp.where(pays, config.reward_scale * (value - before), 0.0)
    state = dataclasses.replace(
        state,
        chosen=chosen,
        available=state.available & (jnp.arange(config.num_candidates) != action),
        count=count,
        paid=jnp.where(pays, value, state.paid),
    )
    return state, reward, done


def observe(state: SelectionState, config: SelectionConfig) -> jax.Array:
    """(n M + M + 2 n + 4,) the paper's observation, 210 numbers for M = 50 and n = 3
    (Table 2): poses; availability, 1 or 0; ``context_features``."""
    return jnp.concatenate(
        [
            state.candidates.ravel(),
            state.available.astype(state.candidates.dtype),
            context_features(state.candidates, state.chosen),
        ]
    )


def context_features(candidates: jax.Array, chosen: jax.Array) -> jax.Array:
    """(..., 2 n + 4), the paper's ten context numbers: mean and standard deviation, per
    axis, of the postures chosen so far (0 before the first); progress in [0, 1]; and
    three features of the chosen regressors with a ridge of 0.01: log-determinant,
    trace, and the log ratio of the least to the largest Cholesky pivot, each scaled to
    order one. ``candidates`` (..., M, n), ``chosen`` (..., K) int, -1 where none yet.
    """
    n, total = candidates.shape[-1], chosen.shape[-1]
    postures = picked(candidates, chosen)
    present = row_parts((chosen >= 0).astype(candidates.dtype))
    rows = [row_parts(postures[..., j]) for j in range(n)]
    rows = [[x * w for x, w in zip(row, present, strict=True)] for row in rows]
    count = row_sum(present)
    number = jnp.maximum(count, 1.0)
    mean = [row_sum(row) / number for row in rows]
    std = []
    for row, middle in zip(rows, mean, strict=True):
        spread = [(x - middle) * w for x, w in zip(row, present, strict=True)]
        variance = row_dot(spread, spread) / number
        std.append(jnp.sqrt(jnp.where(variance > 0, variance, 1.0)) * (variance > 0))
    z = [*rows, present]
    p = n + 1
    gram = [[row_dot(z[i], z[j]) for j in range(i + 1)] for i in range(p)]
    for i in range(p):
        gram[i][i] = gram[i][i] + 0.01
    pivots = [jnp.log(row[-1]) for row in factored(gram)]
    trace = sum(gram[i][i] for i in range(p))
    least, largest = pivots[0], pivots[0]
    for pivot in pivots[1:]:
        least, largest = jnp.minimum(least, pivot), jnp.maximum(largest, pivot)
    scalars = [
        count / total,
        sum(pivots) / (1.25 * p),
        trace / (total * p),
        (least - largest) / 4.0,
    ]
    # Written in one pass: joined, each number would be a copy of its own.
    parts = [*mean, *std, *scalars]
    column = jnp.arange(len(parts))
    out = jnp.asarray(parts[0])
    for i, part in enumerate(parts[1:], start=1):
        out = jnp.where(column < i, out, part)
    return out


def uniform(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """float32 in [0, 1), bit for bit those of ``jax.random.uniform(key, shape)``.

    On a CPU jax runs its Threefry hash (Salmon, Moraes, Dror and Shaw, SC 2011) as a
    loop that writes every round to memory; unrolled, the twenty rounds fuse into one
    pass, and episodes of 4,096 in lockstep take a quarter less time. ``key`` is typed
    or a legacy (2,) uint32 one, ``shape`` holds fewer than 2^32 numbers.
    """
    if not _is_plain_threefry(key):
        return jax.random.uniform(key, shape, jnp.float32)
    words = jax.random.key_data(key)
    keys = (words[0], words[1], words[0] ^ words[1] ^ jnp.uint32(_PARITY))
    x_1 = jax.lax.iota(jnp.uint32, math.prod(shape))
    x_0, x_1 = jnp.zeros_like(x_1) + keys[0], x_1 + keys[1]
    for group in range(5):
        for rotation in _ROTATIONS[group % 2]:
            x_0 = x_0 + x_1
            upper = x_1 << jnp.uint32(rotation)
            x_1 = x_0 ^ (upper | (x_1 >> jnp.uint32(32 - rotation)))
        x_0 = x_0 + keys[(group + 1) % 3]
        x_1 = x_1 + keys[(group + 2) % 3] + jnp.uint32(group + 1)
    # 23 random bits below the exponent of one: uniform in [1, 2).
    mantissa = ((x_0 ^ x_1) >> jnp.uint32(9)) | jnp.uint32(0x3F800000)
    ones = jax.lax.bitcast_convert_type(mantissa, jnp.float32)
    return (ones - jnp.float32(1.0)).reshape(shape)


def _is_plain_threefry(key: jax.Array) -> bool:
    typed = jax.dtypes.issubdtype(key.dtype, jax.dtypes.prng_key)
    default = getattr(jax.config, "jax_default_prng_impl", "")
    name = str(jax.random.key_impl(key)) if typed else default
    by_position = getattr(jax.config, "jax_threefry_partitionable", False)
    return name == "threefry2x32" and bool(by_position)


# -- where candidates come from --------------------------------------------------------


def given(
    config: SelectionConfig, sets: ArrayLike, available: ArrayLike | None = None
) -> CandidateSource:
    """One of the ``sets`` (B, M, n) for every episode, with ``available`` (B, M) bool,
    all when None; of a single set (1, N, n) M that are available, without repeats."""
    points = np.asarray(sets, np.float32)
    masks = np.ones(points.shape[:2], bool) if available is None else available
    masks = np.asarray(masks, bool)
    pool, m = len(points) == 1, config.num_candidates
    least, wanted = int(masks.sum(axis=1).min()), m if pool else config.num_selected
    if least < wanted:
        name = "num_candidates" if pool else "num_selected"
        raise ValueError(
            f"every set must have at least {name} = {wanted} available candidates, "
            f"got {least}"
        )
    if pool:
        points, masks = points[masks][None], np.ones((1, least), bool)
    kept, free = jnp.asarray(points), jnp.asarray(masks)

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        if pool:
            index = jax.random.permutation(key, least)[:m]
            return kept[0, index], free[0, index]
        index = jax.random.randint(key, (), 0, len(kept))
        return kept[index], free[index]

    return draw


def _shape(name: str, key: jax.Array, m: int, n: int) -> jax.Array:
    if name == "uniform":
        return uniform(key, (m, n))
    if name == "gaussian":
        return jax.random.normal(key, (m, n))
    key_a, key_b, key_c = jax.random.split(key, 3)
    if name == "sphere":
        points = jax.random.normal(key_a, (m, n))
        return points / jnp.linalg.norm(points, axis=-1, keepdims=True)
    if name in ("clustered", "cluster_uniform"):
        number = n + 2 if name == "clustered" else 2 * (n + 2)
        centres = jax.random.uniform(key_a, (number, n))
        which = jax.random.randint(key_b, (m,), 0, number)
        key_width, key_noise = jax.random.split(key_c)
        width = jax.random.uniform(key_width, (), minval=0.02, maxval=0.15)
        return centres[which] + width * jax.random.normal(key_noise, (m, n))
    # "grid": M distinct nodes of a grid with ``least`` to ``least + 2`` nodes per axis.
    least = next(side for side in itertools.count(2) if side**n >= m)
    side = jax.random.randint(key_a, (), least, least + 3)
    nodes = jax.random.permutation(key_b, (least + 2) ** n)
    inside = nodes < side**n
    node = nodes[jnp.argsort(~inside, stable=True)[:m]]
    digits = []
    for _ in range(n):
        digits.append(node % side)
        node = node // side
    return jnp.stack(digits, axis=-1) / (side - 1)


def mixture(
    config: SelectionConfig, shapes: Sequence[str] = ("uniform",), masked: float = 0.0
) -> CandidateSource:
    """Candidates of one of ``shapes`` for every episode; a repeated one weighs more.
    The share made unavailable is uniform between 0 and ``masked``; at least
    ``num_selected + 4`` stay. The compact network is invariant to affine maps: only
    shapes vary."""
    unknown = [name for name in shapes if name not in SHAPES]
    if not shapes or unknown:
        raise ValueError(f"shapes must be from {', '.join(SHAPES)}, got {list(shapes)}")
    if not 0.0 <= masked < 1.0:
        raise ValueError(f"masked must be in [0, 1), got {masked}")
    m, n = config.num_candidates, config.num_inputs
    unique = sorted(set(shapes), key=SHAPES.index)
    table = jnp.asarray([unique.index(name) for name in shapes])

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        if len(unique) == 1 and masked == 0.0:  # nothing else is random
            points = _shape(unique[0], key, m, n).astype(jnp.float32)
            return points, jnp.ones(m, bool)
        key_which, key_points, key_share, key_mask = jax.random.split(key, 4)
        clouds = [_shape(name, key_points, m, n).astype(jnp.float32) for name in unique]
        points = clouds[0]
        if len(clouds) > 1:
            which = table[jax.random.randint(key_which, (), 0, len(shapes))]
            points = jnp.stack(clouds)[which]
        if masked == 0.0:
            return points, jnp.ones(m, bool)
        share = masked * jax.random.uniform(key_share)
        rank = jax.random.permutation(key_mask, m)
        keep = jnp.maximum((m * (1.0 - share)).astype(int), config.num_selected + 4)
        return points, rank < keep

    return draw
