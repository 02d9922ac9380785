"""A fast simulated rig and the means to run, spoil, kill and resume sessions on it.

Also a program: ``python harness.py FOLDER CONFIG FAULT PHASE`` is one session that does
something to itself when it enters a phase; the simulator lives in the parent.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import pathlib
import random
import resource
import signal
import socket
import sys
import time
from unittest import mock

import numpy as np

from rig.command_run import Run, listen, run_safely
from rig.config import RigConfig, parse_config
from rig.config.config import EXAMPLES
from rig.config.maps import RegisterMap, available_maps, load_map
from rig.core import device, motion, stop
from rig.core.line_client import line_of
from rig.drives import make_drives
from rig.drives.bus import words_of
from rig.faults import Signals
from rig.journal.device import (
    HOMED,
    IDENTIFIED,
    SIGN_CHECKED,
    STOP_PROVED,
    DeviceRecord,
)
from rig.journal.lock import BusLock
from rig.journal.run_folder import JOURNAL, read_journal
from rig.outputs import messages
from rig.procedures.calibrate import calibrate
from rig_workbench import simulator as simulators
from rig_workbench.outputs import report
from rig_workbench.simulator import Truth

AS_OF_A_DEVICE = (
    stop.VERIFY_S,
    stop.stand_s,
    motion.TOO_FAST,
)  # as sessions of a device have them
# A simulated drive stands within 0.1 s; for a dead one the whole time is waited.
stop.VERIFY_S = 0.6
device.PATIENCE_S = 2.0  # with a phone that is gone
stop.stand_s = lambda drives: 0.05
motion.TOO_FAST *= 3.0  # as fast as the simulated drives are


def free_port() -> int:
    """An unused local port, outside the range from which the system assigns ports."""
    for port in PORTS:
        with contextlib.suppress(OSError), socket.create_server(("127.0.0.1", port)):
            return port
    raise AssertionError("no port is free")


def line_here(config, emit):
    """A line without a process of its own: of sessions in the process of a test."""
    return make_drives(config.bus, config.axes, config.silence_s, emit)


LINES = line_here  # of sessions in this process; those of commands have their own
# Below the range from which the system assigns ports: no other test's connection or
# server can take one before it is used. Above 2055x: tests replace "port = 2055".
PORTS = itertools.count(random.SystemRandom().randrange(21_000, 30_000))
RATE_HZ = 250.0
MODBUS_MAPS = [n for n in available_maps() if isinstance(load_map(n), RegisterMap)]
SPEEDUP = 3.0  # of the drives over what the configuration says of them
ENTERED = "entered"  # the file by which a session says that it is in the phase
HOST_FAULTS = ("sigint", "sigint_twice", "sigterm", "sigkill", "full_disk")
OTHERS = (
    "second_session",
    "other_stop",
    "foreign_stop",
    "suspended_stop",
)  # commands from another terminal
WATCHED = {  # drives that stop themselves when the line is silent
    'map = "leadshine_pr"': 'map = "generic"\ncomm_timeout_s = 0.8',
    "timeout_s = 0.5": "timeout_s = 0.25",
}
FAST = {  # quick axes and short windows; a busy computer may still answer late
    "speed_deg_s = 120": "speed_deg_s = 400",
    "accel_deg_s2 = 1200": "accel_deg_s2 = 8000",
    "poll_s = 0.01": "poll_s = 0.005\nstall_s = 0.3\nmax_speed_deg_s = 400",
    "window_s = 0.2": "window_s = 0.04",
    "min_samples = 10": "min_samples = 5",
    "samples = 25": "samples = 5",
    "timeout_s = 5": "timeout_s = 3",
}
# With the default noise of 0.02 degrees a settle window of 0.04 s passes one time in
# three: on a busy computer too few are looked at until `settle.timeout_s` is over.
QUIET = ["--rate", "250", "--noise", "0.005"]
# Only where a fault is to be found; the fingerprint is the same, so that a hasty
# session can be resumed by a patient one.
HASTY = {"timeout_s = 0.5": "timeout_s = 0.08", "stale_s = 1.0": "stale_s = 0.25"}
UNSETTLED = {"timeout_s = 3": "timeout_s = 1.2"}  # where it is not to settle
SESSION = '\n[session]\nmethod = "exact"\nverify_postures = 1\n'


def read_words(bus, unit, address, count, retries=None):
    """Holding registers, as numbers."""
    return words_of(bus.read(unit, 3, address, count, retries))


def fast_text(changes: dict[str, str] | None = None, session: str = SESSION) -> str:
    """The shipped example with quick axes and a short settle window."""
    text = (EXAMPLES / "simulate.toml").read_text()
    for replaced in (FAST, changes or {}):
        for old, new in replaced.items():
            assert old in text, old
            text = text.replace(old, new)
    return text + session


def axes_text(axes: dict[str, str], order: str = "ZXY", session: str = SESSION) -> str:
    """The same of other axes: name to the letter that each turns about."""
    head, first, *_, last = fast_text(session=session).split("[[axes]]")
    tables = [
        f'[[axes]]\nname = "{name}"\nrotates = "{letter}"\nunit = {unit}'
        + first.partition("unit = 1")[2]
        for unit, (name, letter) in enumerate(axes.items(), 1)
    ]
    tail = last[last.index("[imu]") :].replace('order = "ZXY"', f'order = "{order}"')
    return head + "".join(tables) + tail


LINEAR = """[[axes]]
name = "{name}"
kind = "{kind}"
unit = {unit}
map = "leadshine_pr"
pulses_per_rev = 10000
reduction = {reduction}
{lead}min_{u} = -20
max_{u} = 20
speed_{u}_s = 400
accel_{u}_s2 = 8000

