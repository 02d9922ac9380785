"""A session of sequential measurement: what is left, what may come next, the protocols.

A *task* says what is unknown, what may be measured, with what outcomes and at what
cost. A *belief* is what is known of the unknown. A *decider* picks the next
measurement. All three are pytrees, so they are arguments of compiled functions (tables
closed over by a jitted function have given wrong results on the CPU) and ``jax.vmap``
plays thousands of sessions at once.
"""

from __future__ import annotations

import functools
import hashlib
import re
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import jax
import numpy as np
from flax import struct
from jax.experimental.buffer_callback import buffer_callback

_ROUNDING = 1e-4  # of a cost: sums of float32 may miss the budget by less


def jit_by_class(
    function: Callable[..., Any], *, static_argnums: Sequence[int] = ()
) -> Callable[..., Any]:
    """``jax.jit`` of f(*arguments), compiled for each combination of their classes.

    JAX (0.10.1 to 0.12.0 alike) holds dataclasses with as many fields for equal
    structures, whatever their classes, and where their hashes fall together runs what
    was compiled for the other: ``Gain`` was played by ``Random``. So the classes of all
    nodes, a task's model among them, are a static argument, which is compared well.
    """

    def of_classes(classes: tuple[Any, ...], *arguments: Any) -> Any:
        return function(*arguments)

    of_classes.__name__ = function.__name__
    static = (0, *(number + 1 for number in static_argnums))
    compiled = jax.jit(of_classes, static_argnums=static)

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        return compiled(_classes(jax.tree.structure(arguments)), *arguments)

    return call


def _classes(structure: jax.tree_util.PyTreeDef) -> tuple[Any, ...]:
    """The classes of a structure's nodes, nested as the nodes are."""
    node = structure.node_data()
    return (node and node[0], *map(_classes, structure.children()))


def fingerprint(tree: Any) -> str:
    """A hash of a task or a decider: its tables, its numbers and its kind."""
    leaves, structure = jax.tree.flatten(tree)
    digest = hashlib.sha256(re.sub(r" at 0x[0-9a-f]+", "", str(structure)).encode())
    for leaf in leaves:
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def on_host(
    function: Callable[..., Any], result: jax.ShapeDtypeStruct, *arrays: Any
) -> jax.Array:
    """``function(*arrays)`` on the host, of numpy arrays: an array of the shape and
    type of ``result``, which is without the axes of ``vmap``.

    Under ``vmap`` arrays get leading axes that broadcast (``expand_dims``).
    On a CPU the function reads the program's own memory and must not keep it:
    ``pure_callback`` copies its arguments on the thread pool, and on a single core it
    deadlocks, because the pool's only thread is the one waiting for the copy.
    """
    if jax.default_backend() != "cpu":  # memory that numpy cannot read
        return jax.pure_callback(function, result, *arrays, vmap_method="expand_dims")

    def call(context: Any, out: Any, *buffers: Any) -> None:
        np.asarray(out)[...] = function(*map(np.asarray, buffers))

    return buffer_callback(call, result, vmap_method="expand_dims")(*arrays)


@struct.dataclass
class Session:
    """State of one session, besides its belief."""

    place: Any  # where the machine is, in the task's own terms
    seconds: jax.Array  # () left; inf where time does not count
    uses: jax.Array  # () int32 left of what is countable, such as trips
    made: jax.Array  # () int32 measurements made

    @property
    def spent(self) -> jax.Array:
        """() bool: no time or no uses are left."""
        return (self.seconds <= 0.0) | (self.uses <= 0)


def pays(seconds: Any, cost: Any) -> Any:
    """(...) bool: a cost fits into the seconds that are left."""
    return (1.0 - _ROUNDING) * cost <= seconds


@struct.dataclass
class Options:
    """The A measurements that may come next."""

    designs: Any  # leaves (A, ...), in the task's own terms; a decider returns an index
    seconds: jax.Array  # (A,) until each is measured, whatever the outcome
    allowed: jax.Array  # (A,) bool


class SequentialTask(Protocol):
    """What is measured. ``GridTask`` and ``ParticleTask`` are the two kinds."""

    @property
    def horizon(self) -> int:
        """Measurements after which a session ends in any case."""

    def draw(self, key: jax.Array) -> Any:
        """The truth of one session, from the prior."""

    def begin(self, key: jax.Array) -> tuple[Any, Session]:
        """The belief and the state at the start of a session."""

    def over(self, session: Session) -> jax.Array:
        """() bool: the session has ended, or nothing that may follow can be paid."""

    def options(self, belief: Any, session: Session, key: jax.Array) -> Options:
        """What may be measured next; what the budget cannot pay is not allowed."""

    def measure(self, truth: Any, design: Any, key: jax.Array) -> Any:
        """An outcome, drawn."""

    def spend(self, session: Session, design: Any, outcome: Any) -> Session:
        """The session after a measurement."""

    def expected(
        self, belief: Any, session: Session, options: Options
    ) -> tuple[jax.Array, jax.Array]:
        """(A,) seconds and (A,) uses that each measurement is expected to take."""


class Decider(Protocol):
    """Picks the next measurement; a pytree, its numbers are leaves."""

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        """() int32 index of an allowed option."""
