"""The tables of a configuration, one function each; faults go to the table's list."""

from __future__ import annotations

import pathlib

from rig.attitude import ORDERS
from rig.registers import MapError, RegisterMap, load_map
from rig.settings import (
    AXIS_NAMES,
    Axis,
    BusSettings,
    ImuSettings,
    MotionSettings,
    SessionSettings,
    SettleSettings,
)
from rig.tables import Table
from rig.units import Scale

__all__ = [
    "read_axes",
    "read_bus",
    "read_imu",
    "read_motion",
    "read_session",
    "read_settle",
]

METHODS = ("policy", "auto", "exact", "exchange", "greedy", "random")


def read_bus(table: Table) -> BusSettings:
    """The ``[bus]`` table."""
    transport = table.choice("transport", ("tcp", "rtu_tcp", "rtu"))
    serial = transport == "rtu"
    result = BusSettings(
        transport=transport,
        host=table.text("host", "" if serial else None),
        port=table.integer("port", 1, 65535, 502),
        device=table.text("device", None if serial else ""),
        baudrate=table.integer("baudrate", 1200, 3_000_000, 115200),
        parity=table.choice("parity", ("N", "E", "O"), "N"),
        stopbits=table.integer("stopbits", 1, 2, 1),
        bytesize=table.integer("bytesize", 7, 8, 8),
        timeout_s=table.number("timeout_s", 0.01, 5.0, 0.3),
        read_retries=table.integer("read_retries", 0, 10, 2),
    )
    table.end()
    return result


def read_axes(root: Table, folder: pathlib.Path | None) -> list[Axis]:
    """The three ``[[axes]]`` tables, in the order pitch, yaw, roll."""
    found: dict[str, Axis] = {}
    tables = root.tables("axes")
    if len(tables) != 3:
        root.fault("axes", f"three [[axes]] are required, got {len(tables)}")
    for table in tables:
        axis = _axis(table, folder)
        if axis.name in found:
            table.fault("name", f"{axis.name!r} is given twice")
        found[axis.name] = axis
    for key, what in (("letter", "rotates"), ("unit", "unit")):
        values = [getattr(axis, key) for axis in found.values()]
        if len(found) == 3 and len(set(values)) != 3:
            root.fault("axes", f"{what} must differ between the three, got {values}")
    return [found[name] for name in AXIS_NAMES if name in found]


def _axis(table: Table, folder: pathlib.Path | None) -> Axis:
    name = table.choice("name", AXIS_NAMES)
    letter = {"pitch": "X", "yaw": "Z", "roll": "Y"}.get(name, "X")
    register_map: RegisterMap | None = None
    try:
        register_map = load_map(table.text("map"), folder)
    except MapError as error:
        for line in str(error).splitlines():
            table.fault("map", line)
    scale = Scale(
        table.integer("pulses_per_rev", 1, 100_000_000),
        table.number("reduction", 1e-3, 1e5, 1.0),
        table.integer("direction", -1, 1, 1),
    )
    if scale.direction == 0:
        table.fault("direction", "must be 1 or -1, got 0")
        scale = Scale(scale.pulses_per_rev, scale.reduction, 1)
    low = table.number("min_deg", -180, 180)
    high = table.number("max_deg", -180, 180)
    if low >= high:
        table.fault("min_deg", f"must be under max_deg, got {low} and {high}")
    ends = sorted((scale.to_pulses(low), scale.to_pulses(high)))
    axis = Axis(
        name=name,
        letter=table.choice("rotates", ("X", "Y", "Z"), letter),
        unit=table.integer("unit", 1, 247),
        map=register_map,  # type: ignore[arg-type] # None only beside a fault, and then nothing is returned
        scale=scale,
        min_deg=low,
        max_deg=high,
        min_pulses=table.integer("min_pulses", -(2**31), 2**31 - 1, ends[0]),
        max_pulses=table.integer("max_pulses", -(2**31), 2**31 - 1, ends[1]),
        speed_deg_s=table.number("speed_deg_s", 1e-3, 5000.0),
        accel_deg_s2=table.number("accel_deg_s2", 1e-3, 100_000.0),
        comm_timeout_s=table.optional_number("comm_timeout_s", 0.01, 60.0),
    )
    if axis.min_pulses >= axis.max_pulses:
        table.fault("min_pulses", "must be under max_pulses")
    table.end()
    return axis


