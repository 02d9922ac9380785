"""What an environment must offer to be trained on; the trainer knows no other."""

from __future__ import annotations

from typing import Any, Protocol

import jax

__all__ = ["Rules"]


class Rules(Protocol):
    """What the trainer needs of an environment.

    A state is a tree of arrays; three of its leaves are ``candidates`` (M, n),
    ``available`` (M,) bool and ``chosen`` (K,) int, -1 where nothing is chosen yet.
    """

    def __hash__(self) -> int:
        """It is static to ``jit``."""

    @property
    def random_starts(self) -> float:
        """Share of episodes begun with random choices."""

    @property
    def num_decisions(self) -> int:
        """K, choices of an episode."""

    @property
    def value_scale(self) -> float:
        """Reward for a unit of the network's value."""

    def reset(self, key: jax.Array) -> Any:
        """The state of a new episode."""

    def step(self, state: Any, action: jax.Array) -> tuple[Any, jax.Array, jax.Array]:
        """The next state, () reward, () bool done."""

    def paid(self, state: Any) -> jax.Array:
        """() reward received already of what the network's value predicts."""

    def outcome(self, state: Any) -> jax.Array:
        """() what a finished episode is judged by."""
