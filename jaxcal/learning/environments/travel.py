"""Posture selection where time counts: ``environment`` with a start and tolls.

| | |
|---|---|
| state | as ``environment``, and the weighted times between all postures |
| action | the index of one available candidate, which the device visits next |
| reward | ``reward_scale`` times: log det S, less the weighted time of the run |
| end | after ``num_selected`` choices |
| version | 1 |

Time enters as *tolls*: weight x travel time, in units of log det(Z.T Z). Every episode
draws the weight, the speed and acceleration of every axis and the start, so that one
policy serves them all. Settling takes the same at every posture and changes no choice.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from jaxcal.learning.environments import selection as environment
from jaxcal.learning.environments.selection import (
    Candidates,
    SelectionConfig,
    SelectionState,
)
from jaxcal.learning.policies.networks import Network, View

__all__ = [
    "TravelConfig",
    "TravelState",
    "look",
    "reset",
    "step",
    "toll_of",
    "travel_seconds",
]


@dataclasses.dataclass(frozen=True)
class TravelConfig(SelectionConfig):
    """What an episode is, and the weights, speeds and starts it is drawn from."""

    reward_gain: bool = True  # the only way of paying in which tolls are paid once
    weightless: float = 0.1  # share of sets in which time costs nothing
    least_weight: float = 0.02  # of log det(Z.T Z) a mean move, log-uniform
    most_weight: float = 6.0
    free_starts: float = 0.25  # share of sets in which the first move costs nothing

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.reward_gain:
            raise ValueError("reward_gain must be True where time counts")
        for name in ("weightless", "free_starts"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be in [0, 1], got {getattr(self, name)}")
        if not 0.0 < self.least_weight <= self.most_weight:
            raise ValueError(
                "least_weight must be positive and at most most_weight, got "
                f"{self.least_weight} and {self.most_weight}"
            )


@struct.dataclass
class TravelState(SelectionState):
    """One episode in which time counts."""

    tolls: jax.Array  # (M, M) weighted travel times, units of log det(Z.T Z)
    entry: jax.Array  # (M,) weighted time from the start to each
    spent: jax.Array  # () tolls so far


def travel_seconds(
    points: jax.Array, others: jax.Array, speed: jax.Array, ramp: jax.Array
) -> jax.Array:
    """(..., A, B) seconds between postures (..., A, n) and (..., B, n).

    Args:
        points, others: in one unit.
        speed: (..., n) unit/s.
        ramp: (..., n) acceleration, unit/s^2. The profile is ``jaxcal.selection.fastest.travel``'s.
    """
    way = jnp.abs(points[..., :, None, :] - others[..., None, :, :])
    v = jnp.broadcast_to(speed[..., None, None, :], way.shape)
    a = jnp.broadcast_to(ramp[..., None, None, :], way.shape)
    slow = 2.0 * jnp.sqrt(way / a)
    return jnp.where(way >= v * v / a, way / v + v / a, slow).max(-1)


def reset(
    key: jax.Array, config: TravelConfig, draw: Candidates | None = None
) -> TravelState:
    """A new episode: fresh candidates, limits of the axes, start and weight."""
    key_set, key_speed, key_ramp, key_start, key_free, key_weight = jax.random.split(
        key, 6
    )
    state = environment.reset(key_set, config, draw)
    points, weight = state.candidates, state.available.astype(jnp.float32)
    shape = (config.num_inputs,)
    low, high = points.min(0), points.max(0)
    # Per axis: half to twice the range a unit of time, and from ramps too short to
    # notice to moves that never reach their speed.
    speed = (high - low) * 2.0 ** jax.random.uniform(key_speed, shape, minval=-1.0)
    share = 10.0 ** jax.random.uniform(key_ramp, shape, minval=-1.5, maxval=0.3)
    ramp = speed**2 / (share * (high - low))
    times = travel_seconds(points, points, speed, ramp)
    pairs = weight[:, None] * weight[None, :]
    mean = (times * pairs).sum() / pairs.sum()
    start = low + (high - low) * jax.random.uniform(key_start, shape)
    key_free, key_zero = jax.random.split(key_free)
    free = jax.random.uniform(key_free) < config.free_starts
    logs = jnp.log(jnp.asarray([config.least_weight, config.most_weight]))
    price = jnp.exp(jax.random.uniform(key_weight, minval=logs[0], maxval=logs[1]))
    price = jnp.where(jax.random.uniform(key_zero) < config.weightless, 0.0, price)
    price = price / mean
    entry = travel_seconds(start[None], points, speed, ramp)[0]
    return TravelState(
        **vars(state),
        tolls=price * times,
        entry=jnp.where(free, 0.0, price * entry),
        spent=jnp.zeros(()),
    )


def step(
    state: TravelState, action: jax.Array, config: TravelConfig
) -> tuple[TravelState, jax.Array, jax.Array]:
    """Visit one posture; what is paid is log det S less the tolls, since last time.

    Args:
        state: an episode with fewer than ``num_selected`` choices made.
        action: () int, an available candidate.

    Returns:
        The next state, () reward, () bool done.
    """
    before = state.chosen[jnp.maximum(state.count - 1, 0)]
    toll = jnp.where(state.count > 0, state.tolls[before, action], state.entry[action])
    spent = state.spent + toll
    after, _, done = environment.step(state, action, config)
    pays = (after.count % config.num_regressors == 0) | done
    value = after.paid - config.num_outputs * spent
    paid = jnp.where(pays, value, state.paid)
    reward = config.reward_scale * (paid - state.paid)
    given = vars(after) | {"paid": paid, "spent": spent}
    return TravelState(**given), reward, done


def look(network: Network, state: TravelState) -> View:
    """The network's view of a batch of sets, tolls included."""
    return network.look(  # type: ignore[call-arg]  # a TravelNetwork
        state.candidates, state.available, state.tolls, state.entry
    )


def toll_of(tolls: jax.Array, entry: jax.Array, chosen: jax.Array) -> jax.Array:
    """(...,) tolls of visiting ``chosen`` (..., K) in that order."""
    first = jnp.take_along_axis(entry, chosen[..., :1], axis=-1)[..., 0]
    rows = jnp.take_along_axis(tolls, chosen[..., :-1, None], axis=-2)
    moves = jnp.take_along_axis(rows, chosen[..., 1:, None], axis=-1)[..., 0]
    return first + moves.sum(-1)
