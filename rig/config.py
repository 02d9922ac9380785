"""A TOML configuration, checked as a whole: every fault is listed at once."""

from __future__ import annotations

import pathlib
import tomllib
from typing import Any

from rig.attitude import ORDERS
from rig.drives import motion_counts
from rig.sections import (
    read_axes,
    read_bus,
    read_imu,
    read_motion,
    read_session,
    read_settle,
)
from rig.settings import Axis, BusSettings, MotionSettings, RigConfig
from rig.tables import Table

__all__ = ["EXAMPLES", "ConfigError", "load_config", "parse_config"]

EXAMPLES = pathlib.Path(__file__).parent / "examples"


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
    faults: list[str] = []
    root = Table(data, "", faults)
    bus = read_bus(root.table("bus"))
    motion = read_motion(root.table("motion", required=False))
    axes = read_axes(root, folder)
    imu = read_imu(root.table("imu"))
    mechanism = root.table("mechanism", required=False)
    order = mechanism.choice("order", ORDERS, "ZXY")
    mechanism.end()
    settle = read_settle(root.table("settle", required=False))
    session = read_session(root.table("session", required=False), axes, motion)
    output = pathlib.Path(root.text("output", "runs"))
    root.end()
    if not faults:
        _cross_checks(axes, bus, motion, faults)
    if faults:
        raise ConfigError(source, faults)
    return RigConfig(
        bus, (axes[0], axes[1], axes[2]), imu, order, settle, motion, session,
        output, text,
    )  # fmt: skip


def _cross_checks(
    axes: list[Axis], bus: BusSettings, motion: MotionSettings, faults: list[str]
) -> None:
    for axis in axes:
        at = f"axes.{axis.name}"
        for end in (axis.min_deg, axis.max_deg):
            pulses = axis.scale.to_pulses(end)
            if not axis.min_pulses <= pulses <= axis.max_pulses:
                faults.append(
                    f"{at}: {end} deg is {pulses} pulses, outside min_pulses.."
                    f"max_pulses ({axis.min_pulses}..{axis.max_pulses})"
                )
        try:
            motion_counts(axis, axis.speed_deg_s)
        except ValueError as error:
            faults.append(f"{at}: {error}")
        if abs(1.0 / axis.scale.pulses_per_deg) > motion.position_tolerance_deg:
            faults.append(
                f"{at}: one pulse is coarser than motion.position_tolerance_deg"
            )
        if axis.comm_timeout_s is not None:
            slowest = bus.timeout_s * (bus.read_retries + 1)
            if not axis.map.comm_timeout:
                faults.append(
                    f"{at}.comm_timeout_s: the map {axis.map.name} has no register "
                    "for it; set it with the maker's tool"
                )
            elif axis.comm_timeout_s <= slowest:
                faults.append(
                    f"{at}.comm_timeout_s must exceed bus.timeout_s x "
                    f"(read_retries + 1) = {slowest:g} s"
                )
        if motion.mirror_limits and not axis.map.limits:
            faults.append(
                f"motion.mirror_limits: the map {axis.map.name} of {axis.name} has no "
                "limit registers"
            )


def example_text(name: str) -> str:
    """Text of an example configuration that ships.

    Raises:
        ConfigError: there is none of that name.
    """
    path = EXAMPLES / f"{name}.toml"
    known: list[Any] = sorted(p.stem for p in EXAMPLES.glob("*.toml"))
    if name not in known:
        raise ConfigError(name, [f"no such example: have {', '.join(known)}"])
    return path.read_text(encoding="utf-8")
