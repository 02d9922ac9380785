"""The command line: one row a command, its words, its function and its options.

Imports nothing that takes time: a function is named by its module, which is loaded when
its command was asked for.
"""

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


class _Faults(argparse._AppendAction):
    """Appends a fault; ``list`` prints those there are, and ends."""

    def __call__(self, parser: Any, namespace: Any, values: Any, *more: Any) -> None:
        if values == "list":
            from rig.simulator.faults import KINDS

            print(*(f"{kind:<16} {text}" for kind, text in KINDS.items()), sep="\n")
            parser.exit()
        super().__call__(parser, namespace, values, *more)


def _number(low: float, high: float, default: float, text: str) -> dict[str, Any]:
    text = f"{text} (default {default:g})"
    return {"type": _within(low, high), "default": default, "help": text}


CONFIG: Options = {"--config": _path("default: rig.toml here", metavar="FILE")}
FOLDER: Options = {
    "--out": _path("folder for the run's folder"),
    "--dry-run": _flag("plan; open no port"),
}
MOTION: Options = {
    "--arm": _flag("arm without prompting"),
    "--reset-alarms": _flag("before arming"),
    "--zero": _flag("confirm that the device stands in its zero posture"),
}
LIVE: Options = {"--live": _flag("show it as a page in the browser")}
SIMULATOR: Options = {
    "--simulate": _flag("run against a simulated rig"),
    "--transport": {
        "choices": ("tcp", "rtu_tcp", "rtu"),
        "default": "tcp",
        "help": "of the simulated bus; rtu is a pseudo-terminal",
    },
    "--fault": {
        "action": _Faults,
        "default": [],
        "metavar": "KIND[@PHASE|@Ns][,count=N]...",
        "help": "inject a fault; --fault list names them",
    },
    "--noise": _number(0.0, 90.0, 0.02, "degrees"),
    "--backlash": _number(0.0, 90.0, 0.0, "degrees"),
    "--dead-zone": _number(0.0, 90.0, 0.0, "degrees"),
    "--breakaway": _number(0.0, 90.0, 0.0, "degrees until a joint at rest yields"),
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

YES: Options = {
    "--yes": _flag("confirm everything and take every default"),
    "--reset-alarms": _flag("before arming"),
}
STEP: Options = CONFIG | YES
BUS: Options = {
    "--bus": {
        "metavar": "BUS",
        "help": "rtu:DEVICE,BAUD,PARITY,BITS,STOPBITS or tcp:HOST:PORT; without it "
        "that of rig.toml",
    },
    "--units": {
        "type": int,
        "choices": range(1, 248),
        "metavar": "N",
        "default": 16,
        "help": "ids 1 to N (default 16)",
    },
}
TCP: Options = {
    "--tcp": {
        "action": "append",
        "default": [],
        "metavar": "HOST[:PORT]",
        "help": "does anything answer there",
    }
}
SECONDS: Options = {"--seconds": _number(1.0, 600.0, 5.0, "to look at the stream")}
AXIS: Options = {"axis": {"choices": ("pitch", "yaw", "roll")}}
JOG: Options = AXIS | {
    "step": {
        "type": _within(-3.0, 3.0),
        "nargs": "?",
        "help": "degrees, at most 3; without it the axis moves while a key is held",
    },
}
INTO: Options = {
    "--into": _path("a calibration that is to keep what is found", metavar="RUN")
}
HERE: Options = {
    "--here": _flag("where the device stands is home; otherwise the drives' own homing")
}
NAMES_KNOWN: Options = {
    "--names-known": _flag(
        "every unit was seen to turn its own joint the right way; the phone may be "
        "placed in any way"
    )
}
SETUP: Options = {
    "--imu": {"metavar": "APP[:PORT]", "help": "hyperimu, sensorlogger or lines"},
    "--home": {"choices": ("here", "drive"), "default": "here", "help": "how"},
    "--set": {
        "action": "append",
        "default": [],
        "metavar": "KEY=VALUE",
        "help": "of the new rig.toml, such as axes.pitch.reduction=50",
    },
}

ORDER = {"choices": ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")}
REFIT: Options = FOLDER_OF | {
    "--order": {**ORDER, "help": "mechanism.order: axes of the joints"},
    "--imu-order": {**ORDER, "help": "imu.order: of the phone's angles"},
    "--signs": {
        "type": int,
        "choices": (1, -1),
        "nargs": 3,
        "help": "imu.signs: of the phone's angles, in the sequence of their order",
    },
    "--mounting": {
        "type": _within(-360, 360),
        "nargs": 3,
        "metavar": ("Z", "Y", "X"),
        "help": "imu.mounting_deg: turn of the phone on the end-effector",
    },
}
EXPORT: Options = FOLDER_OF | {
    "--to": {
        "choices": ("c", "st", "ros", "json", "csv"),
        "required": True,
        "help": "C header, IEC 61131-3 Structured Text, ROS 2 parameters, JSON, CSV",
    },
    "--out": _path("file to write (default: print it)", metavar="FILE"),
}
RUNS: Options = {"folder": _path("folder of runs, searched with its subfolders")}


# command, what it does, the function that runs it, its options, whether it simulates
Row = tuple[str, str, str, Options, bool]
STEPS, OF_RUN, RECORDED = "rig.commissioning", "rig.sessions", "rig.commands"
COMMANDS: list[Row] = [
    ("setup", "from cables to a device that may be calibrated; writes rig.toml",
     f"{STEPS}:setup", STEP | BUS | SETUP | NAMES_KNOWN, True),
    ("ports", "list serial ports, and what answers on TCP",
     f"{STEPS}:ports", TCP, False),
    ("scan", "which units answer, and of which family; reads only",
     f"{STEPS}:scan", CONFIG | BUS, True),
    ("imu", "what to type into the phone, and what it sends",
     f"{STEPS}:imu", STEP | SECONDS, True),
    ("jog", "move one axis by hand", f"{STEPS}:jog", JOG | STEP, True),
    ("characterise", "measure play, dead zone and breakaway of one axis",
     f"{STEPS}:characterise", AXIS | INTO | STEP, True),
    ("home", "make the drives' counts mean a place",
     f"{STEPS}:home", HERE | STEP, True),
    ("axes", "check what turns, which way, how far; correct rig.toml",
     f"{STEPS}:axes", NAMES_KNOWN | STEP, True),
    ("zero", "measure the zero posture", f"{STEPS}:zero", STEP, True),
    ("calibrate", "choose, visit, identify, verify and save",
     f"{OF_RUN}:session", SESSION, True),
    ("collect", "record random postures (Datasets 4 and 5)",
     f"{OF_RUN}:session", _count(50) | SESSION, True),
    ("verify", "compare a calibration with fresh measurements",
     f"{OF_RUN}:session", SAVED | _count(6) | SESSION, True),
    ("goto", "move the end-effector to a posture, calibrated",
     f"{OF_RUN}:session", SAVED | TO | SESSION, True),
    ("resume", "go on with a run that was paused, stopped or killed",
     f"{OF_RUN}:resume", RUN | MOTION | LIVE, True),
    ("watch", "show a run, also a running one, as a page in the browser",
     f"{RECORDED}:watch", FOLDER_OF, False),
    ("identify", "read identity and status of every drive; write nothing",
     f"{RECORDED}:identify", CONFIG, True),
    ("stop", "quick-stop every drive now, and verify",
     "rig.__main__:stop", CONFIG, False),
    ("check", "check a configuration and list every fault",
     f"{RECORDED}:check", FILE | CONFIG, False),
    ("example", "print a commented example configuration",
     f"{RECORDED}:example", NAME, False),
    ("refit", "identify a recorded calibration anew",
     f"{RECORDED}:refit", REFIT, False),
    ("report", "write report.html of any run, also unfinished",
     f"{RECORDED}:report", FOLDER_OF, False),
    ("export", "print the inverse map of a calibration for a controller",
     f"{RECORDED}:export", EXPORT, False),
    ("trend", "compare the calibrations of a device over time",
     f"{RECORDED}:trend", RUNS, False),
    ("simulate", "serve simulated drives and a phone on loopback",
     f"{RECORDED}:simulate", CONFIG | PORT, True),
]  # fmt: skip


def make_parser() -> argparse.ArgumentParser:
    """The parser of every command; what it returns names the ``function``."""
    parser = argparse.ArgumentParser(
        prog="jaxcal-rig",
        description="Calibrate a three-axis device over Modbus and a phone's IMU.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text, function, options, simulated in COMMANDS:
        command = commands.add_parser(name, help=text, description=text)
        command.set_defaults(function=function)
        for option, given in options.items():
            command.add_argument(option, **given)
        group = command.add_argument_group("simulator")  # left out of help where empty
        for option, given in (SIMULATOR if simulated else {}).items():
            group.add_argument(option, **given)
    return parser
