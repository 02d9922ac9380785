"""JAX's cache of compiled code on disk, so that a second command starts sooner.

Only commands turn it on; a program that imports jaxcal keeps its own settings.
"""

from __future__ import annotations

import os
import pathlib
import sys


def keep_compiled_programs() -> None:
    """Have JAX cache compiled code on disk: in the folder that the user has set, else
    in ``jaxcal/jax`` under ``XDG_CACHE_HOME`` or ``~/.cache``. Does not load JAX."""
    # jaxlib 0.10.1 logs an error for each program that it takes from the cache if the
    # processor has hints that XLA does not list as features; the results are correct.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # read when JAX is loaded
    home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    settings = {
        "jax_compilation_cache_dir": str(pathlib.Path(home) / "jaxcal" / "jax"),
        # Small programs too: a start has a hundred of them.
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_persistent_cache_min_entry_size_bytes": 0,
    }
    for name, value in settings.items():
        os.environ.setdefault(name.upper(), str(value))  # read when JAX is loaded
        jax = sys.modules.get("jax")
        if jax and not (name.endswith("dir") and getattr(jax.config, name)):
            jax.config.update(name, value)
