"""The commands that move, measure and stop, each of which loads what it needs, and the
parser of every command: they are entry points, those of other packages too."""

from __future__ import annotations

import argparse
import contextlib
import functools
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

from jaxcal.arguments import Parser
from jaxcal.extras import MissingExtraError
from rig.faults import EXIT_FAULT, EXIT_OK, Refused
from rig.options import FILE, SIMULATOR, ConfigPath, DeviceOptions, Path, Session, Step
from rig.parts import COMMANDS, PLACES, STEPS, model_of, offered, part

if TYPE_CHECKING:
    from rig.config import RigConfig
    from rig.prove.steps import Site


say = functools.partial(print, flush=True)
AxisName = Annotated[str, "of rig.toml"]
WIDE = (-1e6, 1e6)
RunPath = Annotated[Path, "the run's folder"]
Saved = Annotated[Path, "rig.toml, or a run's folder"]
Postures = Annotated[int, "postures"]
Programs = Annotated[list[str], "programs named in the file that may be run"]
Units = Annotated[int, "scan unit ids 1 to N", (1, 247)]
BusName = Annotated[
    str,
    "rtu:DEVICE,BAUD,PARITY,BITS,STOPBITS or tcp:HOST:PORT; for other drives than "
    "Modbus serial:DEVICE,BAUD or can:CHANNEL",
]


# Commissioning


def ports() -> int:
    """list serial ports"""
    from rig.prove.scan import serial_lines

    print(*(serial_lines() or ["no serial port on this computer"]), sep="\n")
    return EXIT_OK


def scan(given: DeviceOptions, *, bus: BusName = "", units: Units = 16) -> int:
    """which units answer, and of which family; reads only"""
    from rig.prove import scan as scanning

    if bus and not given.simulate:
        units_found = scanning.scan(scanning.parse_bus(bus), units, say)
    else:
        from rig.prove import steps

        with place(given) as site:
            maps = tuple(axis.map for axis in site.config.axes)
            # Units of other lines than Modbus are those of rig.toml.
            units_found = list[Any](maps)
            if site.config.bus.transport in scanning.OF_BUS:
                units_found = list(scanning.scan(site.config.bus, units, say, maps))
            if units_found:
                steps.show_identity(site)
    return EXIT_OK if units_found else EXIT_FAULT


def jog(
    axis: AxisName, step: Annotated[float, "degrees, or mm", (-10, 10)], *, given: Step
) -> int:
    """move one axis by a step"""
    return _step(given, "IDENTIFIED", "jog", axis, step)


def home(
    given: Step, *, here: Annotated[bool, "home here, not by the drives"] = False
) -> int:
    """make the drives' counts mean a place"""
    return _step(given, "IDENTIFIED", "go_home", here)


def axes(given: Step) -> int:
    """check what turns, which way, how far; correct rig.toml"""
    return _step(given, "HOMED", "axes")


def zero(given: Step) -> int:
    """measure the zero posture"""
    return _step(given, "SIGN_CHECKED", "take_zero")


def _step(given: Step, state: str, name: str, *options: Any) -> int:
    """Run a function of ``steps`` at the device."""
    from rig.prove import steps

    with place(given, state) as site:
        code: int = getattr(steps, name)(site, *options)
        return code


@contextlib.contextmanager
def place(given: DeviceOptions, state: str = "") -> Iterator[Site]:
    """The device that a command is about, which has reached a state."""
    from rig.journal.device import DeviceRecord
    from rig.journal.run_folder import new_run_folder
    from rig.prove import steps

    config, operator = given.load(), steps.Operator(getattr(given, "yes", False), say)
    with contextlib.ExitStack() as stack:
        if given.simulate:
            simulator = given.simulator(config)
            config = stack.enter_context(simulator).start()
            folder = new_run_folder(Path(config.output), "simulated")
            record = steps.commissioned(folder / "device.json", config, state)
            site = steps.Site(
                config, record, operator, full_speed=True, listeners=(simulator.hear,)
            )
        else:
            record = DeviceRecord.load(config.device_path)
            if state and (lack := record.missing(config, state)):
                raise Refused(lack)
            site = steps.Site(config, record, operator, given.config)
        site.reset_alarms = getattr(given, "reset_alarms", False)
        yield site


# Sessions


def calibrate(given: Session) -> int:
    """choose, visit, identify, verify and save"""
    return _session(given, "calibrate")


def collect(given: Session, *, count: Postures = 50) -> int:
    """record random postures (Datasets 4 and 5)"""
    return _session(given, "collect", count)


