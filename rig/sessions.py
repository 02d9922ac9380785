"""calibrate, collect, verify, goto and resume: from arguments to an exit code."""

from __future__ import annotations

import argparse
import contextlib
import functools
import pathlib
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rig.arguments import SIMULATOR
from rig.config import (
    ConfigError,
    RigConfig,
    example_text,
    load_config,
    parse_config,
)
from rig.core.faults import Refused

if TYPE_CHECKING:
    from rig.core.zero import KeptZero
    from rig.simulator import Simulator
    from rig.workbench.run import Run

FILE = pathlib.Path("rig.toml")  # without --config
SIMULATION = [
    option.strip("-").replace("-", "_")
    for option in SIMULATOR
    if option not in ("--simulate", "--fault")  # what the simulated device is
]


def load(args: argparse.Namespace) -> RigConfig:
    """The configuration a command was given, the simulator's own, or rig.toml here."""
    if args.config is None:
        if getattr(args, "simulate", False) or args.command == "simulate":
            return parse_config(example_text("simulate"))
        if not FILE.exists():
            lack = "there is no rig.toml here: --config FILE is required, or --simulate"
            raise ConfigError("configuration", [lack])
        args.config = FILE
    return load_config(args.config)


def make_simulator(
    config: RigConfig, options: dict[str, Any], faults: list[str]
) -> Simulator:
    """A simulated rig as the options of the command line describe it."""
    from rig.simulator import Simulator, parse_fault, truth_of

    truth = truth_of(options, config.session.seed)
    return Simulator(
        config,
        truth,
        [parse_fault(text) for text in faults],
        transport=options["transport"],
        rate_hz=options["rate"],
        speedup=options["speedup"],
    )


def session(args: argparse.Namespace) -> int:
    """Run a new session; returns the exit code."""
    if getattr(args, "count", 1) < 1:
        raise Refused(f"--count must be at least 1, got {args.count}")
    calibration = getattr(args, "calibration", None)
    simulation = {name: getattr(args, name) for name in SIMULATION}
    start = {
        "mode": args.command,
        "inputs": {
            "count": getattr(args, "count", None),
            "to": getattr(args, "to", None),
            "calibration": None if calibration is None else str(calibration.resolve()),
        },
        "simulated": simulation if args.simulate else None,
        "maps_from": str((args.config or pathlib.Path()).resolve().parent),
    }
    return _run(args, load(args), start)


def resume(args: argparse.Namespace) -> int:
    """Go on with a run; returns the exit code."""
    config, start = recorded(args)
    if args.simulate and start["simulated"] is None:
        raise Refused(
            f"{args.run} was made with a real device, and going on moves that. Leave "
            "out --simulate, or begin a simulated run of its own"
        )
    return _run(args, config, start, folder=args.run)


