"""Selection by a trained policy: the shipped one in numpy, others by JAX."""

from jaxcal.selection.policy.by_checkpoint import (
    DECODINGS,
    choose,
    load_policy,
    select_batch,
)

__all__ = ["DECODINGS", "choose", "load_policy", "select_batch"]