def verify(calibration: Saved, *, count: Postures = 6, given: Session) -> int:
    """compare a calibration with fresh measurements"""
    return _session(given, "verify", count, calibration)


def goto(
    calibration: Saved,
    *,
    to: Annotated[tuple[float, ...], "desired value of every reading", WIDE],
    given: Session,
) -> int:
    """move the end-effector to a posture, calibrated"""
    return _session(given, "goto", None, calibration, to)


def resume(run: RunPath, *, given: Session) -> int:
    """go on with a run that was paused, stopped or killed"""
    from rig.sessions import recorded, records_of, run_session

    config, start = recorded(run, given.config)
    if given.simulate and start["simulated"] is None:
        raise Refused(
            f"{run} was made with a real device, and resuming it moves that device. "
            "Leave out --simulate, or start a simulated run"
        )
    events = [record["event"] for record in records_of(run)]
    if events[-1] == "end" and "armed" in events:
        raise Refused(
            f"{run} is finished and cannot be resumed. Start a new run; `jaxcal-rig "
            f"report {run}` writes its report again"
        )
    return run_session(given, "resume", config, start, run)


def _session(
    given: Session,
    mode: str,
    count: int | None = None,
    calibration: Path | None = None,
    to: tuple[float, ...] | None = None,
) -> int:
    """Run a new session; returns the exit code."""
    from rig.sessions import run_session

    if count is not None and count < 1:
        raise Refused(f"--count must be at least 1, got {count}")
    saved = None if calibration is None else str(calibration.resolve())
    config = given.load()
    start = {
        "mode": mode,
        "inputs": {"count": count, "to": to, "calibration": saved},
        "simulated": given.simulation if given.simulate else None,
        "maps_from": str((given.config or Path()).resolve().parent),
    }
    return run_session(given, mode, config, start)


# Of the device, and of runs


def identify(given: DeviceOptions) -> int:
    """read identity and status of every drive; write nothing"""
    from rig.drives.line import BusError

    code = EXIT_OK
    with place(given) as site, site.bus("identify") as drives:
        for drive in drives:
            axis = drive.axis
            unit = f"{axis.name} (unit {axis.unit}"
            try:
                status, alarm = drive.status(), drive.alarm()
                identity = drive.ids()
            except BusError as error:
                code = EXIT_FAULT
                print(f"{unit}): {error}")
                continue
            flags = ("enabled", "done", "moving", "fault")
            words = " ".join(name for name in flags if getattr(status, name))
            word = "" if status.word is None else f"0x{status.word:04X} "
            print(
                f"{unit}, {axis.map.title}): status {word}{words}, "
                f"position {status.position} pulses = "
                f"{axis.to_deg(status.position):.4f} {axis.unit_name}"
                + (alarm and f", {alarm}"),
                *(f"    {name} = {value}" for name, value in identity.items()),
                sep="\n",
            )
    return code


def stop(*, config: ConfigPath | None = None) -> int:
    """quick-stop every drive now, and verify"""
    from rig import stopping  # as `rig.__main__` does, which loads nothing of this

    return stopping.stop_device(config or FILE, config is not None)


def check(
    file: ConfigPath | None = None,
    *,
    config: ConfigPath | None = None,
    run: Programs | None = None,
) -> int:
    """check a configuration and list every fault"""
    from rig.config import load_config
    from rig.drives import make_drives

    path = config or file or FILE
    loaded = load_config(path)
    unrun = not_asked_for(loaded, run)
    if loaded.model is not None and loaded.model.factory not in unrun:
        model_of(loaded)  # which loads numpy: half of this command's time
    if not {axis.map.drive for axis in loaded.axes} & {*unrun}:
        make_drives(loaded.bus, loaded.axes)
    print(f"{path}: valid")
    for name in unrun:
        print(f"  NOT CHECKED: {name}, a program. To check: --run {name}")
    for axis in loaded.axes:
        print(
            f"  {axis.name}: unit {axis.unit}, {axis.map.name}, "
            f"{axis.pulses_per_deg:.3f} pulses per {axis.unit_name}, "
            f"{axis.min_pulses}..{axis.max_pulses} pulses"
        )
    if loaded.imu is not None:
        print(f"  phone ({loaded.imu.format}): {loaded.imu.fields()}")
    print(f"  heartbeat {loaded.heartbeat_s:.3g} s")
    return EXIT_OK


