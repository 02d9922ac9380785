"""From a configuration to its network: ``compact``, or what a package adds."""

from __future__ import annotations

from jaxcal.learning.core.network import Network
from jaxcal.learning.policies.compact import CompactNetwork
from jaxcal.learning.policies.networks import GROUP, NetworkConfig
from jaxcal.learning.settings import installed

__all__ = ["build"]


def build(config: NetworkConfig) -> Network:
    """The network that a configuration names, as a flax module."""
    if config.kind == "compact":
        return CompactNetwork(config)
    network: Network = installed(GROUP)[config.kind].load()(config)
    return network
