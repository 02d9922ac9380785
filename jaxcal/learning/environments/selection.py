"""Posture selection as a sequential decision problem: pure functions for one episode.

| | |
|---|---|
| state | the candidate set, what was chosen, what is still available |
| action | the index of one available candidate |
| reward | 0, and after every (n + 1)-th choice ``reward_scale * log det S`` |
| end | after ``num_selected`` choices; a pure termination, nothing is truncated |
| version | 1 |

Write for one episode, ``jax.vmap`` for thousands. The key lives in the state, so that
``reset_from`` draws fresh candidates for every episode. Source: paper, Section 2.3 and
Table 2; the reward's range is discussed in docs/environment.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcal.learning.environments import randomness
from jaxcal.learning.environments.observation import context_features
from jaxcal.learning.policies import geometry
from jaxcal.learning.policies.networks import Network, View

__all__ = [
    "Candidates",
    "SelectionConfig",
    "SelectionState",
    "from_pool",
    "look",
    "observe",
    "reset",
    "reset_from",
    "start",
    "step",
    "uniform",
]

Candidates = Callable[[jax.Array], tuple[jax.Array, jax.Array]]
"""key -> (M, n) candidates and (M,) bool available."""


@dataclasses.dataclass(frozen=True)
class SelectionConfig:
    """What an episode is."""

    num_candidates: int = 50  # postures offered per episode
    num_selected: int = 4  # postures chosen; n + 1 identify every parameter
    num_inputs: int = 3  # commanded axes
    num_outputs: int = 3  # measured axes; they multiply the log-determinant
    reward_scale: float = 0.1  # reward per unit of log det S (paper: 1/10)
    reward_gain: bool = False  # pay the increase of log det S since the last payment

    def __post_init__(self) -> None:
        for name in ("num_inputs", "num_outputs"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"{name} must be at least 1, got {getattr(self, name)}"
                )
        if not self.num_regressors <= self.num_selected < self.num_candidates:
            raise ValueError(
                f"num_selected must be in [{self.num_regressors}, "
                f"{self.num_candidates}), got {self.num_selected}"
            )
        if not self.reward_scale > 0:
            raise ValueError(f"reward_scale must be positive, got {self.reward_scale}")

    @property
    def num_regressors(self) -> int:
        """p = n + 1, the fewest postures that identify the model."""
        return self.num_inputs + 1

    @property
    def observation_size(self) -> int:
        """Length of the paper's observation: 210 for 50 candidates, 3 inputs."""
        return (self.num_inputs + 1) * self.num_candidates + 2 * self.num_inputs + 4


@struct.dataclass
class SelectionState:
    """One calibration episode."""

    candidates: jax.Array  # (M, n) float32, commands, normalised by convention
    chosen: jax.Array  # (K,) int32, -1 where nothing is chosen yet
    available: jax.Array  # (M,) bool, True = may be chosen
    count: jax.Array  # () int32, postures chosen so far
    paid: jax.Array  # () float32, log det S at the last payment, 0 before
    key: jax.Array  # () PRNG key of the next episode


def uniform(
    config: SelectionConfig,
    low: tuple[float, ...] | None = None,
    high: tuple[float, ...] | None = None,
) -> Candidates:
    """Candidates uniform between ``low`` and ``high``, per axis; [0, 1] by default."""
    lower = np.asarray(low if low is not None else (0.0,) * config.num_inputs)
    upper = np.asarray(high if high is not None else (1.0,) * config.num_inputs)
    if lower.shape != (config.num_inputs,) or upper.shape != (config.num_inputs,):
        raise ValueError(
            f"low and high must hold {config.num_inputs} numbers, "
            f"got {lower.shape} and {upper.shape}"
        )
    if not (lower < upper).all():
        raise ValueError(f"low must be below high on every axis, got {low} and {high}")
    shape = (config.num_candidates, config.num_inputs)

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        unit = randomness.uniform(key, shape)
        points = jnp.float32(lower)[None, :] + unit * jnp.float32(upper - lower)[None]
        return points, jnp.ones(shape[0], bool)

    return draw


def from_pool(config: SelectionConfig, pool: jax.Array) -> Candidates:
    """Candidates drawn without replacement from a pool (N, n) of recorded postures."""
    pool = jnp.asarray(pool, jnp.float32)
    if pool.ndim != 2 or pool.shape[1] != config.num_inputs:
        raise ValueError(
            f"pool must have shape (N, {config.num_inputs}), got {pool.shape}"
        )
    if pool.shape[0] < config.num_candidates:
        raise ValueError(
            f"pool must hold at least {config.num_candidates} postures, "
            f"got {pool.shape[0]}"
        )

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        index = jax.random.permutation(key, pool.shape[0])[: config.num_candidates]
        return pool[index], jnp.ones(config.num_candidates, bool)

    return draw


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
    key: jax.Array, config: SelectionConfig, draw: Candidates | None = None
) -> SelectionState:
    """A new episode with fresh candidates (uniform in [0, 1] unless ``draw`` is given).

    Args:
        key: () PRNG key.
        config: sizes and reward.
        draw: where candidates come from: ``uniform``, ``from_pool`` or your own.
    """
    key_draw, key_next = randomness.split(key)
    candidates, available = (draw or uniform(config))(key_draw)
    return start(candidates, available, config, key_next)


def reset_from(
    state: SelectionState, config: SelectionConfig, draw: Candidates | None = None
) -> SelectionState:
    """The episode after this one: the state's own key draws its candidates."""
    return reset(state.key, config, draw)


def step(
    state: SelectionState, action: jax.Array, config: SelectionConfig
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
    action = action.astype(jnp.int32)
    chosen = jnp.where(
        jnp.arange(config.num_selected) == state.count, action, state.chosen
    )
    count = state.count + 1
    done = count >= config.num_selected
    pays = (count % p == 0) | done

    postures = geometry.picked(state.candidates, chosen)
    value = config.num_outputs * geometry.log_det_gram(postures, chosen >= 0)

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


def look(network: Network, state: SelectionState) -> View:
    """The network's view of a batch of sets."""
    return network.look(state.candidates, state.available)


def observe(state: SelectionState, config: SelectionConfig) -> jax.Array:
    """The paper's observation, 210 numbers for M = 50 and n = 3 (Table 2).

    Returns:
        (n M + M + 2 n + 4,): poses; availability, 1 or 0; ``context_features``.
    """
    return jnp.concatenate(
        [
            state.candidates.ravel(),
            state.available.astype(state.candidates.dtype),
            context_features(state.candidates, state.chosen),
        ]
    )
