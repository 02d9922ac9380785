"""``python -m rig``: the command line. Heavy imports wait for their command."""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rig.arguments import make_parser

if TYPE_CHECKING:
    from rig.session import Run
    from rig.settings import RigConfig
    from rig.simulator import Simulator


def _simulation(args: argparse.Namespace) -> dict[str, Any]:
    return {
        "transport": args.transport,
        "noise": args.noise,
        "backlash": args.backlash,
        "drift": args.drift,
        "speedup": args.speedup,
        "rate": args.rate,
    }


def _load(args: argparse.Namespace) -> RigConfig:
    from rig.config import ConfigError, example_text, load_config, parse_config

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


def _confirm(args: argparse.Namespace, simulated: bool) -> Any:
    from rig.exits import Refused

    def ask(word: str, text: str) -> None:
        if not sys.stdin.isatty():
            raise Refused(f"{text}: confirm with --{word}")
        if input(f"{text}; type {word} to go on: ").strip() != word:
            raise Refused("not confirmed; nothing was moved")

    def confirm(run: Run) -> None:
        if simulated:
            return
        if not args.arm:
            ask("arm", "the device will move; nobody and nothing is in its way, no "
                "patient is attached, the emergency stop is at hand")  # fmt: skip
        takes_zero = run.frame is None and run.zero_at is None
        if takes_zero and run.config.session.zero == "here" and not args.zero:
            ask("zero", "the device stands in its zero posture")

    return confirm


def _new(args: argparse.Namespace) -> tuple[RigConfig, dict[str, Any]]:
    """The configuration of a run that begins, and what its journal says of it first."""
    from rig.exits import Refused

    if getattr(args, "count", 1) < 1:
        raise Refused(f"--count must be at least 1, got {args.count}")
    calibration = getattr(args, "calibration", None)
    return _load(args), {
        "mode": args.command,
        "inputs": {
            "count": getattr(args, "count", None),
            "to": getattr(args, "to", None),
            "calibration": None if calibration is None else str(calibration.resolve()),
        },
        "simulated": _simulation(args) if args.simulate else None,
        "maps_from": str((args.config or pathlib.Path()).resolve().parent),
    }


def _recorded(args: argparse.Namespace) -> tuple[RigConfig, dict[str, Any]]:
    """The same of a run that is resumed, from its folder."""
    from rig.config import load_config, parse_config
    from rig.exits import Refused
    from rig.journal import read_journal
    from rig.session import JOURNAL

    records = read_journal(args.run / JOURNAL)
    if not records or records[0]["event"] != "start":
        raise Refused(f"{args.run} holds no run")
    start = records[0]
    if args.config is not None:
        return load_config(args.config), start
    text = (args.run / "rig.toml").read_text(encoding="utf-8")
    return parse_config(text, pathlib.Path(start["maps_from"]), str(args.run)), start


