"""Training: the pure algorithm in ``core``, environments, policies and runs."""

from __future__ import annotations

from typing import Any

__all__ = ["make_train"]


def make_train(config: Any) -> Any:
    """A whole training as one pure function; see ``core.ppo.make_train``.

    JAX is imported here, because inference without JAX imports this package too.
    """
    from jaxcal.learning.core import ppo

    return ppo.make_train(config)
