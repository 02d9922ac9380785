"""``python -m rig``: the command line. Heavy imports wait for their command."""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rig.session import Run
    from rig.settings import RigConfig
    from rig.simulator import Simulator

EPILOG = """\
exit codes: 0 done; 1 done, but the error says calibrate (again); 2 bad input, nothing
moved; 3 stopped by a fault; 4 paused by Ctrl-C; 128 + signal stopped by a signal.
After 3, 4 and signals `resume RUN` goes on.

Research software, not a medical device. Calibrate with no patient attached; a hardware
emergency stop is required.
"""


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m rig",
        description="Calibrate a three-axis device over Modbus and a phone's IMU.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, text: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=text, description=text)

    for name, text in (
        ("calibrate", "choose, visit, identify, verify and save"),
        ("collect", "record random postures (Datasets 4 and 5)"),
        ("verify", "compare a saved calibration with fresh measurements"),
        ("goto", "move the end-effector to a posture through a calibration"),
    ):
        sub = add(name, text)
        if name in ("verify", "goto"):
            sub.add_argument(
                "calibration", type=pathlib.Path, help="file, or run folder"
            )
        if name == "goto":
            sub.add_argument(
                "--to", type=float, nargs=3, required=True,
                metavar=("PITCH", "YAW", "ROLL"), help="desired posture in degrees",
            )  # fmt: skip
        if name in ("collect", "verify"):
            sub.add_argument(
                "--count", type=int, default=50 if name == "collect" else 6
            )
        _config_options(sub)
        sub.add_argument("--out", type=pathlib.Path, help="folder for the run's folder")
        sub.add_argument("--dry-run", action="store_true", help="plan; open no port")
        _motion_options(sub)
        sub.add_argument(
            "--zero", action="store_true",
            help="confirm that the device stands in its zero posture",
        )  # fmt: skip
        _simulator_options(sub)
    resume = add("resume", "go on with a run that was paused, stopped or killed")
    resume.add_argument("run", type=pathlib.Path, help="the run's folder")
    resume.add_argument("--config", type=pathlib.Path, help="for a changed port")
    _motion_options(resume)
    resume.add_argument("--zero", action="store_true", help=argparse.SUPPRESS)
    _simulator_options(resume)
    identify = add("identify", "ask every drive who and how it is; only reads")
    _config_options(identify)
    identify.add_argument("--simulate", action="store_true")
    stop = add("stop", "quick-stop every drive now, and verify")
    _config_options(stop)
    check = add("check", "check a configuration and list every fault")
    check.add_argument("config", type=pathlib.Path)
    example = add("example", "print a commented example configuration")
    example.add_argument("name", nargs="?", help="none: list them")
    simulate = add("simulate", "serve simulated drives and a phone on loopback")
    _config_options(simulate)
    simulate.add_argument("--bus-port", type=int, default=None, help="0: any free one")
    _simulator_options(simulate)
    return parser


def _config_options(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--config", type=pathlib.Path, help="rig.toml")


def _motion_options(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("--arm", action="store_true", help="let the device move, unasked")
    sub.add_argument("--reset-alarms", action="store_true", help="before arming")


def _simulator_options(sub: argparse.ArgumentParser) -> None:
    group = sub.add_argument_group("simulator")
    group.add_argument(
        "--simulate", action="store_true", help="against a simulated rig"
    )
    group.add_argument(
        "--transport", choices=("tcp", "rtu_tcp", "rtu"), default="tcp",
        help="of the simulated bus; rtu is a pseudo-terminal",
    )  # fmt: skip
    group.add_argument(
        "--fault", action="append", default=[], metavar="KIND[@PHASE|@Ns][,count=N]...",
        help="inject a fault; --fault list names them",
    )  # fmt: skip
    group.add_argument("--noise", type=float, default=0.02, help="degrees")
    group.add_argument("--backlash", type=float, default=0.0, help="degrees")
    group.add_argument("--drift", type=float, default=0.0, help="degrees a minute")
    group.add_argument("--speedup", type=float, default=1.0, help="of the axes")
    group.add_argument("--rate", type=float, default=100.0, help="of the phone, Hz")


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
    from rig.session import Refused

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


def _session(args: argparse.Namespace) -> int:
    from rig import session
    from rig.config import load_config, parse_config
    from rig.journal import read_journal

    resumed = args.command == "resume"
    faults: list[str] = list(args.fault)
    if resumed:
        folder = args.run
        records = read_journal(folder / session.JOURNAL)
        if not records or records[0]["event"] != "start":
            raise session.Refused(f"{folder} holds no run")
        start = records[0]
        mode, inputs, simulation = start["mode"], start["inputs"], start["simulated"]
        if args.config is not None:
            config = load_config(args.config)
        else:
            text = (folder / "rig.toml").read_text(encoding="utf-8")
            config = parse_config(text, pathlib.Path(start["maps_from"]), str(folder))
    else:
        config = _load(args)
        mode = args.command
        if getattr(args, "count", 1) < 1:
            raise session.Refused(f"--count must be at least 1, got {args.count}")
        inputs = {
            "count": getattr(args, "count", None),
            "to": getattr(args, "to", None),
            "calibration": str(args.calibration.resolve())
            if mode in ("verify", "goto")
            else None,
        }
        simulation = _simulation(args) if args.simulate else None
        folder = None
    calibration, zero_at = None, None
    if mode in ("verify", "goto"):
        from rig.other_sessions import load_calibration

        calibration, zero_at = load_calibration(
            pathlib.Path(inputs["calibration"]), config
        )
        if getattr(args, "zero", False):
            zero_at = None  # the operator put the device into its zero posture
    if folder is None:
        folder = session.new_run_folder(args.out or config.output, mode)
        (folder / "rig.toml").write_text(config.text, encoding="utf-8")
    maps_from = str((args.config or pathlib.Path()).resolve().parent)
    simulator = None
    if simulation is not None:
        simulator = _simulator(config, simulation, faults)
        config = simulator.start()
    try:
        run = session.Run(
            config,
            folder,
            mode,
            _say,
            start={"simulated": simulation, "inputs": inputs, "maps_from": maps_from},
            reset_alarms=args.reset_alarms,
            on_imu_port=simulator.start_phone if simulator else None,
            zero_at=zero_at,
        )
        if simulator is not None:
            run.phase_listeners.append(simulator.enter)
        run.confirm = _confirm(args, simulated=simulator is not None)
        dry = getattr(args, "dry_run", False)
        return session.run_safely(run, _procedure(mode, inputs, calibration, dry))
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
    from rig.drives import Bus, BusError, Drive

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
    from rig.drives import Bus, BusError, Drive
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
    args = _parser().parse_args(argv)
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