def _run(
    args: argparse.Namespace,
    config: RigConfig,
    start: dict[str, Any],
    folder: pathlib.Path | None = None,
) -> int:
    from rig.journal import SIGN_CHECKED, DeviceRecord, new_run_folder
    from rig.journal.lock import BusLock
    from rig.signals import Signals
    from rig.workbench.commission.steps import begin_simulated, simulated
    from rig.workbench.outputs.console import listen
    from rig.workbench.run import Run, run_safely

    mode, say = start["mode"], functools.partial(print, flush=True)
    real = start["simulated"] is None
    procedure, kept_zero = _procedure(mode, start["inputs"], config, not real)
    # With --zero the operator put the device into its zero posture.
    zero_at = kept_zero.pulses if kept_zero and not args.zero else None
    dry_run = getattr(args, "dry_run", False)
    with contextlib.ExitStack() as stack:
        simulator, text = None, config.text
        if start["simulated"] is not None:
            simulator = make_simulator(config, start["simulated"], args.fault)
            config = stack.enter_context(simulator).start()
        lock = BusLock(config.bus)
        if not dry_run:
            stack.enter_context(lock.acquire(args.command))
        record = DeviceRecord.load(config.device_path)
        if simulator is None and not dry_run and (lack := record.missing(config)):
            raise Refused(lack)
        if folder is None:
            folder = new_run_folder(args.out or pathlib.Path(config.output), mode)
            (folder / "rig.toml").write_text(text, encoding="utf-8")
        lock.tell(run=str(folder.resolve()))
        if simulator is not None:
            record = DeviceRecord(folder / "device.json")
            if not dry_run:
                place = simulated(simulator, config, record, say)
                place.folder, place.locked = folder / "axes", True
                place.folder.mkdir(exist_ok=True)
                # Faults wait for the session's own phases.
                place.listeners = (simulator.answer,)
                begin_simulated(place, SIGN_CHECKED)
        run = Run(
            config,
            folder,
            mode,
            say,
            start={key: start[key] for key in ("simulated", "inputs", "maps_from")},
            reset_alarms=args.reset_alarms,
            record=record,
            zero_at=zero_at,
            kept_zero=kept_zero,
            dry_run=dry_run,
            signals=Signals(),
        )
        listen(run)
        if simulator is None:
            run.confirm = functools.partial(_confirm, args)
        else:
            run.listeners.append(simulator.hear)
        if args.live:
            from rig.workbench import live

            run.say(live.start(folder))
        return run_safely(run, procedure)


def journal_of(run: pathlib.Path) -> pathlib.Path:
    """The journal in a run's folder; Refused where there is none."""
    from rig.journal import JOURNAL

    if not (run / JOURNAL).is_file():
        raise Refused(f"{run} holds no run: there is no {JOURNAL} in it")
    return run / JOURNAL


def records_of(run: pathlib.Path) -> list[dict[str, Any]]:
    """The journal of a run; Refused where its folder holds none, or a damaged one."""
    from rig.journal import JournalError, read_journal

    try:
        records = read_journal(journal_of(run))
    except JournalError as error:
        raise Refused(str(error)) from None
    if not records or records[0]["event"] != "start":
        raise Refused(f"{run} holds no run: its journal has no start")
    if "device" not in records[0]:
        raise Refused(
            f"{run} was written before jaxcal 0.1.0, whose runs are not read any more. "
            "Make a new one"
        )
    return records


def recorded(args: argparse.Namespace) -> tuple[RigConfig, dict[str, Any]]:
    """The same of a run that is resumed or identified anew, from its folder."""
    start = records_of(args.run)[0]
    if start["mode"] == "refit":
        source = start["inputs"]["run"]
        raise Refused(f"{args.run} is a refit of {source}; give that run instead")
    if start["mode"] not in ("calibrate", "collect", "verify", "goto"):
        raise Refused(f"{args.run} is a step of commissioning: run it again instead")
    if getattr(args, "config", None) is not None:
        return load_config(args.config), start
    text = (args.run / "rig.toml").read_text(encoding="utf-8")
    return parse_config(text, pathlib.Path(start["maps_from"]), str(args.run)), start


def _procedure(
    mode: str, inputs: dict[str, Any], config: RigConfig, simulated: bool
) -> tuple[Callable[[Run], int], KeptZero | None]:
    """What a session does, and the zero posture that it must find."""
    import numpy as np

    from rig.workbench.procedures import calibrate, checking

    if mode == "calibrate":
        return calibrate.calibrate, None
    count = inputs["count"]
    if mode == "collect":
        return lambda run: checking.collect(run, count), None
    saved = checking.load_calibration(
        pathlib.Path(inputs["calibration"]), config, simulated
    )
    calibration = saved.calibration
    if mode == "verify":
        return lambda run: checking.verify(run, calibration, count), saved.zero
    desired = np.array(inputs["to"], dtype=np.float64)
    play = saved.play
    return lambda run: checking.goto(run, calibration, desired, play), saved.zero


def _confirm(args: argparse.Namespace, session: Run) -> None:
    """Ask for what --arm and --zero would have confirmed."""
    takes_zero = not session.journal.events("zero") and session.zero_at is None
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
