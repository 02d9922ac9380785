"""A fixed sequence of measurements, the best that can be planned before a session."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxcal.adaptive.episodes import play
from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.session import Options, Session
from jaxcal.checks import whole_number

__all__ = ["Static", "optimise"]

Sequence = np.ndarray[Any, np.dtype[np.int32]]


@struct.dataclass
class Static:
    """One sequence of designs, whatever they answer."""

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
    episodes: int = 256,
    starts: int = 1,
    sweeps: int = 2,
    seed: int = 0,
    report: Callable[[int, int, float], None] = lambda done, of, nats: None,
) -> Static:
    """A sequence that gains much over the prior, by exchange of its entries.

    Every sequence plays the same sessions. The first start grows by the design that
    then gains most, the others are drawn; each entry is then exchanged for the best of
    all designs, in sweeps, until none changes. The best of all starts is kept.

    Args:
        task: of finitely many designs.
        length: entries; ``task.horizon`` by default.
        episodes: sessions that judge a sequence.
        starts, sweeps: number of starts; most sweeps of each.
        seed: of the sessions and starts.
        report: called after each entry with how many are done, of how many, and nats.
    """
    length = whole_number("length", task.horizon if length is None else length, 1)
    for name, value in (("episodes", episodes), ("starts", starts)):
        whole_number(name, value, 1)
    keys = jax.random.split(jax.random.key(seed), episodes)
    rng = np.random.default_rng(seed)
    count = len(task.designs)
    designs = np.arange(count)
    total = (starts * sweeps + 1) * length
    done, best, best_nats = 0, np.zeros(length, np.int32), -np.inf

    def exchanged(sequence: Sequence, entries: slice) -> tuple[Sequence, float]:
        """The best sequence with one design in all of ``entries``."""
        tried = np.repeat(sequence[None], count, axis=0)
        tried[:, entries] = designs[:, None]
        values = [_nats(task, row, keys) for row in tried]
        at = int(np.argmax(values))
        return tried[at], values[at]

    for start in range(starts):
        sequence = rng.integers(count, size=length).astype(np.int32)
        nats = -np.inf
        for sweep in range(-1 if start == 0 else 0, sweeps):
            before = sequence
            for entry in range(length):
                # While it grows, what is not chosen yet repeats the last entry.
                entries = slice(entry, length if sweep < 0 else entry + 1)
                sequence, nats = exchanged(sequence, entries)
                done += 1
                report(done, total, nats)
            if sweep >= 0 and (before == sequence).all():
                break
        if nats > best_nats:
            best, best_nats = sequence, nats
    return Static(tuple(int(design) for design in best))


def _nats(task: GridTask, sequence: Sequence, keys: jax.Array) -> float:
    return float(play(task, Static(jnp.asarray(sequence)), keys).gain.mean())
