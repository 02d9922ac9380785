"""Whole programs kept on disk: the compiled code, with the weights it works on.

JAX's own cache spares a second process the compiling. Before it can be asked, the
process has imported flax and orbax, read the checkpoint and traced the network, which
takes longer than all the rest of a decision. A program kept here needs JAX alone.

Programs are kept beside those of JAX's cache; where that is turned off, none is. They
are kept on a single CPU device only: what the runtime of an accelerator writes was not
tried here.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import pathlib
import pickle
import platform
import secrets
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import numpy as np
from jax.experimental import serialize_executable

import jaxcal
from jaxcal.files import atomic_write
from jaxcal.learning.runtime import cache

__all__ = ["Program", "are_kept", "load", "make", "name_of"]

_MOST = 64  # programs kept; the one used longest ago goes first
_DIGEST = 32  # bytes of SHA-256 in front of a file


class Program:
    """A compiled function of its weights and of arguments of fixed shapes."""

    def __init__(
        self, function: Callable[..., Any], weights: Any, facts: Mapping[str, Any]
    ) -> None:
        self.facts = dict(facts)
        self._function = function
        self._weights = jax.device_put(weights)

    def __call__(self, *arguments: Any) -> Any:
        """Run it."""
        return self._function(self._weights, *arguments)


def name_of(*what: Any) -> str:
    """The name under which a program is kept: a hash of all that it depends on.

    Besides ``what`` these are the sources of jaxcal.learning, the versions of JAX, its
    configuration and XLA's flags, and the processor.
    """
    settings = sorted(
        (name, repr(value))
        for name, value in jax.config.values.items()
        if "cache" not in name
    )
    environment = (jaxcal.__version__, jax.__version__, jax.lib.__version__)
    flags = [os.environ.get(name, "") for name in ("XLA_FLAGS", "LIBTPU_INIT_ARGS")]
    whole = (what, environment, settings, flags, _processor(), _sources())
    return hashlib.sha256(repr(whole).encode()).hexdigest()


def are_kept() -> bool:
    """Whether programs are kept here at all."""
    return _path("any") is not None


def load(name: str) -> Program | None:
    """The program of a name; None where it is not kept, or is not whole."""
    path = _path(name)
    if path is None:
        return None
    try:
        # It holds code: only what nobody else could have written is run.
        state = path.stat()
        if hasattr(os, "getuid") and (
            state.st_uid != os.getuid() or state.st_mode & 0o022
        ):
            return None
        data = path.read_bytes()
        body = memoryview(data)[_DIGEST:]
        if hashlib.sha256(body).digest() != data[:_DIGEST]:
            return None
        program = _read(body)
    except FileNotFoundError:
        return None
    except Exception:  # whatever is wrong with it, it can be made again
        return None
    with contextlib.suppress(OSError):
        os.utime(path)
    return program


def make(
    name: str,
    function: Callable[..., Any],
    weights: Any,
    arguments: tuple[jax.ShapeDtypeStruct, ...],
    facts: Mapping[str, Any],
    *,
    donate: bool = False,
) -> Program:
    """Compile a program and keep it.

    Args:
        name: from ``name_of``.
        function: called with the weights and then the arguments.
        weights: a tree of arrays.
        arguments: their shapes and types.
        facts: what else its user needs to know, plain values.
        donate: whether the arguments are given up to the results.
    """
    given_up = tuple(range(1, 1 + len(arguments))) if donate else ()
    path = _path(name)
    if path is None:
        lowered = jax.jit(function, donate_argnums=given_up).lower(weights, *arguments)
        compiled = lowered.compile()
        return Program(compiled, weights, facts)

    def anew(*given: Any) -> Any:
        return function(*given)

    # Under a name never used before, so that JAX's cache does not have it: code loaded
    # from one file cannot be written to another (jaxlib 0.10 leaves parts of it out).
    anew.__name__ = f"program_{secrets.token_hex(8)}"
    lowered = jax.jit(anew, donate_argnums=given_up).lower(weights, *arguments)
    with _not_in_jax_cache():
        compiled = lowered.compile()
    program = Program(compiled, weights, facts)
    # A cache that cannot be written is not an error: the next process compiles again.
    with contextlib.suppress(Exception):
        code, in_tree, out_tree = serialize_executable.serialize(compiled)
        held = {
            "code": code,
            "in_tree": in_tree,
            "out_tree": out_tree,
            "weights": jax.tree.map(np.asarray, weights),
            "facts": dict(facts),
        }
        body = pickle.dumps(held)
        if _agree(program, _read(body), arguments):
            _write(path, body)
    return program


@contextlib.contextmanager
def _not_in_jax_cache() -> Iterator[None]:
    """What is compiled inside is too quickly compiled to be written to JAX's cache."""
    name = "jax_persistent_cache_min_compile_time_secs"
    before = jax.config.values[name]
    jax.config.update(name, float("inf"))
    try:
        yield
    finally:
        jax.config.update(name, before)


def _read(body: bytes | memoryview) -> Program:
    held = pickle.loads(body)
    function = serialize_executable.deserialize_and_load(
        held["code"], held["in_tree"], held["out_tree"]
    )
    return Program(function, held["weights"], held["facts"])


def _agree(
    one: Program, other: Program, arguments: tuple[jax.ShapeDtypeStruct, ...]
) -> bool:
    """Whether two programs make the same of arguments drawn at random."""
    rng = np.random.default_rng(0)
    drawn = [rng.random(a.shape).round(3).astype(a.dtype) for a in arguments]
    pairs = zip(
        jax.tree.leaves(one(*drawn)), jax.tree.leaves(other(*drawn)), strict=True
    )
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def _write(path: pathlib.Path, body: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    with atomic_write(path) as file:
        if hasattr(os, "fchmod"):
            os.fchmod(file.fileno(), 0o600)  # whatever the umask allows
        file.write(hashlib.sha256(body).digest() + body)
    kept = sorted(path.parent.glob("*.program"), key=lambda p: p.stat().st_mtime)
    for old in kept[:-_MOST]:
        old.unlink(missing_ok=True)


def _path(name: str) -> pathlib.Path | None:
    """Where a program is kept; None where none is."""
    settings = jax.config.values
    if not settings["jax_enable_compilation_cache"] or settings["jax_disable_jit"]:
        return None
    if jax.default_backend() != "cpu" or jax.device_count() > 1:
        return None
    chosen = settings["jax_compilation_cache_dir"]
    if chosen is not None and "://" in chosen:
        return None
    folder = cache.cache_folder() if chosen is None else pathlib.Path(chosen)
    return folder / "programs" / f"{name}.program"


@functools.cache
def _sources() -> str:
    """Hash of the modules that programs are traced from."""
    found = hashlib.sha256()
    for path in sorted(pathlib.Path(__file__).parents[1].rglob("*.py")):
        found.update(path.read_bytes())
    return found.hexdigest()


@functools.cache
def _processor() -> str:
    """Code compiled for one processor may not run on another that shares the folder."""
    try:
        text = pathlib.Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    first = text.partition("\n\n")[0].splitlines()
    told = ("model name", "flags", "Features", "CPU part")
    return "\n".join(line for line in first if line.startswith(told))
