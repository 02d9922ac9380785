"""The commands besides sessions and commissioning; each loads what it needs."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from typing import TYPE_CHECKING

from rig.config import example_text, load_config
from rig.core.faults import EXIT_FAULT, EXIT_OK, EXIT_RECALIBRATE, Refused
from rig.sessions import FILE, journal_of, load, make_simulator, recorded, records_of

if TYPE_CHECKING:
    from rig.core.drive import Drive


def identify(args: argparse.Namespace) -> int:
    """Print what every drive says of itself."""
    from rig.core.bus import Bus, BusError
    from rig.core.drive import Drive
    from rig.journal.lock import BusLock

    config, code = load(args), EXIT_OK
    with contextlib.ExitStack() as stack:
        if args.simulate:
            simulator = make_simulator(config, vars(args), args.fault)
            config = stack.enter_context(simulator).start()
        # Its reads would delay those of a session that moves.
        stack.enter_context(BusLock(config.bus).acquire("identify"))
        bus = stack.enter_context(Bus(config.bus, config.silence_s))
        for axis in config.axes:
            try:
                print(*_described(Drive(bus, axis)), sep="\n")
            except BusError as error:
                code = EXIT_FAULT
                print(f"{axis.name} (unit {axis.unit}): {error}")
    return code


def _described(drive: Drive) -> list[str]:
    axis, status, alarm = drive.axis, drive.status(), drive.alarm()
    flags = axis.map.status.flags(status.word)
    words = " ".join(name for name, on in flags.items() if on)
    identity = [f"    {name} = {value}" for name, value in drive.identity().items()]
    return [
        f"{axis.name} (unit {axis.unit}, {axis.map.title}): status "
        f"0x{status.word:04X} {words}, position {status.position} pulses = "
        f"{axis.to_deg(status.position):.4f} deg" + (alarm and f", {alarm}"),
        *identity,
    ]


def simulate(args: argparse.Namespace) -> int:
    """Serve simulated drives and a phone until Ctrl-C."""
    config = load(args)
    port = config.bus.port if args.bus_port is None else args.bus_port
    with make_simulator(config, vars(args), args.fault) as simulator:
        served = simulator.start(port)
        phone = f"listens on 127.0.0.1:{served.imu.port}"
        if config.imu.transport == "listen":
            phone_port = config.imu.port or 2055
            simulator.start_phone(phone_port)
            phone = f"sends to 127.0.0.1:{phone_port}"
        print(f"drives: {served.bus.where}; units {[a.unit for a in config.axes]}")
        print(f"phone: {config.imu.format}, {phone}")
        print("Ctrl-C ends", flush=True)
        try:
            while True:
                time.sleep(3600)
        except KeyboardInterrupt:
            return EXIT_OK


def watch(args: argparse.Namespace) -> int:
    """Serve the page of a run until Ctrl-C."""
    from jaxcal.extras import needs
    from rig.workbench.live import listen

    journal_of(args.run)
    with needs("live", "the live page"):
        from rig.workbench.live.server import serve
    sock, line = listen()
    print(f"{line}\nCtrl-C ends", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        serve(args.run, sock)
    return EXIT_OK


def example(args: argparse.Namespace) -> int:
    """Print an example, or the names of those there are."""
    from rig.config.files import example_names

    if args.name is None:
        print("\n".join(example_names()))
    else:
        print(example_text(args.name), end="")
    return EXIT_OK


def check(args: argparse.Namespace) -> int:
    """Say what a configuration comes to; ConfigError lists its faults."""
    path = args.config or args.file or FILE
    config = load_config(path)
    print(f"{path}: valid")
    for axis in config.axes:
        print(
            f"  {axis.name}: unit {axis.unit}, {axis.map.name}, "
            f"{axis.pulses_per_deg:.3f} pulses per degree, "
            f"{axis.min_pulses}..{axis.max_pulses} pulses"
        )
    late = ", LONGER than the shortest step: shorten bus.timeout_s or slow the axes"
    print(
        f"  heartbeat {config.heartbeat_s:.3g} s, shortest step "
        f"{config.shortest_step_s:.3g} s"
        f"{late if config.heartbeat_s > config.shortest_step_s else ''}"
    )
    return EXIT_OK


def refit(args: argparse.Namespace) -> int:
    """Identify a recorded calibration anew, into a folder of its own."""
    from rig.workbench.identification.refit import refit as identify_anew

    then, start = recorded(args)
    if start["mode"] != "calibrate":
        raise Refused(f"{args.run} is a {start['mode']} run; refit takes a calibration")
    wanted = {
        "mechanism.order": args.order,
        "imu.order": args.imu_order,
        "imu.signs": args.signs,
        "imu.mounting_deg": args.mounting,
    }
    return identify_anew(args.run, records_of(args.run), then, wanted, print)


def report(args: argparse.Namespace) -> int:
    """Write report.html of a run of any kind, also of an unfinished one."""
    from rig.workbench.outputs.report import write_report

    print(write_report(args.run, records_of(args.run)))
    return EXIT_OK


def export(args: argparse.Namespace) -> int:
    """Print or write the inverse map of a run's calibration."""
    from jaxcal.files import write_text
    from rig.workbench.outputs.export import LANGUAGES, checksum, load_inverse

    inverse = load_inverse(args.run, records_of(args.run))
    for text in inverse["warnings"]:
        print(f"WARNING: {text}", file=sys.stderr)
    text = LANGUAGES[args.to](inverse)
    if args.out is None:
        print(text, end="")
    else:
        write_text(args.out, text)
        print(f"{args.out}: SHA-256 of the numbers {checksum(inverse)}")
    return EXIT_OK


def trend(args: argparse.Namespace) -> int:
    """Compare the calibrations in a folder, device by device; also as trend.html."""
    from rig.workbench.outputs.trend import read_runs, trend_lines, write_trend

    if not args.folder.is_dir():
        raise Refused(f"{args.folder} is no folder")
    devices, skipped = read_runs(args.folder)
    for text in skipped:
        print(f"left out: {text}", file=sys.stderr)
    if not devices:
        raise Refused(f"{args.folder} holds no finished calibration or verification")
    for device in devices:
        print(*trend_lines(device), sep="\n")
    print(f"saved: {write_trend(args.folder, devices)}")
    again = any(device.reasons for device in devices)
    return EXIT_RECALIBRATE if again else EXIT_OK
