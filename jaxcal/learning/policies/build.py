"""The network that a configuration names."""

from __future__ import annotations

import dataclasses
from typing import Any

from jaxcal.extras import installed
from jaxcal.learning.config import named
from jaxcal.learning.core.network import Network
from jaxcal.learning.policies.compact import CompactNetwork
from jaxcal.learning.policies.networks import GROUP, NetworkConfig


def build(config: NetworkConfig) -> Network:
    """The network that a configuration names: ``compact``, one's own, a package's."""
    if config.kind == "compact":
        return CompactNetwork(config)
    if ":" in config.kind:
        kind = named(config.kind)
        if not (isinstance(kind, type) and issubclass(kind, Network)):
            raise ValueError(f"kind must be a Network, got {config.kind}")
        fields = [field.name for field in dataclasses.fields(kind)]
        arguments: dict[str, Any] = {"config": config} if "config" in fields else {}
        instance: Network = kind(**arguments)
        return instance
    network: Network = installed(GROUP)[config.kind].load()(config)
    return network