def _session(args: argparse.Namespace) -> int:
    from rig import session
    from rig.runner import run_safely

    resumed = args.command == "resume"
    config, start = _recorded(args) if resumed else _new(args)
    mode, inputs, simulation = start["mode"], start["inputs"], start["simulated"]
    calibration, zero_at = None, None
    if mode in ("verify", "goto"):
        from rig.other_sessions import load_calibration

        calibration, zero_at = load_calibration(
            pathlib.Path(inputs["calibration"]), config
        )
        if args.zero:
            zero_at = None  # the operator put the device into its zero posture
    if resumed:
        folder = args.run
    else:
        folder = session.new_run_folder(args.out or config.output, mode)
        (folder / "rig.toml").write_text(config.text, encoding="utf-8")
    simulator = None
    if simulation is not None:
        simulator = _simulator(config, simulation, args.fault)
        config = simulator.start()
    try:
        run = session.Run(
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
            run.phase_listeners.append(simulator.enter)
        run.confirm = _confirm(args, simulated=simulator is not None)
        dry = getattr(args, "dry_run", False)
        return run_safely(run, _procedure(mode, inputs, calibration, dry))
    finally:
        if simulator is not None:
            simulator.close()


def _procedure(mode: str, inputs: dict[str, Any], calibration: Any, dry: bool) -> Any:
    import numpy as np

    from rig import calibrate, other_sessions

    if mode == "calibrate":
        return lambda run: calibrate.calibrate(run, dry)
    if mode == "collect":
        return lambda run: other_sessions.collect(run, inputs["count"], dry)
    if mode == "verify":
        return lambda run: other_sessions.verify(run, calibration, inputs["count"], dry)
    desired = np.array(inputs["to"], dtype=np.float64)
    return lambda run: other_sessions.goto(run, calibration, desired, dry)


def _say(text: str) -> None:
    print(text, flush=True)


def _identify(args: argparse.Namespace) -> int:
    from rig.bus import Bus, BusError
    from rig.drives import Drive

    config = _load(args)
    simulator = None
    if args.simulate:
        simulator = _simulator(config, _default_simulation(), [])
        config = simulator.start()
    failed = False
    try:
        silence = max(axis.map.inter_frame_s for axis in config.axes)
        with Bus(config.bus, silence) as bus:
            for axis in config.axes:
                drive = Drive(bus, axis)
                try:
                    status = drive.status()
                    alarm, identity = drive.alarm(), drive.identity()
                except BusError as error:
                    failed = True
                    print(f"{axis.name} (unit {axis.unit}): {error}")
                    continue
                words = [
                    name
                    for name in ("enabled", "done", "moving", "fault")
                    if getattr(status, name)
                ]
                print(
                    f"{axis.name} (unit {axis.unit}, {axis.map.title}): status "
                    f"0x{status.word:04X} {' '.join(words)}, position "
                    f"{status.position} pulses = "
                    f"{axis.scale.to_deg(status.position):.4f} deg"
                    + (f", {alarm}" if alarm else "")
                )
                for name, value in identity.items():
                    print(f"    {name} = {value}")
    finally:
        if simulator is not None:
            simulator.close()
    return 3 if failed else 0


def _default_simulation() -> dict[str, Any]:
    return {
        "transport": "tcp", "noise": 0.02, "backlash": 0.0, "drift": 0.0,
        "speedup": 1.0, "rate": 100.0,
    }  # fmt: skip


def _stop(args: argparse.Namespace) -> int:
    from rig.bus import Bus, BusError
    from rig.drives import Drive
    from rig.stop import stop_all

    config = _load(args)
    bus = Bus(config.bus, max(axis.map.inter_frame_s for axis in config.axes))
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
    return 0 if all(r.acknowledged and r.standing for r in results) else 3


def _simulate(args: argparse.Namespace) -> int:
    import time

    config = _load(args)
    if config.imu.transport == "listen" and config.imu.port == 0:
        config = dataclasses.replace(
            config, imu=dataclasses.replace(config.imu, port=2055)
        )
    port = config.bus.port if args.bus_port is None else args.bus_port
    with _simulator(config, _simulation(args), args.fault) as simulator:
        served = simulator.start(port)
        simulator.start_phone(config.imu.port)
        listens = config.imu.transport == "listen"
        print(f"drives: {served.bus.where}; units {[a.unit for a in config.axes]}")
        print(
            f"phone: {config.imu.format}, "
            + ("sends to 127.0.0.1:" if listens else "listens on 127.0.0.1:")
            + str(config.imu.port if listens else served.imu.port)
        )
        print("Ctrl-C ends", flush=True)
        try:
            while True:
                time.sleep(3600)
        except KeyboardInterrupt:
            return 0


def _example(args: argparse.Namespace) -> int:
    from rig.config import EXAMPLES, example_text

    if args.name is None:
        print("\n".join(sorted(path.stem for path in EXAMPLES.glob("*.toml"))))
    else:
        print(example_text(args.name), end="")
    return 0


def _check(args: argparse.Namespace) -> int:
    from rig.config import load_config

    config = load_config(args.config)
    print(f"{args.config}: valid; fingerprint {config.fingerprint()[:16]}")
    for axis in config.axes:
        print(
            f"  {axis.name}: unit {axis.unit}, {axis.map.name}, "
            f"{axis.scale.pulses_per_deg:.3f} pulses a degree, "
            f"{axis.min_pulses}..{axis.max_pulses} pulses"
        )
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    args = make_parser().parse_args(argv)
    if "list" in getattr(args, "fault", []):
        from rig.simulator.faults import KINDS

        for kind, text in KINDS.items():
            print(f"{kind:<16} {text}")
        return 0
    commands = {
        "identify": _identify, "stop": _stop, "simulate": _simulate,
        "example": _example, "check": _check,
    }  # fmt: skip
    try:
        return commands.get(args.command, _session)(args)
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        return 141  # the reader of our output went away, as `| head` does
    except (ValueError, OSError, RuntimeError) as error:
        bad_input = isinstance(error, (ValueError, OSError))
        if type(error).__name__ == "JournalError" and args.command == "resume":
            bad_input = True
        print(f"rig: {error}", file=sys.stderr)
        return 2 if bad_input else 3


if __name__ == "__main__":
    sys.exit(main())
