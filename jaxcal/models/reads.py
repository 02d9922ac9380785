"""Which entries of its arguments a JAX function reads.

JAX does not check indices: ``theta[7]`` of seven parameters is the last one. Tracing
the function with longer arguments shows what it would read.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

__all__ = ["entries_read", "inputs_needed"]

_LONGER = 1000  # entries more; one in the second half is counted from the end


def entries_read(
    f: Callable[[Any, Any], Any], sizes: tuple[int, int], argument: int
) -> int:
    """One more than the last index read of an argument, as far as it can be seen.

    0 where f does not take longer arguments, as when it unpacks them.
    """
    import jax

    longer = list(sizes)
    longer[argument] += _LONGER
    try:
        traced = jax.make_jaxpr(f)(*(np.zeros(size) for size in longer)).jaxpr
    except Exception:  # whatever f raises where a size does not fit
        return 0
    most = sizes[argument] + _LONGER // 2
    return _read(traced, traced.invars[argument], most)


def _read(traced: Any, variable: Any, most: int) -> int:
    last = 0
    for equation in traced.eqns:
        for i, used in enumerate(equation.invars):
            if used is not variable:
                continue
            inner = equation.params.get("jaxpr")
            inner = getattr(inner, "jaxpr", inner)
            if equation.primitive.name == "slice":
                end = equation.params["limit_indices"][0]
                last = max(last, end if end <= most else 0)
            elif inner is not None and len(inner.invars) == len(equation.invars):
                last = max(last, _read(inner, inner.invars[i], most))
    return last


def inputs_needed(f: Callable[[Any, Any], Any], num_parameters: int) -> int | None:
    """n of f(u (n,), theta), where it takes one size alone: it unpacks or multiplies.

    The last entry that f reads does not say: a column of the commands may be unused.
    """
    import jax

    fits = []
    for n in range(1, 33):
        try:
            jax.eval_shape(f, np.zeros(n), np.zeros(num_parameters))
        except Exception:  # whatever f raises where a size does not fit
            continue
        fits.append(n)
    return fits[0] if len(fits) == 1 else None
