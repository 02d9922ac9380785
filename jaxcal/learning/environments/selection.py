"""Posture selection as a sequential decision problem: pure functions for one episode.

| | |
|---|---|
| state | the candidate set, what was chosen, what is still available |
| action | the index of one available candidate |
| reward | ``reward_scale * log det S`` at each (n + 1)-th and the last choice, else 0 |
| end | after ``num_selected`` choices; a pure termination, nothing is truncated |
| version | 1 |

With ``reward_gain`` the reward is the increase of log det S since the last payment.
Functions take one episode; ``jax.vmap`` makes a batch. The key in the state draws the
next episode's candidates. Source: paper, Section 2.3 and Table 2;
docs/environment.md discusses the reward's range.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.learning.config import SelectionConfig
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
    """A new episode with fresh candidates of ``draw`` (``scenarios`` has several),
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
    """Choose one posture.

    Args:
        state: an episode with fewer than ``num_selected`` choices made.
        action: () int, an available candidate; the policy masks its logits. Choosing
            one again would count its information again.

    Returns:
        The next state, () reward, () bool done.
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
    """The paper's ten context numbers: statistics, progress, matrix features.

    Args:
        candidates: (..., M, n).
        chosen: (..., K) int, -1 where nothing is chosen yet.

    Returns:
        (..., 2 n + 4): mean and standard deviation, per axis, of the postures chosen so
        far (0 before the first); progress in [0, 1]; and three features of the chosen
        regressors with a ridge of 0.01: log-determinant, trace, and the log ratio of
        the least to the largest Cholesky pivot, each scaled to order one.
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
    pass, and episodes of 4,096 in lockstep take a quarter less time.

    ``key`` is typed or a legacy (2,) uint32 one; one of another generator than Threefry
    goes to ``jax.random.uniform``. ``shape`` holds fewer than 2^32 numbers.
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
