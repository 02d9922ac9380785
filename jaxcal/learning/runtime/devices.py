"""One update over many devices: each plays some candidate sets and has all weights.

Keys are split for every set of the whole job before anything is placed, so an update
draws the same numbers on one device and on many; only the order of sums differs. With
several seeds each device trains some of them. Process 0 alone reads and writes files.
"""

from __future__ import annotations

import contextlib
import os
import pickle
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxcal.learning.runtime.processes import collective

T = TypeVar("T")


def make_mesh(
    rows: int, num_devices: int | None = None, num_seeds: int = 1
) -> Mesh | None:
    """All devices of the job on the axis ``sets``, or ``seeds`` if several are trained;
    None for one device. ``num_devices`` of each process, all when None, that do not
    divide the rows of a minibatch, or the seeds, evenly are refused."""
    have = jax.local_device_count()
    number = have if num_devices is None else num_devices
    if not 1 <= number <= have:
        raise ValueError(f"devices must be in [1, {have}], got {num_devices}")
    processes = range(jax.process_count())
    chosen = [d for i in processes for d in jax.local_devices(i)[:number]]
    if len(chosen) == 1:
        return None
    axis, shared = ("seeds", num_seeds) if num_seeds > 1 else ("sets", rows)
    if shared % len(chosen):
        fewer = max(n for n in range(1, len(chosen)) if shared % n == 0)
        what = {
            "seeds": "--seeds",
            "sets": "episodes_per_update / (episodes_per_set x num_minibatches), or of "
            "a task decisions_per_update / (stream_length x num_minibatches),",
        }[axis]
        raise ValueError(
            f"{what} must be a multiple of the {len(chosen)} devices, got {shared}; "
            f"use {fewer} devices (--devices {fewer})"
        )
    return Mesh(np.asarray(chosen), (axis,))


def a_device_for_each_core(num_seeds: int) -> None:
    """Make CPU cores devices of JAX, as many as divide ``num_seeds``: each then trains
    its own. Does nothing where JAX is initialised or ``XLA_FLAGS`` sets the number."""
    if "xla_force_host_platform_device_count" in os.environ.get("XLA_FLAGS", ""):
        return
    cores = range(1, (os.cpu_count() or 1) + 1)
    number = max(core for core in cores if num_seeds % core == 0)
    with contextlib.suppress(RuntimeError):
        jax.config.update("jax_num_cpu_devices", number)


def describe(mesh: Mesh | None) -> str:
    """The devices in words: "cpu", "8 x NVIDIA H100 in 2 processes"."""
    number, processes = "" if mesh is None else f"{mesh.size} x ", jax.process_count()
    where = f" in {processes} processes" if processes > 1 else ""
    return f"{number}{jax.devices()[0].device_kind}{where}"


def is_first() -> bool:
    """Whether this process writes, prints and validates for all."""
    return jax.process_index() == 0


def on_first(function: Callable[[], T]) -> T:
    """Call on process 0 alone; every process gets the result, which can be pickled, or
    raises the same ValueError or OSError."""
    if jax.process_count() == 1:
        return function()
    answer: Any = None
    if is_first():
        try:
            answer = function()
        except (ValueError, OSError) as error:
            answer = error
    data = np.frombuffer(pickle.dumps(answer), np.uint8)
    broadcast = multihost_utils.broadcast_one_to_all
    with collective():
        size = int(broadcast(np.int32(data.size)))  # of the first; others send nothing
        data = np.asarray(broadcast(np.resize(data, size)), np.uint8)
    answer = pickle.loads(data.tobytes())
    if isinstance(answer, Exception):
        raise answer
    return answer


def any_process(flag: bool) -> bool:
    """Whether the flag is set in any process; all processes must ask."""
    if jax.process_count() == 1:
        return flag
    with collective():
        return bool(multihost_utils.process_allgather(np.asarray(flag)).any())


def replicate(tree: Any, mesh: Mesh | None, *axes: str) -> Any:
    """Copy arrays that are the same in every process to every device of the mesh; with
    ``axes`` their leading axes are spread over those of the mesh."""
    if mesh is None:
        return tree
    spread = PartitionSpec(*(axis for axis in axes if axis in mesh.axis_names))
    sharding = NamedSharding(mesh, spread)

    def put(leaf: Any) -> jax.Array:
        plain = np.asarray(leaf)
        return jax.make_array_from_callback(plain.shape, sharding, plain.__getitem__)

    return jax.tree.map(put, tree)


def local(tree: Any) -> Any:
    """This process's copy of replicated values, on its first device."""
    return jax.tree.map(
        lambda leaf: leaf if len(leaf.devices()) == 1 else leaf.addressable_data(0),
        tree,
    )
