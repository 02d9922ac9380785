"""A fixed sequence of measurements, the best that can be planned before a session."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.play import play
from jaxcal.adaptive.session import Options, Session
from jaxcal.checks import whole_number

__all__ = ["Static", "optimise"]


@struct.dataclass
class Static:
    """The same designs in the same order, whatever they answer."""

    sequence: Any  # (T,) indices of designs; the last is repeated

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        sequence = jnp.asarray(self.sequence, jnp.int32)
        return sequence[jnp.minimum(session.made, len(sequence) - 1)]


def optimise(
    task: GridTask,
    *,
    length: int | None = None,
    episodes: int = 512,
    sweeps: int = 2,
    seed: int = 0,
    report: Callable[[int, int, float], None] = lambda done, of, nats: None,
) -> Static:
    """A sequence that gains much over the prior, by exchange of its entries.

    Sessions that the tuning plays are the same for every sequence. The sequence grows
    by the design that then gains most; each entry is then exchanged for the best of all
    designs, in sweeps, until none changes.

    Args:
        task: of finitely many designs.
        length: entries; ``task.most`` by default.
        episodes: sessions that judge a sequence.
        sweeps: at most so many.
        seed: of the sessions.
        report: called after each entry with how many are done, of how many, and nats.
    """
    length = whole_number("length", task.most if length is None else length, 1)
    whole_number("episodes", episodes, 1)
    keys = jax.random.split(jax.random.key(seed), episodes)
    count = len(task.designs)
    # Entries not yet chosen repeat the last one: it tells less and less.
    sequence = np.zeros(length, np.int32)
    nats = 0.0
    for sweep in range(sweeps + 1):
        before = sequence.copy()
        for entry in range(length):
            tried = np.repeat(sequence[None], count, axis=0)
            tried[:, entry:] = np.where(
                sweep == 0, np.arange(count)[:, None], tried[:, entry:]
            )
            tried[:, entry] = np.arange(count)
            values = [_nats(task, row, keys) for row in tried]
            sequence = tried[int(np.argmax(values))]
            nats = max(values)
            report(sweep * length + entry + 1, (sweeps + 1) * length, nats)
        if sweep and (before == sequence).all():
            break
    return Static(tuple(int(design) for design in sequence))


def _nats(task: GridTask, sequence: np.ndarray[Any, Any], keys: jax.Array) -> float:
    return float(play(task, Static(jnp.asarray(sequence)), keys).gain.mean())
