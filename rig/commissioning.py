"""ports, scan, imu, jog, home, axes, zero, setup: from arguments to an exit code."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import pathlib
import socket
import tomllib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from jaxcal.extras import needs
from rig.config import (
    AXIS_NAMES,
    RigConfig,
    example_text,
    load_config,
    parse_config,
)
from rig.core.faults import EXIT_FAULT, EXIT_OK, Refused
from rig.journal import HOMED, IDENTIFIED, SIGN_CHECKED, DeviceRecord, new_run_folder
from rig.journal.lock import BusLock
from rig.sessions import FILE, load, make_simulator
from rig.workbench.commission import setup as wizard
from rig.workbench.commission import steps
from rig.workbench.commission.operator import Operator
from rig.workbench.commission.ports import MODBUS_PORT, serial_lines, tcp_line
from rig.workbench.commission.scan import Found, parse_bus
from rig.workbench.commission.scan import scan as scan_bus

if TYPE_CHECKING:
    from rig.simulator import Simulator


def _say(text: str) -> None:
    print(text, flush=True)


def ports(args: argparse.Namespace) -> int:
    """List serial ports, and what answers on TCP."""
    lines = serial_lines()
    print(*(lines or ["no serial port on this computer"]), sep="\n")
    code = EXIT_OK
    for address in args.tcp:
        host, _, port = address.rpartition(":") if ":" in address else (address, "", "")
        try:
            answers, text = tcp_line(host, int(port or MODBUS_PORT))
        except ValueError:
            raise Refused(f"--tcp must be HOST or HOST:PORT, got {address}") from None
        print(text)
        code = code if answers else EXIT_FAULT
    return code


def scan(args: argparse.Namespace) -> int:
    """Name the units that answer."""
    if args.bus and not args.simulate:
        bus, maps = parse_bus(args.bus), ()
        with BusLock(bus).acquire("scan"):
            return _told(scan_bus(bus, args.units, _say, maps))
    with _place(args) as place:
        config = place.config
        own = tuple(axis.map for axis in config.axes)
        with BusLock(config.bus).acquire("scan"):
            code = _told(scan_bus(config.bus, args.units, _say, own))
        if code == EXIT_OK:
            steps.identify(place)
        return code


def _told(found: list[Found]) -> int:
    if not found:
        _say(
            "no unit answers. Check power, wiring, termination, the line format (baud "
            "rate and parity) and the units' ids"
        )
        return EXIT_FAULT
    return EXIT_OK


def imu(args: argparse.Namespace) -> int:
    """Look at the phone's stream, and listen to that phone only."""
    with _place(args) as place:
        stream = steps.look_at_phone(place, args.seconds)
        wizard.pin(place, stream.sender)
    return EXIT_OK


def jog(args: argparse.Namespace) -> int:
    """Move one axis by hand."""
    with _place(args, IDENTIFIED) as place:
        return steps.jog(place, AXIS_NAMES.index(args.axis), args.step)


def characterise(args: argparse.Namespace) -> int:
    """Measure play, dead zone and breakaway of one axis."""
    with needs("policy", "characterise"):
        import jax  # noqa: F401  # before anything moves
    with _place(args, SIGN_CHECKED) as place:
        return steps.characterise(place, AXIS_NAMES.index(args.axis), args.into)


def home(args: argparse.Namespace) -> int:
    """Make the drives' counts mean a place."""
    with _place(args, IDENTIFIED) as place:
        return steps.go_home(place, args.here)


def axes(args: argparse.Namespace) -> int:
    """Check the axes, and correct rig.toml."""
    with _place(args, HOMED) as place:
        return steps.axes(place, args.names_known)


def zero(args: argparse.Namespace) -> int:
    """Measure the zero posture."""
    with _place(args, SIGN_CHECKED) as place:
        return steps.take_zero(place)


def setup(args: argparse.Namespace) -> int:
    """Go through all steps from cables on."""
    path = args.config or FILE
    operator = Operator(args.yes, _say)
    given = wizard.Given(
        bus=args.bus or "",
        imu=args.imu or "",
        units=args.units,
        values=dict(map(setting, args.set)),
        home=args.home,
        names_known=args.names_known,
    )
    with contextlib.ExitStack() as stack:
        if args.simulate:
            simulator = stack.enter_context(_simulator(args))
            given = _given(simulator, given)
            path = args.config or _own_folder(simulator.config) / "rig.toml"
            if path.exists():  # its bus may be that of a real device
                raise Refused(
                    f"{path} exists: --simulate writes a file of its own. Name a new "
                    "one, or leave out --config or --simulate"
                )
        operator.confirm(wizard.SAFETY, "setup")
        if path.exists() and args.set:
            raise Refused(f"{path} exists: edit it, or leave out --set")
        if path.exists():
            config = load_config(path)
            operator.say(f"{path} exists and is used; delete it to begin anew")
        else:
            config = wizard.write_config(path, given, operator)
        place = steps.Place(
            config, DeviceRecord.load(config.device_path), operator, path,
            reset_alarms=args.reset_alarms, full_speed=args.simulate,
        )  # fmt: skip
        return wizard.go(place, given)


def _simulator(args: argparse.Namespace) -> Simulator:
    config = parse_config(example_text("simulate"))
    return make_simulator(config, vars(args), args.fault)


def _given(simulator: Simulator, given: wizard.Given) -> wizard.Given:
    """What an operator would answer of a simulated device, and its phone started."""
    bus = simulator.start().bus
    where = f"{bus.transport}:{bus.host}:{bus.port}"
    if bus.transport == "rtu":
        where = f"rtu:{bus.device},{bus.baudrate},N,8,1"
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    simulator.start_phone(port)
    imu = simulator.config.imu
    values: dict[str, Any] = {"imu.host": "127.0.0.1", "imu.stale_s": imu.stale_s}
    for axis in simulator.config.axes:
        for name in ("reduction", "speed_deg_s", "accel_deg_s2"):
            values[f"axes.{axis.name}.{name}"] = getattr(axis, name)
    return dataclasses.replace(
        given, bus=where, imu=f"{imu.format}:{port}",
        values=values | given.values,
    )  # fmt: skip


def setting(text: str) -> tuple[str, Any]:
    """A key of rig.toml and its value; what is no TOML is a text."""
    key, equals, value = text.partition("=")
    if not equals:
        raise Refused(f"--set must be KEY=VALUE, got {text!r}")
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key, value


@contextlib.contextmanager
def _place(args: argparse.Namespace, state: str = "") -> Iterator[steps.Place]:
    """The device that a command is about.

    A simulated one is first taken through the states before the command's own.
    """
    config, path = load(args), args.config
    with contextlib.ExitStack() as stack:
        if not args.simulate:
            operator = Operator(getattr(args, "yes", False), _say)
            record = DeviceRecord.load(config.device_path)
            place = steps.Place(config, record, operator, path)
        else:
            simulator = make_simulator(config, vars(args), args.fault)
            served = stack.enter_context(simulator).start()
            record = DeviceRecord(_own_folder(served) / "device.json")
            place = steps.simulated(simulator, served, record, _say)
            steps.begin_simulated(place, state)
            place.operator.yes = getattr(args, "yes", False)
        place.reset_alarms = getattr(args, "reset_alarms", False)
        yield place


def _own_folder(config: RigConfig) -> pathlib.Path:
    return new_run_folder(pathlib.Path(config.output), "simulated")
