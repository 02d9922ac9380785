"""Selection by a trained policy: the shipped one in numpy, others by JAX."""

from jaxcal.selection.policy.api import DECODINGS, load_policy, select_batch

__all__ = ["DECODINGS", "load_policy", "select_batch"]