def read_imu(table: Table) -> ImuSettings:
    """The ``[imu]`` table."""
    kind = table.choice("format", ("hyperimu", "lines", "sensorlogger"))
    hyper = kind == "hyperimu"
    transport = table.choice("transport", ("listen", "connect"), "listen")
    if kind == "sensorlogger" and transport != "listen":
        table.fault("transport", "Sensor Logger pushes: the computer must listen")
    # HyperIMU sends azimuth, pitch, roll, which turn about Z, X, Y; the order is ZYX.
    columns = table.integers("columns", 3, 0, 200, (1, 3, 2) if hyper else (0, 1, 2))
    quaternion = table.integers("quaternion_columns", 4, 0, 200, ())
    stamp = table.integer("stamp_column", -1, 200, 0 if hyper else -1)
    count = table.integer("column_count", 0, 200, 0)
    if count and max((*columns, *quaternion, stamp)) >= count:
        table.fault("column_count", f"{count} is too few for the columns named")
    signs = table.integers("signs", 3, -1, 1, (-1, -1, -1) if hyper else (1, 1, 1))
    if 0 in signs:
        table.fault("signs", "must be 1 or -1")
    default = None if kind == "lines" and not quaternion else "ZYX"
    separator = table.text("separator", ",")
    if len(separator) != 1 or separator in "0123456789+-.eE\r\n":
        table.fault("separator", f"must be one character no number has: {separator!r}")
    result = ImuSettings(
        format=kind,
        transport=transport,
        host=table.text("host", "127.0.0.1"),
        port=table.integer("port", 0, 65535),
        columns=(columns[0], columns[1], columns[2]),
        quaternion=(
            (quaternion[0], quaternion[1], quaternion[2], quaternion[3])
            if quaternion
            else None
        ),
        stamp_column=None if stamp < 0 else stamp,
        column_count=count or None,
        separator=separator,
        angle_unit=table.choice("unit", ("deg", "rad"), "deg"),
        order=table.choice("order", ORDERS, default),
        signs=(signs[0], signs[1], signs[2]),
        mounting_deg=table.numbers("mounting_deg", -360, 360, (0.0, 0.0, 0.0)),
        stale_s=table.number("stale_s", 0.02, 10.0, 0.4),
        max_jump_deg=table.number("max_jump_deg", 0.1, 180.0, 20.0),
    )
    table.end()
    return result


def read_settle(table: Table) -> SettleSettings:
    """The ``[settle]`` table."""
    result = SettleSettings(
        window_s=table.number("window_s", 0.01, 60.0, 0.5),
        min_samples=table.integer("min_samples", 3, 10_000, 10),
        std_deg=table.number("std_deg", 1e-6, 10.0, 0.1),
        slope_deg_s=table.number("slope_deg_s", 1e-6, 100.0, 0.2),
        timeout_s=table.number("timeout_s", 0.05, 600.0, 10.0),
        samples=table.integer("samples", 1, 10_000, 25),
    )
    if result.timeout_s <= result.window_s:
        table.fault("timeout_s", "must be longer than window_s")
    table.end()
    return result


def read_motion(table: Table) -> MotionSettings:
    """The ``[motion]`` table."""
    result = MotionSettings(
        max_step_deg=table.number("max_step_deg", 0.1, 360.0, 15.0),
        approach_overshoot_deg=table.number("approach_overshoot_deg", 0.0, 20.0, 0.0),
        position_tolerance_deg=table.number("position_tolerance_deg", 1e-4, 5.0, 0.05),
        poll_s=table.number("poll_s", 0.001, 0.1, 0.05),
        deadline_factor=table.number("deadline_factor", 1.0, 20.0, 2.0),
        deadline_slack_s=table.number("deadline_slack_s", 0.05, 60.0, 2.0),
        stall_s=table.number("stall_s", 0.05, 30.0, 1.0),
        following_deg=table.number("following_deg", 0.01, 45.0, 3.0),
        envelope_margin_deg=table.number("envelope_margin_deg", 0.1, 90.0, 15.0),
        max_disagreement_deg=table.number("max_disagreement_deg", 0.1, 180.0, 45.0),
        heartbeat_s=table.number("heartbeat_s", 0.2, 60.0, 3.0),
        mirror_limits=table.boolean("mirror_limits", False),
    )
    table.end()
    return result


def read_session(
    table: Table, axes: list[Axis], motion: MotionSettings
) -> SessionSettings:
    """The ``[session]`` table; default ranges are what the limits leave."""
    overshoot = motion.approach_overshoot_deg
    ranges = tuple(
        table.numbers(
            f"{axis.name}_range_deg",
            -180.0,
            180.0,
            (axis.min_deg + overshoot, axis.max_deg),
        )
        for axis in axes
    )
    for axis, (low, high) in zip(axes, ranges, strict=True):
        key = f"{axis.name}_range_deg"
        if low >= high:
            table.fault(key, f"must be [low, high], got [{low}, {high}]")
        elif low - overshoot < axis.min_deg - 1e-9 or high > axis.max_deg + 1e-9:
            table.fault(
                key,
                f"[{low}, {high}] with an overshoot of {overshoot} leaves the axis's "
                f"limits [{axis.min_deg}, {axis.max_deg}]",
            )
    result = SessionSettings(
        candidates=table.integer("candidates", 5, 100_000, 50),
        k=table.integer("k", 4, 10_000, 4),
        method=table.choice("method", METHODS, "policy"),
        min_efficiency=table.number("min_efficiency", 0.0, 1.0, 0.9),
        seed=table.integer("seed", 0, 2**31 - 1, 0),
        ranges=ranges,
        verify_postures=table.integer("verify_postures", 0, 1000, 4),
        verify_limit_deg=table.number("verify_limit_deg", 1e-3, 45.0, 0.5),
        reference_tolerance_deg=table.number(
            "reference_tolerance_deg", 1e-3, 45.0, 0.5
        ),
        max_unreachable=table.integer("max_unreachable", 0, 1000, 3),
        zero=table.choice("zero", ("here", "drive"), "here"),
    )
    if result.k >= result.candidates:
        table.fault("k", f"must be under candidates ({result.candidates})")
    table.end()
    return result
