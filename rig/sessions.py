"""A session as a command asks for it: new or resumed, real or simulated."""

from __future__ import annotations

import contextlib
import functools
import pathlib
from collections.abc import Callable
from typing import Any

from rig import pages
from rig.command_run import Run, listen, run_safely
from rig.config import RigConfig, load_config, parse_config
from rig.core.record_check import ZeroRecord
from rig.faults import JournalError, Refused
from rig.journal.device import STOP_PROVED, DeviceRecord
from rig.journal.lock import BusLock
from rig.journal.run_folder import JOURNAL, SCHEMA, Record, new_run_folder, read_journal
from rig.options import Session
from rig.procedures import calibrate, verify
from rig.prove import steps

say = functools.partial(print, flush=True)


def run_session(
    options: Session,
    command: str,
    config: RigConfig,
    start: dict[str, Any],
    folder: pathlib.Path | None = None,
) -> int:
    """Run a session under the lock of its bus, which says ``command``; its exit code.
    ``start`` is as the journal's first record; ``folder`` that of a resumed run."""
    real = start["simulated"] is None
    procedure, kept_zero, doubts = _procedure(start, config)
    with contextlib.ExitStack() as stack:
        simulator, text = None, config.text
        if not real:
            simulator = options.simulator(config, start["simulated"])
            config = stack.enter_context(simulator).start()
        lock, record = BusLock(config.bus), DeviceRecord.load(config.device_path)
        stack.enter_context(lock.acquire(command))
        if real and (lack := record.missing(config)):
            raise Refused(lack)
        if folder is None:
            folder = new_run_folder(
                options.out or pathlib.Path(config.output), start["mode"]
            )
            (folder / "rig.toml").write_text(text, encoding="utf-8")
        if simulator is not None:
            record = steps.commissioned(folder / "device.json", config, STOP_PROVED)
        lock.tell(run=str(folder.resolve()))
        run = Run(
            config,
            folder,
            start["mode"],
            say,
            start={key: start[key] for key in ("simulated", "inputs", "maps_from")},
            reset_alarms=options.reset_alarms,
            record=record,
        )
        run.kept_zero = kept_zero
        if kept_zero and not options.zero:  # else the operator put the device there
            run.zero_at = kept_zero.pulses
        listen(run)
        run.confirm = functools.partial(_confirm, options, doubts)
        if simulator is not None:
            run.simulated = True
            run.listeners.append(simulator.hear)
        if options.live:
            run.say(pages.start(folder))
        return run_safely(run, procedure)


def _procedure(
    start: dict[str, Any], config: RigConfig
) -> tuple[Callable[[Run], int], ZeroRecord | None, list[str]]:
    """What a session does, the zero it must find, and doubts of its calibration."""
    mode, inputs = start["mode"], start["inputs"]
    if mode == "calibrate":
        return calibrate.calibrate, None, []
    if mode == "collect":
        return lambda run: calibrate.collect(run, inputs["count"]), None, []
    if mode == "goto" and config.is_arm:
        raise Refused(
            "goto does not move an arm; its own controller does. Give it "
            "calibrated.urdf of the calibration's folder instead of the URDF"
        )
    calibration, kept = verify.load_calibration(
        pathlib.Path(inputs["calibration"]), config, start["simulated"] is not None
    )
    if mode == "verify":
        return lambda run: verify.verify(run, calibration, inputs["count"]), kept, []
    verdict = calibration.provenance.get("notes", {}).get("verdict", {})  # from 0.3 on
    doubts = list(verdict.get("reasons", ()))
    return lambda run: verify.goto(run, calibration, inputs["to"]), kept, doubts


def _confirm(options: Session, doubts: list[str], session: Run) -> None:
    """Ask for what --arm, --zero and --use would have confirmed."""
    takes_zero = not session.journal.events("zero") and session.zero_at is None
    takes_zero &= session.config.session.zero == "here" and not session.simulated
    why = "the session that made this calibration advised against using it: "
    clear = "the device will move; its path is clear, no patient is attached, the "
    for needed, word, text in (
        (bool(doubts), "use", why + " and ".join(doubts)),
        (not session.simulated, "arm", clear + "emergency stop is at hand"),
        (takes_zero, "zero", "the device is in its zero posture"),
    ):
        if needed and not getattr(options, word):
            steps.Operator(say=say, option=f"--{word}").confirm(text, word)


def recorded(
    run: pathlib.Path, config: pathlib.Path | None = None
) -> tuple[RigConfig, Record]:
    """Configuration and start of a run that is resumed or identified anew."""
    start = records_of(run)[0]
    if start["mode"] == "refit":
        source = start["inputs"]["run"]
        raise Refused(f"{run} is a refit of {source}; pass that run instead")
    if start["mode"] not in ("calibrate", "collect", "verify", "goto"):
        raise Refused(f"{run} is a step of commissioning: run it again instead")
    if config is not None:
        return load_config(config), start
    text = (run / "rig.toml").read_text(encoding="utf-8")
    return parse_config(text, pathlib.Path(start["maps_from"]), str(run)), start


def records_of(run: pathlib.Path) -> list[Record]:
    """The journal of a run; Refused where its folder holds none, or a damaged one."""
    if not (run / JOURNAL).is_file():
        raise Refused(f"{run} is not a run's folder: it has no {JOURNAL}")
    try:
        records = read_journal(run / JOURNAL)
    except JournalError as error:
        raise Refused(str(error)) from None
    if not records or records[0]["event"] != "start":
        raise Refused(f"{run} is not a run's folder: its journal has no start")
    if records[0].get("schema") != SCHEMA:
        raise Refused(
            f"{run} was written by an earlier version of jaxcal, which is no longer "
            "supported. Make a new run"
        )
    return records