"""


def measured_text(axes: dict[str, str], transport: str = "tcp") -> str:
    """Of axes by name and kind, measured by a sensor's lines, a number for each."""
    text = fast_text()
    tables = "".join(
        LINEAR.format(
            name=name, kind=kind, unit=unit, u="mm" if kind == "translation" else "deg",
            reduction=1 if kind == "translation" else 10,
            lead="lead_mm = 10\n" if kind == "translation" else "",
        )
        for unit, (name, kind) in enumerate(axes.items(), 1)
    )  # fmt: skip
    readings = (
        f'[readings]\nnames = {list(axes)}\nunit = "mm"\ntransport = "{transport}"\n'
        "scale = 1.0\nstale_s = 1.0\n\n"
    )
    head, tail = text.split("[[axes]]")[0], text[text.index("[motion]") :]
    return head + tables + readings + tail


ARM = pathlib.Path(__file__).parent / "arm5.urdf"


def arm_text(more: str = "", session: str = "k = 12\nverify_postures = 4") -> str:
    """Of an arm of five joints, by its URDF, with a phone at its tip."""
    text = axes_text(dict.fromkeys(("turn", "shoulder", "elbow", "bend", "twist"), "X"))
    text = text[: text.index("[session]")].replace('rotates = "X"\n', "")
    text = text.replace("min_deg = -20", "min_deg = -40")
    text = text.replace("max_deg = 20", "max_deg = 40")
    return f'{text}[model]\nurdf = "{ARM}"\n{more}\n[session]\n{session}\n'


def changed(settings, **changes):
    """The same settings but for some."""
    return settings.model_copy(update=changes)


def fast_config(changes: dict[str, str] | None = None) -> RigConfig:
    return parse_config(fast_text(changes))


def commissioned(
    config: RigConfig, folder: pathlib.Path, sim: Simulator | None = None
) -> DeviceRecord:
    """The record in a folder, with every state that a session needs.

    What was lost is reached again, as `home` and `axes` would.
    """
    record = DeviceRecord.load(folder / "device.json")
    if record.state(HOMED) is None:
        record.left_at(dict.fromkeys(config.axis_names))
        for drive in sim.drives if sim else ():
            drive.alarm = 0
    for name in (IDENTIFIED, HOMED, SIGN_CHECKED):
        if record.state(name) is None:
            record.reach(name, config)
    if record.state(STOP_PROVED) is None:
        prove_stops(record, config)
    return record


def prove_stops(record: DeviceRecord, config: RigConfig) -> None:
    """The state STOP_PROVED of a device that stands at once, as the simulated one."""
    distances = {
        axis.name: {"speeds": [5.0], "distances": [0.0], "accel": axis.drive_motion[1]}
        for axis in config.axes
    }
    record.reach(STOP_PROVED, config, distances=distances)


def notes_of(config: RigConfig) -> dict:
    """What a calibration keeps of the simulated device: it stands upright at zero."""
    return {
        "device": config.device_fingerprint(),
        "zero_pulses": config.to_pulses(Truth().jig_deg),
        "zero_attitude": np.eye(3).tolist(),
    }


