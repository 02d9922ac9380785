"""The commands of ``python -m rig``; each imports what it needs."""

from __future__ import annotations

import argparse
import functools
import pathlib
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rig.config import RigConfig, example_text, load_config, parse_config
from rig.config.files import EXAMPLES, ConfigError
from rig.guard.faults import EXIT_FAULT, EXIT_OK, Refused

if TYPE_CHECKING:
    from rig.session.run import Run
    from rig.simulator import Simulator

__all__ = ["run"]

SIMULATION = ("transport", "noise", "backlash", "drift", "speedup", "rate")


def run(args: argparse.Namespace) -> int:
    """Run the command that was asked for; returns the exit code."""
    if "list" in getattr(args, "fault", []):
        from rig.simulator.faults import KINDS

        for kind, text in KINDS.items():
            print(f"{kind:<16} {text}")
        return EXIT_OK
    commands: dict[str, Callable[[argparse.Namespace], int]] = {
        "identify": _identify,
        "stop": _stop,
        "simulate": _simulate,
        "example": _example,
        "check": _check,
    }
    return commands.get(args.command, _session)(args)


def _say(text: str) -> None:
    print(text, flush=True)


def _load(args: argparse.Namespace) -> RigConfig:
    if args.config is not None:
        return load_config(args.config)
    if getattr(args, "simulate", False) or args.command == "simulate":
        return parse_config(example_text("simulate"))
    raise ConfigError("configuration", ["--config FILE is required (or --simulate)"])


def _simulator(
    config: RigConfig, options: dict[str, Any], faults: list[str]
) -> Simulator:
    from rig.simulator import Simulator, Truth, parse_fault

    truth = Truth(
        noise_deg=options["noise"],
        backlash_deg=options["backlash"],
        drift_deg_per_min=options["drift"],
        seed=config.session.seed,
    )
    return Simulator(
        config,
        truth,
        [parse_fault(text) for text in faults],
        transport=options["transport"],
        rate_hz=options["rate"],
        speedup=options["speedup"],
    )


# Sessions


def _session(args: argparse.Namespace) -> int:
    """calibrate, collect, verify, goto and resume."""
    from rig.session.run import Run, new_run_folder
    from rig.session.runner import run_safely

    resumed = args.command == "resume"
    config, start = _recorded(args) if resumed else _new(args)
    mode, simulation = start["mode"], start["simulated"]
    dry_run = getattr(args, "dry_run", False)
    procedure, zero_at = _procedure(mode, start["inputs"], dry_run)
    if args.zero:
        zero_at = None  # the operator put the device into its zero posture
    if resumed:
        folder = args.run
    else:
        folder = new_run_folder(args.out or pathlib.Path(config.output), mode)
        (folder / "rig.toml").write_text(config.text, encoding="utf-8")
    simulator = None
    if simulation is not None:
        simulator = _simulator(config, simulation, args.fault)
        config = simulator.start()
    try:
        session = Run(
            config,
            folder,
            mode,
            _say,
            start={key: start[key] for key in ("simulated", "inputs", "maps_from")},
            reset_alarms=args.reset_alarms,
            on_imu_port=simulator.start_phone if simulator else None,
            zero_at=zero_at,
        )
        if simulator is not None:
            session.phase_listeners.append(simulator.enter)
        else:
            session.confirm = functools.partial(_confirm, args)
        return run_safely(session, procedure)
    finally:
        if simulator is not None:
            simulator.close()


def _new(args: argparse.Namespace) -> tuple[RigConfig, dict[str, Any]]:
    """The configuration of a run that begins, and what its journal says of it first."""
    if getattr(args, "count", 1) < 1:
        raise Refused(f"--count must be at least 1, got {args.count}")
    calibration = getattr(args, "calibration", None)
    simulation = {name: getattr(args, name) for name in SIMULATION}
    return _load(args), {
        "mode": args.command,
        "inputs": {
            "count": getattr(args, "count", None),
            "to": getattr(args, "to", None),
            "calibration": None if calibration is None else str(calibration.resolve()),
        },
        "simulated": simulation if args.simulate else None,
        "maps_from": str((args.config or pathlib.Path()).resolve().parent),
    }


def _recorded(args: argparse.Namespace) -> tuple[RigConfig, dict[str, Any]]:
    """The same of a run that is resumed, from its folder."""
    from rig.outputs.journal import read_journal
    from rig.session.run import JOURNAL

    records = read_journal(args.run / JOURNAL)
    if not records or records[0]["event"] != "start":
        raise Refused(f"{args.run} holds no run")
    start = records[0]
    if args.config is not None:
        return load_config(args.config), start
    text = (args.run / "rig.toml").read_text(encoding="utf-8")
    return parse_config(text, pathlib.Path(start["maps_from"]), str(args.run)), start


