"""The commands of ``python -m rig``; each imports what it needs."""

from __future__ import annotations

import argparse
import contextlib
import time
from collections.abc import Callable

from rig.config import example_text, load_config
from rig.config.files import example_names
from rig.core.bus import Bus, BusError
from rig.core.drive import Drive
from rig.core.faults import EXIT_FAULT, EXIT_OK
from rig.core.lock import BusLock
from rig.sessions import FILE, journal_of, load, make_simulator, run_session

COMMISSIONING = (
    *("ports", "scan", "imu", "jog", "home", "axes", "zero", "setup"),
    "characterise",
)


def run(args: argparse.Namespace) -> int:
    """Run the command that was asked for; returns the exit code."""
    if "list" in getattr(args, "fault", []):
        from rig.simulator.faults import KINDS

        for kind, text in KINDS.items():
            print(f"{kind:<16} {text}")
        return EXIT_OK
    commands: dict[str, Callable[[argparse.Namespace], int]] = {
        "identify": _identify,
        "simulate": _simulate,
        "example": _example,
        "check": _check,
        "watch": _watch,
        **dict.fromkeys(("refit", "report", "export", "trend"), _of_recorded),
    }
    if args.command in COMMISSIONING:
        from rig.commissioning import run as run_step

        return run_step(args)
    return commands.get(args.command, run_session)(args)


def _of_recorded(args: argparse.Namespace) -> int:
    from rig import results

    command: Callable[[argparse.Namespace], int] = getattr(results, args.command)
    return command(args)


def _identify(args: argparse.Namespace) -> int:
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


def _simulate(args: argparse.Namespace) -> int:
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


def _watch(args: argparse.Namespace) -> int:
    from jaxcal.extras import needs
    from rig.workbench.live import launch

    journal_of(args.run)
    with needs("live", "the live page"):
        from rig.workbench.live.server import serve
    sock, token, url = launch.listen(args.live_host)
    print(f"live page: {url}\nCtrl-C ends", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        serve(args.run, sock, token)
    return EXIT_OK


def _example(args: argparse.Namespace) -> int:
    if args.name is None:
        print("\n".join(example_names()))
    else:
        print(example_text(args.name), end="")
    return EXIT_OK


def _check(args: argparse.Namespace) -> int:
    path = args.config or args.file or FILE
    config = load_config(path)
    print(f"{path}: valid; fingerprint {config.fingerprint()[:16]}")
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