def not_asked_for(config: RigConfig, run: list[str] | None) -> list[str]:
    """Programs named in the file (the model's, custom drives') but not on the command
    line. They are not run: a folder from someone else may hold any code."""
    named = [config.model.factory] if config.model and config.model.factory else []
    named += [axis.map.drive for axis in config.axes if axis.map.drive != "modbus"]
    return [name for name in dict.fromkeys(named) if name not in (run or ())]


def example(name: Annotated[str, "default: list the names"] | None = None) -> int:
    """print a commented example configuration"""
    from rig.config.config import example_names, example_text

    print((example_text(name) if name else "\n".join(example_names())).strip())
    return EXIT_OK


NUMBER = re.compile(r"[-+.0-9]+(?:[eE][-+]?[0-9]+)?")
NUMBERS = re.compile(rf"{NUMBER.pattern}(?:,{NUMBER.pattern})*,?")


def resolved(argv: Sequence[str]) -> tuple[list[str], str]:
    """Words as the parsers know them, ``home`` for ``setup home`` and ``calibrate
    --simulate`` for ``simulate calibrate``, and what to say of old names."""
    words, note = [*argv], ""
    if simulated := words[:1] == ["simulate"] and words[1:2] and words[1][:1] != "-":
        del words[0]
    name, step = (*words, "", "")[:2]
    if step in STEPS.get(name, ()):
        del words[0]
    elif name in PLACES:
        new = f"`jaxcal-rig {PLACES[name]} {name}`"
        note = f"jaxcal-rig: {name} is now {new}; this works until 0.4"
    if simulated:
        words.insert(1, "--simulate")
    return _ordered(words), note


def _ordered(words: list[str]) -> list[str]:
    """The numbers of ``goto --to`` by themselves and last: they are as many as the
    device measures, and would take the calibration behind them for one more."""
    if words[:1] != ["goto"]:
        return words
    for place, word in enumerate(words):
        if word.startswith("--to="):
            words = [*words[:place], "--to", word[5:], *words[place + 1 :]]
    if "--to" not in words:
        return words
    begin = end = words.index("--to") + 1
    while end < len(words) and NUMBERS.fullmatch(words[end]):
        end += 1
    numbers = ",".join(words[begin:end]).split(",")
    return [*words[: begin - 1], *words[end:], "--to", *filter(None, numbers)]


EPILOG = """\
exit codes: 0 done; 1 done, but calibrate (again), see the error; 2 bad input, nothing
moved; 3 stopped by a fault; 4 paused by Ctrl-C; 128 + signal stopped by a signal.
After 3, 4 and signals `resume RUN` continues the run.

Research software, not a medical device. Calibrate with no patient attached; a hardware
emergency stop is required.
"""


class RigParser(Parser):
    """Takes ``setup home`` and ``simulate calibrate``."""

    simulators: Mapping[argparse.Action, str | None] = {}  # options, with their help

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        if self.prog == "jaxcal-rig" and args is not None:
            args, _ = resolved(args)
        if "--simulate" in (args or ()):
            for action, text in self.simulators.items():
                action.help = text
        return super().parse_known_args(args, namespace)


def make_parser(only: str | None = None) -> Parser:
    """The parser of every command; with the options of one alone it is made quicker."""
    about = "Calibrate a device of one to six axes with its drives and its sensor."
    about += " Start with `setup`."
    parser = RigParser(prog="jaxcal-rig", description=about, epilog=EPILOG)
    added = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    names, functions, absent = offered(COMMANDS), list[Any](), dict[str, str]()
    for name in [only] if only in names else names:
        try:
            functions.append(part(name, name, COMMANDS))
        except MissingExtraError as error:  # what to install
            if name == only:
                raise
            absent[name] = str(error)
    # In the order of their modules' lines.
    for function in sorted(
        functions, key=lambda f: (f.__module__, f.__code__.co_firstlineno)
    ):
        name, text = function.__name__, function.__doc__
        place = PLACES.get(name)
        told = {} if place else {"help": text}  # a step is listed in its place's help
        more = f"\n\nsingle steps: {', '.join(STEPS[name])}" if name in STEPS else ""
        prog = " ".join(filter(None, ("jaxcal-rig", place, name)))
        command = added.add_parser(name, prog=prog, description=text + more, **told)
        command.of(function)
        if name != "simulate":
            options = [a for a in command._actions if a.dest in SIMULATOR]
            command.simulators = {action: action.help for action in options}
        for action in command.simulators:
            action.help = argparse.SUPPRESS
    for name, text in absent.items():
        added.add_parser(name, help=text)
    return parser
