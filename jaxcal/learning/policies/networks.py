"""Configuration of a network of postures, and the kinds of network there are.

A network of one's own is a ``core.network.Network``, or its name: ``module:Name`` or
``file.py:Name``; it has this configuration if it has a field ``config``. An installed
package adds a kind by an entry point in the group ``jaxcal.networks``.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from jaxcal.extras import installed
from jaxcal.learning.config import named, path_of, require, setting

if TYPE_CHECKING:
    from jaxcal.learning.core.network import Network

GROUP = "jaxcal.networks"
_COMPACT = "jaxcal.learning.policies.compact:CompactNetwork"


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Which network, and its size."""

    kind: str = setting(
        "compact", "compact, paper, observation, MODULE:NAME or FILE.py:NAME"
    )
    width: int = setting(32, "features per candidate; for paper, hidden width")
    encoder_rounds: int = setting(3, "message rounds over the whole set, for each set")
    decoder_rounds: int = setting(
        1, "message rounds over the remaining candidates, for each decision"
    )
    lookahead: int = setting(12, "largest number of greedy choices ahead in a feature")
    close_up: bool = setting(False, "features that separate near-equal look-aheads")
    initial_trust: float = setting(
        0.0, "initial weight of the look-ahead; with 4 training starts at its rule"
    )
    initial_actor: float = setting(0.1, "scale of the learned score at the start")
    mirrored: bool = setting(
        False, "for observation: choose by the mean over a set's mirror images"
    )

    def __post_init__(self) -> None:
        kind: Any = self.kind
        if isinstance(kind, type):
            object.__setattr__(self, "kind", path_of(kind))
        installs = self.kind != "compact" and ":" not in self.kind
        if installs and self.kind not in installed(GROUP):
            kinds = ", ".join(["compact", *installed(GROUP)])
            raise ValueError(
                f"kind must be one of {kinds}, got {self.kind!r}; name your own as "
                "MODULE:NAME or FILE.py:NAME, or as an entry point in the group "
                f"{GROUP}"
            )
        require(self, "at least 1", lambda v: v >= 1, "width", "lookahead")
        rounds = ("encoder_rounds", "decoder_rounds")
        require(self, "0 or more", lambda v: v >= 0, *rounds)


def build(config: NetworkConfig) -> Network:
    """The network that a configuration names: ``compact``, one's own, a package's."""
    from jaxcal.learning.core.network import Network

    path = _COMPACT if config.kind == "compact" else config.kind
    kind: Any = named(path) if ":" in path else installed(GROUP)[path].load()
    if not (isinstance(kind, type) and issubclass(kind, Network)):
        raise ValueError(f"kind must be a Network, got {config.kind}")
    fields = [field.name for field in dataclasses.fields(kind)]
    arguments: dict[str, Any] = {"config": config} if "config" in fields else {}
    return kind(**arguments)
