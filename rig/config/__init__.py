"""What rig.toml and a register map may say, and what is wrong with one that does not.

``settings``, ``axis`` and ``maps`` are the schemas, one field a key; ``schema`` words
the faults; ``config`` reads. (n,) arrays are in the order of the axes.
"""

from rig.config.axis import AXIS_NAMES
from rig.config.config import RigConfig, example_text, load_config, parse_config
from rig.config.schema import ConfigError

__all__ = [
    "AXIS_NAMES",
    "ConfigError",
    "RigConfig",
    "example_text",
    "load_config",
    "parse_config",
]
