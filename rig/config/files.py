"""A TOML configuration, checked as a whole: every fault is listed at once."""

from __future__ import annotations

import pathlib
import tomllib
from collections.abc import Iterator
from typing import Any

from rig.config.axis import AXIS_NAMES, DEFAULT_ROTATES
from rig.config.config import RigConfig
from rig.config.schema import validated

EXAMPLES = pathlib.Path(__file__).parent.parent / "examples"


class ConfigError(ValueError):
    """The configuration is not usable; ``faults`` lists all that is wrong."""

    def __init__(self, source: str, faults: list[str]) -> None:
        self.faults = faults
        count = f"{len(faults)} fault{'s' if len(faults) > 1 else ''}"
        lines = "".join(f"\n  - {fault}" for fault in faults)
        super().__init__(f"{source}: {count}{lines}")


def load_config(path: str | pathlib.Path) -> RigConfig:
    """Read and check a configuration file.

    Raises:
        ConfigError: unreadable, not TOML, or wrong; lists every fault.
    """
    path = pathlib.Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(str(path), [f"cannot be read: {reason}"]) from None
    return parse_config(text, path.parent, str(path))


def parse_config(
    text: str, folder: pathlib.Path | None = None, source: str = "configuration"
) -> RigConfig:
    """Check the text of a configuration; maps by path are relative to ``folder``."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(source, [f"not valid TOML: {error}"]) from None
    config, faults = validated(RigConfig, data, {"folder": folder})
    faults += _repeated(data)
    if faults or config is None:
        raise ConfigError(source, faults)
    axes = sorted(config.axes, key=lambda axis: AXIS_NAMES.index(axis.name))
    config = config.model_copy(update={"axes": tuple(axes)})
    config._text = text
    return config


def _repeated(data: dict[str, Any]) -> Iterator[str]:
    """Names, units and letters that axes share; told even beside other faults."""
    given = data.get("axes")
    axes = [a for a in given if isinstance(a, dict)] if isinstance(given, list) else []
    axes = [{"rotates": DEFAULT_ROTATES.get(str(a.get("name"))), **a} for a in axes]
    for name in ("name", "unit", "rotates"):
        values = [str(a[name]) for a in axes if a.get(name) is not None]
        if len(set(values)) < len(values):
            yield f"axes: {name} must differ between the three, got {', '.join(values)}"


def example_text(name: str) -> str:
    """Text of an example configuration that ships.

    Raises:
        ConfigError: there is none of that name.
    """
    known = sorted(path.stem for path in EXAMPLES.glob("*.toml"))
    if name not in known:
        raise ConfigError(name, [f"no such example: have {', '.join(known)}"])
    return (EXAMPLES / f"{name}.toml").read_text(encoding="utf-8")