def _procedure(
    mode: str, inputs: dict[str, Any], dry_run: bool
) -> tuple[Callable[[Run], int], Any]:
    """What a session does, and the pulses of its zero posture where they are known."""
    import numpy as np

    from rig.session import calibrate, checking

    if mode == "calibrate":
        return functools.partial(calibrate.calibrate, dry_run=dry_run), None
    count = inputs["count"]
    if mode == "collect":
        return functools.partial(checking.collect, count=count, dry_run=dry_run), None
    calibration, zero_at = checking.load_calibration(
        pathlib.Path(inputs["calibration"])
    )
    if mode == "verify":
        return lambda run: checking.verify(run, calibration, count, dry_run), zero_at
    desired = np.array(inputs["to"], dtype=np.float64)
    return lambda run: checking.goto(run, calibration, desired, dry_run), zero_at


def _confirm(args: argparse.Namespace, session: Run) -> None:
    """Ask for what --arm and --zero would have confirmed."""
    takes_zero = session.frame is None and session.zero_at is None
    questions = {
        "arm": "the device will move; nobody and nothing is in its way, no patient is "
        "attached, the emergency stop is at hand"
    }
    if takes_zero and session.config.session.zero == "here":
        questions["zero"] = "the device stands in its zero posture"
    for word, text in questions.items():
        if getattr(args, word):
            continue
        if not sys.stdin.isatty():
            raise Refused(f"{text}: confirm with --{word}")
        if input(f"{text}. Type {word} to confirm: ").strip() != word:
            raise Refused("not confirmed; nothing was moved")


# The others


def _identify(args: argparse.Namespace) -> int:
    from rig.device.bus import Bus, BusError
    from rig.device.drives import Drive

    config, simulator, failed = _load(args), None, False
    if args.simulate:
        simulator = _simulator(config, vars(args), [])
        config = simulator.start()
    try:
        with Bus(config.bus, config.silence_s) as bus:
            for axis in config.axes:
                drive, who = Drive(bus, axis), f"{axis.name} (unit {axis.unit}"
                try:
                    status, alarm = drive.status(), drive.alarm()
                    identity = drive.identity()
                except BusError as error:
                    failed = True
                    print(f"{who}): {error}")
                    continue
                names = ("enabled", "done", "moving", "fault")
                words = " ".join(name for name in names if getattr(status, name))
                print(
                    f"{who}, {axis.map.title}): status 0x{status.word:04X} {words}, "
                    f"position {status.position} pulses = "
                    f"{axis.to_deg(status.position):.4f} deg"
                    + (f", {alarm}" if alarm else "")
                )
                for name, value in identity.items():
                    print(f"    {name} = {value}")
    finally:
        if simulator is not None:
            simulator.close()
    return EXIT_FAULT if failed else EXIT_OK


def _stop(args: argparse.Namespace) -> int:
    from rig.device.bus import Bus, BusError
    from rig.device.drives import Drive
    from rig.guard.stop import stop_all

    config = _load(args)
    bus = Bus(config.bus, config.silence_s)
    try:
        bus.open()
    except BusError as error:
        raise BusError(
            f"NOTHING WAS STOPPED: {error}. If a session holds the port, press Ctrl-C "
            "twice there; otherwise use the emergency stop"
        ) from None
    with bus:
        results = stop_all([Drive(bus, axis) for axis in config.axes])
    for result in results:
        print(result)
    stopped = all(r.acknowledged and r.standing for r in results)
    return EXIT_OK if stopped else EXIT_FAULT


def _simulate(args: argparse.Namespace) -> int:
    config = _load(args)
    listens = config.imu.transport == "listen"
    if listens and config.imu.port == 0:
        imu = config.imu.model_copy(update={"port": 2055})
        config = config.model_copy(update={"imu": imu})
    port = config.bus.port if args.bus_port is None else args.bus_port
    with _simulator(config, vars(args), args.fault) as simulator:
        served = simulator.start(port)
        simulator.start_phone(config.imu.port)
        phone = f"sends to 127.0.0.1:{config.imu.port}"
        if not listens:
            phone = f"listens on 127.0.0.1:{served.imu.port}"
        print(f"drives: {served.bus.where}; units {[a.unit for a in config.axes]}")
        print(f"phone: {config.imu.format}, {phone}")
        _say("Ctrl-C ends")
        try:
            while True:
                time.sleep(3600)
        except KeyboardInterrupt:
            return EXIT_OK


def _example(args: argparse.Namespace) -> int:
    if args.name is None:
        print("\n".join(sorted(path.stem for path in EXAMPLES.glob("*.toml"))))
    else:
        print(example_text(args.name), end="")
    return EXIT_OK


def _check(args: argparse.Namespace) -> int:
    path = args.config or args.file
    if path is None:
        raise ConfigError("configuration", ["--config FILE is required"])
    config = load_config(path)
    print(f"{path}: valid; fingerprint {config.fingerprint()[:16]}")
    for axis in config.axes:
        print(
            f"  {axis.name}: unit {axis.unit}, {axis.map.name}, "
            f"{axis.pulses_per_deg:.3f} pulses per degree, "
            f"{axis.min_pulses}..{axis.max_pulses} pulses"
        )
    return EXIT_OK
