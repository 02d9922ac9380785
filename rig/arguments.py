"""The arguments of ``python -m rig``; imports nothing that takes time."""

from __future__ import annotations

import argparse
import pathlib
from collections.abc import Callable

EPILOG = """\
exit codes: 0 done; 1 done, but the error says calibrate (again); 2 bad input, nothing
moved; 3 stopped by a fault; 4 paused by Ctrl-C; 128 + signal stopped by a signal.
After 3, 4 and signals `resume RUN` goes on.

Research software, not a medical device. Calibrate with no patient attached; a hardware
emergency stop is required.
"""


def make_parser() -> argparse.ArgumentParser:
    """The parser of every command."""
    parser = argparse.ArgumentParser(
        prog="python -m rig",
        description="Calibrate a three-axis device over Modbus and a phone's IMU.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, text: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=text, description=text)

    sessions = {
        "calibrate": add("calibrate", "choose, visit, identify, verify and save"),
        "collect": add("collect", "record random postures (Datasets 4 and 5)"),
        "verify": add("verify", "compare a calibration with fresh measurements"),
        "goto": add("goto", "move the end-effector to a posture, calibrated"),
    }
    for name in ("verify", "goto"):
        sessions[name].add_argument(
            "calibration", type=pathlib.Path, help="its file, or its run's folder"
        )
    sessions["goto"].add_argument(
        "--to",
        type=_number_within(-360, 360),
        nargs=3,
        required=True,
        metavar=("PITCH", "YAW", "ROLL"),
        help="desired posture in degrees",
    )
    for name, count in (("collect", 50), ("verify", 6)):
        sessions[name].add_argument(
            "--count", type=int, default=count, help=f"postures (default {count})"
        )
    for sub in sessions.values():
        _config_option(sub)
        sub.add_argument("--out", type=pathlib.Path, help="folder for the run's folder")
        sub.add_argument("--dry-run", action="store_true", help="plan; open no port")
        _motion_options(sub, "confirm that the device stands in its zero posture")
        _simulator_options(sub)
    resume = add("resume", "go on with a run that was paused, stopped or killed")
    resume.add_argument("run", type=pathlib.Path, help="the run's folder")
    resume.add_argument("--config", type=pathlib.Path, help="for a changed port")
    _motion_options(resume, argparse.SUPPRESS)
    _simulator_options(resume)
    identify = add("identify", "read identity and status of every drive; write nothing")
    _config_option(identify)
    _simulator_options(identify, hidden=True)
    _config_option(add("stop", "quick-stop every drive now, and verify"))
    check = add("check", "check a configuration and list every fault")
    check.add_argument("file", nargs="?", type=pathlib.Path, help="rig.toml")
    _config_option(check)
    example = add("example", "print a commented example configuration")
    example.add_argument("name", nargs="?", help="without it the names are listed")
    simulate = add("simulate", "serve simulated drives and a phone on loopback")
    _config_option(simulate)
    simulate.add_argument("--bus-port", type=int, default=None, help="0: any free one")
    _simulator_options(simulate)
    return parser


def _number_within(low: float, high: float) -> Callable[[str], float]:
    def number(text: str) -> float:
        value = float(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"must be in [{low:g}, {high:g}]: {text}")
        return value

    return number


def _config_option(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--config", type=pathlib.Path, metavar="FILE", help="rig.toml")


def _motion_options(sub: argparse.ArgumentParser, zero: str) -> None:
    sub.add_argument("--arm", action="store_true", help="arm without prompting")
    sub.add_argument("--reset-alarms", action="store_true", help="before arming")
    sub.add_argument("--zero", action="store_true", help=zero)


def _simulator_options(sub: argparse.ArgumentParser, hidden: bool = False) -> None:
    group = sub.add_argument_group("simulator")
    group.add_argument(
        "--simulate", action="store_true", help="run against a simulated rig"
    )

    def shown(text: str) -> str:
        return argparse.SUPPRESS if hidden else text

    group.add_argument(
        "--transport",
        choices=("tcp", "rtu_tcp", "rtu"),
        default="tcp",
        help=shown("of the simulated bus; rtu is a pseudo-terminal"),
    )
    group.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="KIND[@PHASE|@Ns][,count=N]...",
        help=shown("inject a fault; --fault list names them"),
    )
    for name, low, high, default, text in (
        ("--noise", 0.0, 90.0, 0.02, "degrees"),
        ("--backlash", 0.0, 90.0, 0.0, "degrees"),
        ("--drift", -90.0, 90.0, 0.0, "degrees per minute"),
        ("--speedup", 0.01, 100.0, 1.0, "factor on the speed of the axes"),
        ("--rate", 0.1, 1000.0, 100.0, "of the phone, Hz"),
    ):
        group.add_argument(
            name,
            type=_number_within(low, high),
            default=default,
            help=shown(f"{text} (default {default:g})"),
        )
