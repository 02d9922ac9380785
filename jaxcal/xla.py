"""One release of XLA whose CPU compiler gets sums wrong, and how jaxcal avoids it.

jaxlib 0.10.2 hands sums to a library that reads their operand wrongly where a broadcast
is fused with it (JAX issue 39103): results are silently wrong, from some size on.
0.10.1 is right. ``sidestep`` switches that fusion off.
"""

from __future__ import annotations

import functools
import os

import numpy as np

__all__ = ["require_sums", "sidestep"]

_FLAG = "--xla_cpu_experimental_ynn_fusion_type"


def sidestep() -> None:
    """Set the flag that avoids it, in ``XLA_FLAGS``: XLA reads them at its first use.

    A flag of the user's own is left alone. Without jaxlib there is nothing to do.
    """
    try:
        from jaxlib.version import __version__ as version
    except ImportError:
        return
    flags = os.environ.get("XLA_FLAGS", "")
    if version == "0.10.2" and _FLAG not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_FLAG}=-reduce".strip()


@functools.cache
def require_sums() -> None:
    """Compile a sum that is known to come out wrong, once a process.

    Raises:
        RuntimeError: it does; JAX had begun before jaxcal was imported.
    """
    import jax
    import jax.numpy as jnp

    unknowns = np.sin(np.arange(2048.0)).reshape(1024, 2)
    designs = np.array([[1.0, 2.0], [-1.0, 0.5]])

    @jax.jit
    def near(unknowns: jax.Array, designs: jax.Array) -> jax.Array:
        means = (unknowns[None] * designs[:, None]).sum(axis=-1)
        return jnp.exp(-((means[:, :, None] - means[:, None]) ** 2)).sum(axis=2)

    means = designs @ unknowns.T
    right = np.exp(-((means[:, :, None] - means[:, None]) ** 2)).sum(axis=2)
    found = near(jnp.asarray(unknowns), jnp.asarray(designs))
    if not np.allclose(found, right, rtol=1e-3):
        raise RuntimeError(
            "XLA of this process compiles sums wrongly (jaxlib 0.10.2, JAX issue "
            "39103), so gains would be wrong. Import jaxcal before JAX computes "
            f"anything, or set XLA_FLAGS={_FLAG}=-reduce"
        )
