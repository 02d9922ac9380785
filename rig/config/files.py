"""A TOML configuration, checked as a whole: every fault is listed at once."""

from __future__ import annotations

import pathlib
from collections.abc import Iterator
from typing import Any

from rig.config.axis import AXIS_NAMES, DEFAULT_ROTATES
from rig.config.config import RigConfig
from rig.config.schema import ConfigError, parse, read_text

EXAMPLES = pathlib.Path(__file__).parent.parent / "examples"


def load_config(path: str | pathlib.Path) -> RigConfig:
    """Read and check a configuration file; ConfigError lists every fault."""
    return parse_config(read_text(path), pathlib.Path(path).parent, str(path))


def parse_config(
    text: str, folder: pathlib.Path | None = None, source: str = "configuration"
) -> RigConfig:
    """Check the text of a configuration; maps by path are relative to ``folder``."""
    config = parse(RigConfig, text, source, {"folder": folder}, _repeated)
    axes = sorted(config.axes, key=lambda axis: AXIS_NAMES.index(axis.name))
    config = config.model_copy(update={"axes": tuple(axes)})
    config._folder = folder or pathlib.Path()
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


def example_names() -> list[str]:
    """Names of the configurations that ship."""
    return sorted(path.stem for path in EXAMPLES.glob("*.toml"))


def example_text(name: str) -> str:
    """Text of a configuration that ships; ConfigError where none has the name."""
    if name not in example_names():
        raise ConfigError(name, [f"no such example: have {', '.join(example_names())}"])
    return (EXAMPLES / f"{name}.toml").read_text(encoding="utf-8")
