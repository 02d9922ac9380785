"""Compiled programs are kept on disk, so that a second process starts at once."""

from __future__ import annotations

import os
import pathlib

import jax

__all__ = ["cache_folder", "keep_compiled_programs"]


def cache_folder() -> pathlib.Path:
    """Where programs are kept: XDG_CACHE_HOME or ~/.cache, then jaxcal/jax."""
    home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(home) / "jaxcal" / "jax"


def keep_compiled_programs() -> None:
    """Turn on JAX's persistent compilation cache, unless the user already chose one."""
    if getattr(jax.config, "jax_compilation_cache_dir", None) is None:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
    # Small programs too: a start has a hundred of them.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
