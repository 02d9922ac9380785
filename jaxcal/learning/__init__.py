"""Training: ``core`` is the whole of it, pure; the other packages stand around it."""

from __future__ import annotations

from typing import Any

__all__ = ["make_train"]


def make_train(config: Any) -> Any:
    """A whole training as one pure function; see ``core.ppo.make_train``.

    Inference without JAX imports this package too, so JAX is loaded here and no sooner.
    """
    from jaxcal.learning.core import ppo

    return ppo.make_train(config)
