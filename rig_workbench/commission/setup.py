"""From cables to a device that may be calibrated, one question at a time."""

from __future__ import annotations

import contextlib
import dataclasses
import pathlib
import re
import socket
import time
import tomllib
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal.files import write_text
from jaxcal.reports.page import template
from rig.config import RigConfig, load_config, parse_config
from rig.config.axis import DEFAULT_ROTATES as DEFAULT_AXES
from rig.config.settings import BusSettings, ImuSettings, ReadingsSettings
from rig.core.session import STREAM_WAIT_S
from rig.faults import EXIT_OK, Refused
from rig.journal.device import HOMED, IDENTIFIED, STOP_PROVED, ZEROED
from rig.prove import steps
from rig.prove.home import can_home
from rig.prove.scan import OF_LINE, Answer, parse_bus, place_of, scan, serial_lines
from rig.prove.steps import Operator, edit, set_values
from rig.readings import make_source
from rig.readings.geometry import Attitudes, Geometry, geometry_of
from rig.readings.phone import Imu
from rig.readings.source import Source
from rig_workbench.model import joint_names

if TYPE_CHECKING:
    from rig.parts import SimulatedDevice

FORMATS = ["hyperimu", "sensorlogger", "sensorlog", "json", "lines"]
SAFETY = (
    "Research software, not a medical device. Confirm: no patient is attached, no "
    "person is within reach of the device, a hardware emergency stop is at hand."
)


@dataclasses.dataclass(frozen=True)
class SetupOptions:
    """What the command line says, so that it is not asked."""

    bus: str = ""
    imu: str = ""  # FORMAT or FORMAT:PORT
    units: int = 16
    values: dict[str, Any] = dataclasses.field(default_factory=dict)  # of rig.toml
    home: str = "here"
    # Axis to X, Y or Z that it turns about, deg of a rotation, mm of a translation.
    axes: dict[str, str] = dataclasses.field(default_factory=lambda: dict(DEFAULT_AXES))
    drives: str = ""  # map of the drives; none: Modbus drives that are found
    readings: str = ""  # where numbers come from; none: a phone
    model: str = ""  # URDF file of an arm


KINDS = ("X", "Y", "Z", "deg", "mm")
OF_READINGS = {  # keys of [readings]
    "tcp": ("host", "port"),
    "listen": ("port",),
    "udp": ("port",),
    "serial": ("device", "baudrate"),
    "modbus": ("host", "port"),
}
SENSORS = (
    "tcp:HOST:PORT, listen:PORT, udp:PORT, serial:DEVICE[,BAUD] or modbus:HOST[:PORT]"
)


def axis_kinds(text: str) -> dict[str, str]:
    """``NAME:KIND,...``; Refused where that is not what it is."""
    kinds = {}
    for word in text.split(","):
        name, _, kind = word.partition(":")
        if not re.fullmatch("[a-z][a-z0-9_]*", name) or kind not in KINDS:
            raise Refused(
                f"--axes must be NAME:KIND,... with a KIND of {', '.join(KINDS)}, got "
                f"{word!r}"
            )
        if name in kinds:
            raise Refused(f"--axes: the axis {name} is named twice")
        kinds[name] = kind
    return kinds


def asked(*, axes: str, **given: Any) -> SetupOptions:
    """What the command line says; Refused where an option is not what it must be."""
    options = {name: value for name, value in given.items() if value}
    if axes:
        options["axes"] = axis_kinds(axes)
    elif urdf := options.get("model"):
        options["axes"] = dict.fromkeys(joint_names(urdf), "deg")
    made = SetupOptions(**options)
    if made.readings and made.imu:
        raise Refused("--imu and --readings: give only one, a phone or a sensor")
    by_phone = ("X", "Y", "Z", "deg") if made.model else ("X", "Y", "Z")
    wrong = [f"{n}:{kind}" for n, kind in made.axes.items() if kind not in by_phone]
    if wrong and not made.readings:
        raise Refused(
            f"--axes {', '.join(wrong)}: a phone measures rotations about X, Y, Z; "
            "other axes need --readings"
        )
    return made


