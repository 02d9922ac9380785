"""Schemas of rig.toml and of register maps, one field a key, and faults in words."""

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