class Simulator(simulators.Simulator):
    """A simulated rig, and what is done to it in the night and in the workshop."""

    def power_cycle(self, lost_deg: tuple[float, float, float] = (0, 0, 0)) -> None:
        """All drives off and on: their counters come back so many degrees away."""
        with self.server.lock:
            for drive, lost in zip(self.drives, lost_deg, strict=True):
                drive.power_cycle(lost)

    def repair(self) -> None:
        """Undo every fault, as a technician would before the run is resumed."""
        self.faults.clear()
        self.plant.slip[:] = 0.0
        with self.server.lock:
            for drive in self.drives:
                if drive.offset:
                    drive.find_origin()

    def executions(self) -> list[list[int]]:
        """Targets in pulses each drive really ran, pitch, yaw, roll."""
        return [list(drive.executions) for drive in self.drives]

    def confine(self, low_deg: float, high_deg: float) -> None:
        """The drives refuse targets outside."""
        for axis, drive in zip(self.config.axes, self.drives, strict=True):
            drive.travel = tuple(sorted(map(axis.to_pulses, (low_deg, high_deg))))


def simulator(config: RigConfig, **options) -> Simulator:
    """Noise-free, so that an interrupted run must give the very same calibration."""
    noise = options.pop("noise_deg", 0.0)
    truth = options.pop("truth", Truth(noise_deg=noise))
    options.setdefault("rate_hz", RATE_HZ)
    options.setdefault("speedup", SPEEDUP)
    travel_deg = options.pop("travel_deg", None)
    made = Simulator(config, truth, **options)
    if travel_deg:
        made.confine(*travel_deg)
    return made


def make_run(*args, **more) -> Run:
    """A run as the command line makes it: signals, console and telemetry listen."""
    run = Run(*args, signals=Signals(), **more)
    run.lines = LINES
    listen(run)
    return run


def session(
    config: RigConfig,
    folder: pathlib.Path,
    sim: Simulator | None = None,
    said: list[str] | None = None,
    listeners=(),
    answer: bool = True,
    figures: bool = False,
    record: DeviceRecord | None = None,
) -> int:
    """One session in this process; the same call again resumes it.

    Half of a session's time is matplotlib's, so the report has its figures only where
    they are looked at.
    """
    folder.mkdir(parents=True, exist_ok=True)
    run = make_run(
        config,
        folder,
        "calibrate",
        (said if said is not None else []).append,
        record=record or commissioned(config, folder, sim),
        start={"simulated": None, "inputs": {}, "maps_from": "."},
        reset_alarms=True,
    )
    if sim and answer:
        run.listeners.append(sim.answer)
    for listener in listeners:
        on_phase(run, lambda phase, f=listener: f(run, phase))
    with contextlib.nullcontext() if figures else no_figures():
        return run_safely(run, calibrate)


def on_phase(run: Run, listener) -> None:
    """Call a function whenever the run enters a phase."""
    run.listeners.append(
        lambda record: record["event"] == "phase" and listener(record["phase"])
    )


@contextlib.contextmanager
def no_figures():
    """The report written here, and without its figures: another process that loads
    matplotlib takes longer than a fast session."""

    def here(folder: pathlib.Path) -> None:
        report.write_report(folder, read_journal(folder / JOURNAL))

    with (
        mock.patch.object(messages, "write_report", here),
        mock.patch.object(report, "drawn", lambda *_: "no figures in this test"),
    ):
        yield


def in_the_middle(run: Run, phase: str) -> bool:
    """Two postures are recorded, so there is something to lose."""
    return phase == "zeroing" or len(run.journal.events("posture")) >= 2


def _spoil(fault: str, journal: pathlib.Path) -> None:
    if fault == "full_disk":
        size = journal.stat().st_size + 20
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
        return
    if fault in OTHERS:
        (journal.parent / ENTERED).touch()
        return
    number = {
        "sigkill": signal.SIGKILL,
        "sigkill_watched": signal.SIGKILL,
        "sigterm": signal.SIGTERM,
    }.get(fault, signal.SIGINT)
    os.kill(os.getpid(), number)
    if fault == "sigint_twice":
        time.sleep(0.01)
        os.kill(os.getpid(), number)


def _main(folder: str, config_path: str, fault: str, phase: str) -> int:
    global LINES
    LINES = line_of
    config = parse_config(pathlib.Path(config_path).read_text())
    done = []

    def listen(run: Run, entered: str) -> None:
        if entered == phase and not done and in_the_middle(run, entered):
            done.append(True)
            _spoil(fault, pathlib.Path(folder) / "journal.jsonl")

    said: list[str] = []
    whole = fault == "full_disk"  # the figures are what no longer fits on the disk
    with BusLock(config.bus).acquire("calibrate") as lock:
        lock.tell(run=str(pathlib.Path(folder).resolve()))
        code = session(
            config, pathlib.Path(folder), None, said, [listen], figures=whole
        )
    print("\n".join(said[-6:]))
    return code


if __name__ == "__main__":
    sys.exit(_main(*sys.argv[1:]))