def sensor_of(text: str) -> dict[str, Any]:
    """Keys of ``[readings]`` of a text as SENSORS."""
    if (sensor := place_of(text, OF_READINGS)) is None:
        raise Refused(f"--readings must be {SENSORS}, got {text!r}")
    if sensor["transport"] in ("listen", "udp"):
        sensor["host"] = "0.0.0.0"  # every address of this computer
    return sensor


def setting(text: str) -> tuple[str, Any]:
    """A key of rig.toml and its value; what is no TOML is a text."""
    key, equals, value = text.partition("=")
    if not equals:
        raise Refused(f"--set must be KEY=VALUE, got {text!r}")
    try:
        return key, tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return key, value


def simulated(simulator: SimulatedDevice, options: SetupOptions) -> SetupOptions:
    """What an operator would answer of a simulated device, and its phone started."""
    bus = simulator.start().bus
    where = f"{bus.transport}:{bus.host}:{bus.port}"
    if bus.transport == "rtu":
        where = f"rtu:{bus.device},{bus.baudrate},N,8,1"
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    simulator.start_phone(port)
    imu = simulator.config.phone
    values: dict[str, Any] = {"imu.host": "127.0.0.1", "imu.stale_s": imu.stale_s}
    for axis in simulator.config.axes:
        for name in ("reduction", "speed_deg_s", "accel_deg_s2"):
            values[f"axes.{axis.name}.{name}"] = getattr(axis, name)
    return dataclasses.replace(
        options, bus=where, imu=f"{imu.format}:{port}", values=values | options.values
    )


def begin(path: pathlib.Path, options: SetupOptions, operator: Operator) -> RigConfig:
    """The configuration of a file, which is written where there is none."""
    operator.confirm(SAFETY, "setup")
    if not path.exists():
        return write_config(path, options, operator)
    if options.values:
        raise Refused(f"{path} exists: edit it, or leave out --set")
    operator.say(f"{path} exists and is used; delete it to start again")
    return load_config(path)


def write_config(
    path: pathlib.Path, options: SetupOptions, operator: Operator
) -> RigConfig:
    """Ask for bus, axes and phone, and write a new rig.toml."""
    say = operator.say
    say("1 ports")
    lines = serial_lines()
    for line in lines or ["no serial port on this computer"]:
        say(f"  {line}")
    default = f"rtu:{lines[0].partition(':')[0]},115200,N,8,1" if lines else ""
    question = "bus, as rtu:DEVICE,BAUD,PARITY,BITS,STOPBITS or tcp:HOST:PORT"
    bus = parse_bus(options.bus or operator.ask(question, default))
    answers: list[Answer] = []
    if options.drives:
        say(f"2 scan: skipped, --drives {options.drives} is given")
    else:
        say(f"2 scan: units 1 to {options.units} on {bus.where}; reads only")
        answers = scan(bus, options.units, lambda text: say(f"  {text}"))
        if any(answer.echo for answer in answers):
            bus = bus.model_copy(update={"echo": True})
    say("3 axes: which unit drives which joint. Step 8 checks it by moving them")
    axes = _ask_axes(answers, options, operator)
    source: dict[str, Any]
    if options.readings:
        say("4 sensor")
        source = {"names": list(options.axes), "sensor": sensor_of(options.readings)}
        unit = "mm" if "mm" in options.axes.values() else "deg"
        source["unit"] = operator.ask("unit of the readings", unit)
        if options.model:
            source |= {"names": ["x", "y", "z"], "unit": "m"}
    else:
        say("4 phone")
        form, _, port = (options.imu or "").partition(":")
        question = f"app of the phone ({', '.join(FORMATS)})"
        form = form or operator.choose(question, FORMATS, FORMATS[0])
        port = port or operator.ask("TCP port that the phone sends to", "2055")
        source = {"form": form, "port": int(port)}
    values = dict(options.values)
    for name in options.axes:
        key = f"axes.{name}.reduction"
        if key not in values:
            question = f"{name}: motor turns for one turn of the joint (gearbox)"
            values[key] = operator.number(question, 1.0)
    text = set_values(new_text(bus, axes, **source, model=options.model), values)
    config = parse_config(text, path.parent, str(path))
    operator.confirm(f"setup writes {path}", "write")
    write_text(path, text)
    return config


