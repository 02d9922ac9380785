"""A function of numpy arrays inside a compiled program."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental.buffer_callback import buffer_callback


def on_host(
    function: Callable[..., Any], result: jax.ShapeDtypeStruct, *arrays: Any
) -> jax.Array:
    """``function(*arrays)`` on the host, of numpy arrays.

    Under ``vmap`` arrays get leading axes that broadcast (``expand_dims``).
    On a CPU the function reads the program's own memory and must not keep it:
    ``pure_callback`` copies its arguments on the thread pool, and on a single core it
    deadlocks, because the pool's only thread is the one waiting for the copy.

    Args:
        function: returns an array of the result's shape and type.
        result: without the axes of ``vmap``.
        arrays: its arguments.
    """
    if jax.default_backend() != "cpu":  # memory that numpy cannot read
        copied: jax.Array = jax.pure_callback(
            function, result, *arrays, vmap_method="expand_dims"
        )
        return copied

    def call(context: Any, out: Any, *buffers: Any) -> None:
        np.asarray(out)[...] = function(*map(np.asarray, buffers))

    call_host = buffer_callback(call, result, vmap_method="expand_dims")
    answer: jax.Array = call_host(*arrays)
    return answer
