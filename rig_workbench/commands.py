"""Commands of ``jaxcal-rig`` that commission, watch, simulate, export and report.

``rig`` finds them by entry points; each loads what it needs.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
import time
from typing import Annotated, Literal

from rig.commands import AxisName, BusName, RunPath, Units, place, say
from rig.faults import EXIT_OK, EXIT_RECALIBRATE, Refused
from rig.options import FILE, DeviceOptions, Path, Step

Order = Literal["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"]


def setup(
    given: Step,
    *,
    bus: BusName = "",
    units: Units = 16,
    imu: Annotated[
        str, "APP[:PORT]: hyperimu, sensorlogger, sensorlog, json or lines"
    ] = "",
    home: Annotated[Literal["here", "drive"], "how"] = "here",
    axes: Annotated[
        str, "NAME:KIND,... with a KIND of X, Y, Z (a phone's), deg or mm"
    ] = "",
    drives: Annotated[str, "your own register map: FILE.toml"] = "",
    readings: Annotated[
        str, "instead of a phone: tcp:HOST:PORT, listen:PORT, serial:DEVICE, ..."
    ] = "",
    urdf: Annotated[str, "URDF file of an arm, whose joints are the axes"] = "",
    set: Annotated[list[str], "KEY=VALUE of the new rig.toml"] | None = None,
) -> int:
    """from cables to a device that may be calibrated; writes rig.toml"""
    from rig.journal.device import DeviceRecord
    from rig.journal.run_folder import new_run_folder
    from rig.prove import steps
    from rig_workbench.commission import setup as wizard

    path, operator = given.config or FILE, steps.Operator(given.yes, say)
    values = dict(map(wizard.setting, set or ()))
    asked = wizard.asked(
        bus=bus, imu=imu, units=units, values=values, home=home, axes=axes,
        drives=drives, readings=readings, model=urdf,
    )  # fmt: skip
    if given.simulate and (axes or drives or readings or urdf):
        raise Refused(
            "--simulate commissions the simulated device: leave out --axes, --drives, "
            "--readings and --urdf"
        )
    with contextlib.ExitStack() as stack:
        if given.simulate:
            device = dataclasses.replace(given, config=None)
            simulator = stack.enter_context(device.simulator(device.load()))
            asked = wizard.simulated(simulator, asked)
            output = Path(simulator.config.output)
            path = given.config or new_run_folder(output, "simulated") / "rig.toml"
            if path.exists():  # its bus may be that of a real device
                raise Refused(
                    f"{path} exists: --simulate writes a new file. Name a new file, or "
                    "leave out --config or --simulate"
                )
        config = wizard.begin(path, asked, operator)
        site = steps.Site(
            config, DeviceRecord.load(config.device_path), operator, path,
            reset_alarms=given.reset_alarms, full_speed=given.simulate,
        )  # fmt: skip
        return wizard.go(site, asked)


def imu(
    given: Step, *, seconds: Annotated[float, "to look at it", (1, 600)] = 5.0
) -> int:
    """what to type into the phone, and what it sends"""
    from rig_workbench.commission import setup

    with place(given) as site:
        setup.pin(site, setup.look_at_phone(site, seconds))
    return EXIT_OK


def characterise(axis: AxisName, *, given: Step) -> int:
    """measure play, dead zone and breakaway of one axis"""
    from rig_workbench.commission.characterise import step

    with place(given, "SIGN_CHECKED") as site:
        return step(site, axis)


def watch(
    run: RunPath,
    *,
    socket: Annotated[int, "port number of a running page, from a session's --live"]
    | None = None,
) -> int:
    """show a run, also a running one, as a page in the browser"""
    from socket import socket as Socket

    from jaxcal.extras import needs
    from rig.journal.run_folder import JOURNAL
    from rig.pages import listen

    if socket is None and not (run / JOURNAL).is_file():
        raise Refused(f"{run} is not a run's folder: it has no {JOURNAL}")
    with needs("live", "the live page"):
        from rig_workbench.live.server import LINGER_S, serve
    if socket is not None:
        serve(run, Socket(fileno=socket), LINGER_S)
        return EXIT_OK
    sock, line = listen()
    print(f"{line}\nCtrl-C ends", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        serve(run, sock)
    return EXIT_OK


def refit(
    run: RunPath,
    *,
    order: Annotated[Order, "mechanism.order: axes of the joints"] | None = None,
    factory: Annotated[str, "program of its [model] that may be run"] = "",
) -> int:
    """identify a recorded calibration anew"""
    from rig.sessions import recorded, records_of
    from rig_workbench.refit import refit as identify_anew

    then, start = recorded(run)
    if start["mode"] != "calibrate":
        raise Refused(f"{run} is a {start['mode']} run; refit needs a calibration")
    model = then.model.factory if then.model else ""
    if model != factory:
        raise Refused(
            f"{run} names [model] factory = {model!r}, a program that refit would run"
            + (f": give --factory {model}" if model else f", not {factory!r}")
        )
    return identify_anew(run, records_of(run), then, order, print)


def report(run: RunPath) -> int:
    """write report.html of any run, also unfinished"""
    from rig.sessions import records_of
    from rig_workbench.outputs.report import write_report

    print(write_report(run, records_of(run)))
    return EXIT_OK


def export(
    run: RunPath,
    *,
    to: Literal["c", "st", "json"],
    out: Annotated[Path, "file to write; default: print it"] | None = None,
) -> int:
    """print the inverse map of a calibration for a controller"""
    from jaxcal.files import write_text
    from rig.sessions import records_of
    from rig_workbench.outputs.export import LANGUAGES, load_inverse

    inverse = load_inverse(run, records_of(run))
    for text in inverse["warnings"]:
        print(f"WARNING: {text}", file=sys.stderr)
    text = LANGUAGES[to](inverse)
    if out is None:
        print(text, end="")
    else:
        write_text(out, text)
        print(f"{out}: SHA-256 of the numbers {inverse['checksum']}")
    return EXIT_OK


def trend(folder: Annotated[Path, "of runs, searched with its subfolders"]) -> int:
    """compare the calibrations of a device over time"""
    from rig_workbench.outputs.trend import read_runs, trend_lines

    if not folder.is_dir():
        raise Refused(f"{folder} is not a folder")
    devices, skipped = read_runs(folder)
    for text in skipped:
        print(f"left out: {text}", file=sys.stderr)
    if not devices:
        raise Refused(f"{folder} has no finished calibration or verification")
    trends = [trend_lines(runs) for runs in devices]
    for lines, _ in trends:
        print(*lines, sep="\n")
    return EXIT_RECALIBRATE if any(again for _, again in trends) else EXIT_OK


def simulate(
    given: DeviceOptions, *, bus_port: Annotated[int, "0: any free one"] | None = None
) -> int:
    """serve simulated drives and a phone on loopback"""
    config = given.load(simulated=True)
    with given.simulator(config) as simulator:
        served = simulator.start(config.bus.port if bus_port is None else bus_port)
        phone = f"listens on 127.0.0.1:{served.source.port}"
        if config.source.transport in ("listen", "udp"):
            port = config.source.port or 2055
            simulator.start_phone(port)
            phone = f"sends to 127.0.0.1:{port}"
        print(f"drives: {served.bus.where}; units {[a.unit for a in config.axes]}")
        print(f"{'phone: ' + config.imu.format if config.imu else 'sensor'}, {phone}")
        print("Ctrl-C ends", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                time.sleep(3600)
    return EXIT_OK