def new_text(
    bus: BusSettings,
    axes: Sequence[Mapping[str, Any]],
    form: str = "",
    port: int = 0,
    model: str = "",
    **numbers: Any,
) -> str:
    """A whole configuration: ``axes`` have name, kind, unit, family, pulses and, of mm,
    lead; ``form`` is the phone's app, else ``numbers`` are names, unit and sensor."""
    keys = OF_LINE[bus.transport] + ("echo",) * bus.echo
    new = template(pathlib.Path(__file__).with_name("new.toml.j2"))
    told = numbers | {"form": form, "port": port, "model": model}
    return str(new.render(bus=dict(bus), keys=keys, axes=axes, **told))


def _ask_axes(
    answers: list[Answer], options: SetupOptions, operator: Operator
) -> list[dict[str, Any]]:
    usable = {answer.unit: answer for answer in answers if answer.families}
    if options.drives:
        usable = {unit: Answer(unit, (options.drives,), {}) for unit in range(1, 7)}
    if len(usable) < len(options.axes):
        unknown = [answer.unit for answer in answers if not answer.families]
        others = f"; units {unknown} answer, but are of no known family"
        raise Refused(
            f"{len(options.axes)} drives of a known family are needed for "
            f"{', '.join(options.axes)}; found {len(usable)}{others * bool(unknown)}. "
            "Check power, wiring, termination, the line format, and that every drive "
            "has its own unit id; another family needs a map (docs/rig.md)"
        )
    free, axes = sorted(usable), []
    for name, kind in options.axes.items():
        choices = [str(unit) for unit in free]
        unit = int(operator.choose(f"unit of {name}", choices, choices[0]))
        free.remove(unit)
        answer = usable[unit]
        family = answer.families[0]
        if len(answer.families) > 1:
            question = f"unit {unit} could be {' or '.join(answer.families)}: which"
            family = operator.choose(question, list(answer.families), family)
        question = f"{name}: pulses per motor turn"
        pulses = answer.pulses_per_rev or int(operator.number(question, 10000))
        axis = dict(name=name, kind=kind, unit=unit, family=family, pulses=pulses)
        if kind == "mm":
            question = f"{name}: mm per turn of its screw, pulley or pinion"
            axis["lead"] = operator.number(question, 1.0)
        axes.append(axis)
    return axes


def go(site: steps.Site, options: SetupOptions) -> int:
    """All steps from IDENTIFIED on; those that stand already are left out."""
    operator, say, record = site.operator, site.say, site.record
    assert site.path is not None
    say(f"device record: {record.path}")
    if record.missing(site.config, IDENTIFIED):
        steps.show_identity(site)
    say("5 imu")
    pin(site, look_at_phone(site))
    if record.missing(site.config, HOMED):
        say("6 jog and home")
        names = site.config.axis_names
        choices = [*names, "no"]
        question = f"move an axis towards the zero posture ({', '.join(choices)})"
        while not operator.yes:
            if (name := operator.choose(question, choices, "no")) == "no":
                break
            way = operator.number(f"{name}: degrees", 1.0, steps.MOST_JOG_DEG)
            steps.jog(site, name, way)
        how = "here"
        if can_home(site.config):
            question = "here (it is in its home posture), or drive (by its own homing)"
            how = operator.choose(question, ["here", "drive"], options.home)
        if code := steps.go_home(site, how == "here"):
            return code
        say("7 limits")
        _ask_limits(site)
    if record.missing(site.config, STOP_PROVED):
        say("8 axes")
        if code := steps.axes(site):
            return code
    if record.missing(site.config, ZEROED):
        say("9 zero")
        if code := steps.take_zero(site):
            return code
    say(f"the device is commissioned: {record.path}")
    say(f"next: {site.command('calibrate')}")
    return EXIT_OK


def pin(site: steps.Site, sender: str) -> None:
    """Only this phone is listened to from now on."""
    phone = site.config.imu
    if site.path is None or not sender or phone is None or sender in phone.allow:
        return
    site.operator.confirm(f"imu: accept readings from {sender} only", "listen")
    site.take(edit(site.path, {"imu.allow": [sender]}))


