"""Optional dependencies: one message where an extra is not installed."""

from __future__ import annotations

import contextlib
import importlib.metadata
import platform
from collections.abc import Iterator

__all__ = ["MissingExtraError", "needs", "versions"]

_COMPUTE = ("jaxcal", "numpy", "scipy", "jax", "jaxlib", "flax", "optax")


class MissingExtraError(ImportError):
    """A package of an extra is not installed; the message names the command."""


@contextlib.contextmanager
def needs(extra: str, purpose: str) -> Iterator[None]:
    """Imports inside the block belong to an extra of jaxcal.

    Args:
        extra: "live", "models", "policy", "rig", "ros" or "study".
        purpose: what needs it, as the subject of a sentence: ``'method="policy"'``.

    Raises:
        MissingExtraError: one of them is not installed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "jaxcal", "rig"):
            raise
        raise MissingExtraError(
            f"{purpose} needs {package}, which is not installed: "
            f"pip install 'jaxcal[{extra}]'",
            name=error.name,
        ) from error


def versions() -> dict[str, str]:
    """What computed a result: Python and the packages that matter, where installed."""
    found = {"python": platform.python_version()}
    for name in (*_COMPUTE, "orbax-checkpoint"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found
