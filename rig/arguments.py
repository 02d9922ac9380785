"""The arguments of ``python -m rig``; imports nothing that takes time."""

from __future__ import annotations

import argparse
import pathlib
from collections.abc import Callable
from typing import Any

EPILOG = """\
exit codes: 0 done; 1 done, but the error says calibrate (again); 2 bad input, nothing
moved; 3 stopped by a fault; 4 paused by Ctrl-C; 128 + signal stopped by a signal.
After 3, 4 and signals `resume RUN` goes on.

Research software, not a medical device. Calibrate with no patient attached; a hardware
emergency stop is required.
"""
Options = dict[str, dict[str, Any]]  # name to what add_argument is given


def _flag(text: str) -> dict[str, Any]:
    return {"action": "store_true", "help": text}


def _path(text: str, **more: Any) -> dict[str, Any]:
    return {"type": pathlib.Path, "help": text, **more}


def _count(default: int) -> Options:
    text = f"postures (default {default})"
    return {"--count": {"type": int, "default": default, "help": text}}


def _within(low: float, high: float) -> Callable[[str], float]:
    def number(text: str) -> float:
        value = float(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"must be in [{low:g}, {high:g}]: {text}")
        return value

    return number


def _axes(text: str) -> list[str]:
    names = text.split(",")
    if unknown := [name for name in names if name not in ("pitch", "yaw", "roll")]:
        raise argparse.ArgumentTypeError(f"no axis {unknown[0]!r}: pitch, yaw, roll")
    return names


def _number(low: float, high: float, default: float, text: str) -> dict[str, Any]:
    text = f"{text} (default {default:g})"
    return {"type": _within(low, high), "default": default, "help": text}


CONFIG: Options = {"--config": _path("rig.toml", metavar="FILE")}
FOLDER: Options = {
    "--out": _path("folder for the run's folder"),
    "--dry-run": _flag("plan; open no port"),
}
MOTION: Options = {
    "--arm": _flag("arm without prompting"),
    "--reset-alarms": _flag("before arming"),
    "--zero": _flag("confirm that the device stands in its zero posture"),
}
LIVE_HOST: Options = {
    "--live-host": {
        "default": "127.0.0.1",
        "metavar": "ADDRESS",
        "help": "of this computer, to show the page on; another than loopback needs "
        "the token that is printed",
    },
}
LIVE: Options = {"--live": _flag("show it as a page in the browser")} | LIVE_HOST
SIMULATOR: Options = {
    "--simulate": _flag("run against a simulated rig"),
    "--transport": {
        "choices": ("tcp", "rtu_tcp", "rtu"),
        "default": "tcp",
        "help": "of the simulated bus; rtu is a pseudo-terminal",
    },
    "--fault": {
        "action": "append",
        "default": [],
        "metavar": "KIND[@PHASE|@Ns][,count=N]...",
        "help": "inject a fault; --fault list names them",
    },
    "--noise": _number(0.0, 90.0, 0.02, "degrees"),
    "--backlash": _number(0.0, 90.0, 0.0, "degrees"),
    "--drift": _number(-90.0, 90.0, 0.0, "degrees per minute"),
    "--speedup": _number(0.01, 100.0, 1.0, "factor on the speed of the axes"),
    "--rate": _number(0.1, 1000.0, 100.0, "of the phone, Hz"),
    "--reversed": {"type": _axes, "metavar": "AXES", "help": "turn the other way"},
    "--swapped": {"type": _axes, "metavar": "A,B", "help": "two drives change cables"},
    "--gearing": {"type": int, "metavar": "PULSES", "help": "per turn, in the drives"},
    "--lost-origin": _number(-90.0, 90.0, 0.0, "degrees the counts are off"),
    "--realistic": _flag("slow replies and enabling, jitter, idle watchdog"),
}
SESSION: Options = CONFIG | FOLDER | MOTION | LIVE
FOLDER_OF: Options = {"run": _path("the run's folder")}
RUN: Options = FOLDER_OF | {"--config": _path("for a changed port")}
FILE: Options = {"file": _path("rig.toml", nargs="?")}
NAME: Options = {"name": {"nargs": "?", "help": "without it the names are listed"}}
PORT: Options = {"--bus-port": {"type": int, "help": "0: any free one"}}
SAVED: Options = {"calibration": _path("its file, or its run's folder")}
TO: Options = {
    "--to": {
        "type": _within(-360, 360),
        "nargs": 3,
        "required": True,
        "metavar": ("PITCH", "YAW", "ROLL"),
        "help": "desired posture in degrees",
    }
}


def make_parser() -> argparse.ArgumentParser:
    """The parser of every command."""
    parser = argparse.ArgumentParser(
        prog="python -m rig",
        description="Calibrate a three-axis device over Modbus and a phone's IMU.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, text: str, options: Options, simulated: bool = True) -> None:
        command = commands.add_parser(name, help=text, description=text)
        for option, given in options.items():
            command.add_argument(option, **given)
        group = command.add_argument_group("simulator")  # left out of help where empty
        for option, given in (SIMULATOR if simulated else {}).items():
            group.add_argument(option, **given)

    add("calibrate", "choose, visit, identify, verify and save", SESSION)
    text = "record random postures (Datasets 4 and 5)"
    add("collect", text, _count(50) | SESSION)
    text = "compare a calibration with fresh measurements"
    add("verify", text, SAVED | _count(6) | SESSION)
    text = "move the end-effector to a posture, calibrated"
    add("goto", text, SAVED | TO | SESSION)
    text = "go on with a run that was paused, stopped or killed"
    add("resume", text, RUN | MOTION | LIVE)
    text = "show a run, also a running one, as a page in the browser"
    add("watch", text, FOLDER_OF | LIVE_HOST, False)
    text = "read identity and status of every drive; write nothing"
    add("identify", text, CONFIG)
    add("stop", "quick-stop every drive now, and verify", CONFIG, False)
    add("check", "check a configuration and list every fault", FILE | CONFIG, False)
    add("example", "print a commented example configuration", NAME, False)
    text = "serve simulated drives and a phone on loopback"
    add("simulate", text, CONFIG | PORT)
    return parser