def _ask_limits(site: steps.Site) -> None:
    assert site.path is not None
    values: dict[str, float] = {}
    for axis in site.config.axes:
        for end, name in (("lowest", "min_deg"), ("highest", "max_deg")):
            now = getattr(axis, name)
            what = "place" if axis.kind == "translation" else "angle"
            question = f"{axis.name}: {end} safe {what}, {axis.unit_name} from home"
            if (number := site.operator.number(question, now)) != now:
                values[f"axes.{axis.name}.{axis.key_of(name)}"] = number
    if values:
        site.take(edit(site.path, values))


# What the phone sends

WATCH_S = 5.0
SHOWN = 300  # letters of a record
LOOK_S = 1.0
# Below these a session's settle window would hardly ever fill.
SLOW_HZ, LONG_GAP_S = 5.0, 0.3


def look_at_phone(site: steps.Site, seconds: float = WATCH_S) -> str:
    """Wait for the phone and tell what it sends; its address."""
    config = site.config
    with make_source(config) as imu:
        site.say(
            f"imu: {place_text(config.source, imu.port)}; then start its "
            f"stream (waiting up to {STREAM_WAIT_S:g} s)"
        )
        for listener in site.listeners:
            listener({"event": "listening", "port": imu.port})
        _watch(imu, geometry_of(config), seconds, site.say)
        if isinstance(imu, Imu):
            sent = imu.parser
            site.say(f"  it sends {sent.first[:SHOWN]}\n  read as {sent.taken_for}")
        return imu.sender


def place_text(settings: ImuSettings | ReadingsSettings, port: int) -> str:
    """What to type into the phone's app, or where a sensor's numbers come from."""
    place = f"{reached_at(settings.host)} port {port}"
    if settings.transport in ("listen", "udp"):
        if isinstance(settings, ImuSettings):
            return f"type into the phone's app ({settings.format}): {place}"
        return f"waiting for the sensor on {place}"
    return f"readings from {getattr(settings, 'device', '') or place}"


def _watch(
    imu: Source, geometry: Geometry, seconds: float, say: Callable[[str], None]
) -> None:
    """Look at an open stream for so long, telling each second; ReadingError where
    nothing comes, or the stream is not to be trusted."""
    start, spent = imu.wait_for_stream(STREAM_WAIT_S).time, 0.0
    while spent < seconds:
        time.sleep(min(LOOK_S, seconds - spent))
        imu.latest()
        readings, spent = imu.since(start), time.monotonic() - start
        gaps = np.diff([reading.time for reading in readings])
        values = [reading.value for reading in readings[-500:]]
        mean = geometry.mean(values)
        apart = [geometry.apart(mean, value) for value in values]
        scatter = float(np.sqrt(np.mean(np.square(apart)) / len(mean)))
        stands = "reads " + " ".join(f"{value:.6g}" for value in np.ravel(mean))
        if isinstance(geometry, Attitudes):
            tilt = np.degrees(np.arccos(np.clip(mean[2, 2], -1.0, 1.0)))
            stands = f"tilt {tilt:.1f} deg"
        dropped = [f"{n} {why}" for why, n in imu.counts.items() if why != "accepted"]
        rate, gap = len(readings) / spent, float(gaps.max(initial=0.0)) or spent
        say(
            f"  {rate:.0f} readings per s, longest gap {gap:.2f} s, scatter "
            f"{scatter:.3g}, {stands}, dropped: " + (", ".join(dropped) or "none")
        )
    if rate < SLOW_HZ or gap > LONG_GAP_S:
        say(
            f"  note: sessions need {SLOW_HZ:g} readings per s without gaps over "
            f"{LONG_GAP_S:g} s. {imu.lost}, raise its rate; or raise "
            f"{imu.table}.stale_s and settle.window_s"
        )


def reached_at(host: str) -> str:
    """IPv4 address under which a phone reaches what listens on ``host``."""
    if host not in ("0.0.0.0", "::"):
        return host
    # Connecting UDP sends nothing; it tells the address packets leave from.
    with (
        contextlib.suppress(OSError),
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe,
    ):
        probe.connect(("192.0.2.1", 9))
        return str(probe.getsockname()[0])
    return "(this computer has no network address)"
