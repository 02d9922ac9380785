"""One update over many devices: candidate sets are spread, everything else is the same.

The mesh has one axis, ``sets``. Keys are split for every set of the whole job before
anything is placed, so an update draws the same numbers on one device and on many; only
the order of sums differs. The weights are on every device. With one device there is no
mesh and nothing here does anything. Process 0 alone reads and writes files: what it
read goes to the others through ``on_first``.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxcal.learning.runtime.processes import collective

__all__ = [
    "any_process",
    "describe",
    "is_first",
    "local",
    "make_mesh",
    "on_first",
    "replicate",
    "require_divisible",
]

T = TypeVar("T")


def make_mesh(num_devices: int | None = None) -> Mesh | None:
    """All devices of the job along the axis ``sets``; None for a single one.

    Args:
        num_devices: as many of each process; all when None.

    Raises:
        ValueError: a process has fewer.
    """
    have = jax.local_device_count()
    number = have if num_devices is None else num_devices
    if not 1 <= number <= have:
        raise ValueError(f"devices must be in [1, {have}], got {num_devices}")
    chosen: list[jax.Device] = []
    for process in range(jax.process_count()):
        chosen += [d for d in jax.devices() if d.process_index == process][:number]
    return Mesh(np.asarray(chosen), ("sets",)) if len(chosen) > 1 else None


def require_divisible(rows: int, mesh: Mesh | None) -> None:
    """Refuse a minibatch of ``rows`` sets or streams that the devices cannot share."""
    if mesh is not None and rows % mesh.size:
        fewer = max(n for n in range(1, mesh.size) if rows % n == 0)
        raise ValueError(
            "episodes_per_update / (episodes_per_set x num_minibatches), the sets of a "
            "minibatch (of a task decisions_per_update / (stream_length x "
            f"num_minibatches)), must be a multiple of the {mesh.size} devices, got "
            f"{rows}; change one of the three, or use {fewer} devices (--devices "
            f"{fewer})"
        )


def describe(mesh: Mesh | None) -> str:
    """The devices in words: "cpu", "8 x NVIDIA H100 in 2 processes"."""
    text = str(jax.devices()[0].device_kind)
    if mesh is not None:
        text = f"{mesh.size} x {text}"
    if jax.process_count() > 1:
        text += f" in {jax.process_count()} processes"
    return text


def is_first() -> bool:
    """Whether this process writes, prints and validates for all."""
    return jax.process_index() == 0


def on_first(function: Callable[[], T]) -> T:
    """Call on process 0 alone; every process gets the result, or raises the same error.

    Args:
        function: returns what can be pickled, arrays among it.

    Raises:
        ValueError, OSError: what ``function`` raised.
    """
    if jax.process_count() == 1:
        return function()
    answer: Any = None
    if is_first():
        try:
            answer = (True, function())
        except (ValueError, OSError) as error:
            answer = (False, error)
    data = np.frombuffer(pickle.dumps(answer), np.uint8)
    with collective():
        size = int(multihost_utils.broadcast_one_to_all(np.int32(data.size)))
        buffer = data if is_first() else np.zeros(size, np.uint8)
        data = np.asarray(multihost_utils.broadcast_one_to_all(buffer), np.uint8)
    fine, result = pickle.loads(data.tobytes())
    if not fine:
        raise result
    return result


def any_process(flag: bool) -> bool:
    """Whether the flag is set in any process; all processes must ask."""
    if jax.process_count() == 1:
        return flag
    with collective():
        return bool(multihost_utils.process_allgather(np.asarray(flag)).any())


def replicate(tree: Any, mesh: Mesh | None, *axes: str) -> Any:
    """Put arrays that every process holds alike on every device of the mesh.

    Leading axes that are named are spread over those of the mesh instead.
    """
    if mesh is None:
        return tree
    sharding = NamedSharding(mesh, PartitionSpec(*axes))

    def put(leaf: Any) -> jax.Array:
        plain = np.asarray(leaf)
        return jax.make_array_from_callback(
            plain.shape, sharding, lambda cut: plain[cut]
        )

    return jax.tree.map(put, tree)


def local(tree: Any) -> Any:
    """This process's copy of replicated values, on its first device."""
    return jax.tree.map(
        lambda leaf: leaf if len(leaf.devices()) == 1 else leaf.addressable_data(0),
        tree,
    )
