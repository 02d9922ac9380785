"""Which parameters a set of candidates can identify, in the model's own names."""

from __future__ import annotations

from typing import Any

__all__ = ["identifiability"]


def identifiability(*args: Any, **kwargs: Any) -> Any:
    raise NotImplementedError("identifiability is being written")
