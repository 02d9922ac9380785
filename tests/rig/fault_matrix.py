"""Every fault at every phase: run, spoil, repair, resume, compare.

``python tests/rig/fault_matrix.py docs/fault_matrix.md`` runs all cells and writes the
published table; the slow test runs the same cells, the quick one a few of them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import pathlib
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np
from commission import turns
from harness import (
    AS_OF_A_DEVICE,
    ENTERED,
    HASTY,
    HOST_FAULTS,
    OTHERS,
    UNSETTLED,
    WATCHED,
    Simulator,
    changed,
    fast_config,
    fast_text,
    free_port,
    in_the_middle,
    prove_stops,
    session,
    simulator,
)

from rig.command_run import Run
from rig.config import RigConfig, parse_config
from rig.core import motion
from rig.drives.bus import Bus
from rig.drives.modbus import ModbusDrive
from rig.faults import Refused
from rig.journal.device import (
    HOMED,
    IDENTIFIED,
    SIGN_CHECKED,
    STOP_PROVED,
    DeviceRecord,
)
from rig.journal.run_folder import read_journal
from rig.prove.steps import Operator, Site, go_home, show_identity
from rig.prove.steps import axes as check_the_axes
from rig_workbench.simulator import Truth, parse_fault

PHASES = ("zeroing", "moving", "settling", "measuring", "saving")
FAULTS = (
    "lost_reply,count=1",
    "lost_reply",
    "lost_write_reply,count=1",
    "lost_request,count=1",
    "delayed_reply,count=1,seconds=0.3",
    "delayed_reply,seconds=0.3",
    "noise_bytes,count=1",
    "noise_bytes",
    "exception_reply,count=1",
    "exception_reply",
    "dead_drive,axis=yaw",
    "alarm,axis=pitch",
    "stuck_axis,axis=roll",
    "slipping_axis,axis=roll",
    "imu_gap,seconds=0.5",
    "imu_gap",
    "imu_disconnect,count=1",
    "imu_garbage,count=20",
    "imu_garbage",
    "imu_nan,count=20",
    "imu_nan",
    "imu_frozen",
    "imu_wrong_order",
    "imu_columns",
    "imu_reorder,count=20",
    "imu_second_sender,count=1",
)
# On another line, with another map or phone: what is injected, the transport, changes
# of the file, and the phases in which it makes a difference.
PUSHING = {'format = "hyperimu"': 'format = "sensorlogger"'}  # over HTTP
PAIRS = {'map = "leadshine_pr"': 'map = "oriental_az"'}  # status and position: 2 and 2
VARIED: dict[str, tuple[str, str, dict[str, str], tuple[str, ...]]] = {
    "spoilt_frames": ("spoilt_frames", "rtu", {}, ("zeroing", "measuring")),
    "late_reply_rtu": ("delayed_reply,count=3,seconds=0.11", "rtu", PAIRS, PHASES),
    "imu_new_heading": ("imu_disconnect,count=1", "tcp", {}, PHASES),
    "imu_400_strangers": ("", "tcp", PUSHING, ("zeroing", "measuring")),
    "drives_halted": ("halted,count=3", "tcp", {}, ("moving",)),
    "drive_halted": ("halted,axis=roll,count=1", "tcp", {}, ("moving",)),
    "sto": ("sto,count=3", "tcp", {}, ("moving",)),
    "other_controller": ("", "tcp", {}, ("moving", "settling", "measuring", "saving")),
}
TURNED_DEG = 25.0  # of the phone's heading, when it comes back
EQUAL = {"imu_new_heading": 1e-3, "imu_400_strangers": 1e-3}  # elsewhere 1e-6
# What is so from the start: reality, which must be ridden out, ...
REAL: dict[str, dict[str, Any]] = {
    "enable_delay": {"enable_delay_s": 0.3, "reset_delay_s": 0.3},
    "jitter": {"jitter_counts": 1},
    "latency": {"latency_s": 0.01},
    "idle_watchdog": {"idle_watchdog": True},
}
# ... and mistakes, which must be refused.
MISTAKES: dict[str, dict[str, Any]] = {
    "reversed_axis": {"reversed": (False, False, True)},
    "swapped_axes": {"swapped": (1, 0, 2)},
    "wrong_gearing": {"drive_pulses_per_rev": (10000, 9000, 10000)},
}
# What happens to a device without power, between a session and the next:
# degrees by which the counters, or the joints, are elsewhere.
OVERNIGHT = {"lost_origin": (1.4, 0.0), "moved_while_off": (0.0, 1.4)}
# What is wrong in the file when the axes are checked, or with the phone: the factor on
# every reduction, and the fault of the phone; or the operator presses Enter, and types
# no word.
ENTER = "enter_for_the_word"
UNPROVED = {
    "reduction_times_10": (10.0, ""),
    "reduction_times_100": (100.0, ""),
    "imu_radians": (1.0, "imu_radians"),
    "imu_radians_reduction_times_25": (25.0, "imu_radians"),
    ENTER: (1.0, ""),
}
# What changed since the axes were checked: found when a session begins.
CHANGED = (
    "regeared,axis=pitch,factor=2",
    "regeared,axis=yaw,factor=3",
    "regeared,axis=roll,factor=5",
    "regeared,axis=roll,factor=0.33",
    "phone_turned",
    "fast_drive,axis=yaw",
    "near_limit",
)
NEAR_DEG, PAST_DEG = 19.4, 1.0  # of limits at 20: from where, and how far past them
CHANGED_DEG = 5.0  # that a joint may be moved before that is found
# How drives do not stop, found when the axes are checked.
UNSTOPPED = ("stop_ignored", "stop_ignored,axis=yaw", "stop_resumes,seconds=0.02")
# Refused before anything moves: what is no proof of this device.
UNKNOWN = ("pushed_while_off", "simulated_calibration")
MOST_DEG = 6.0  # that a joint may be moved before it is found
# In another process, or to this one; not in all phases, as the time differs only.
HOST_PHASES = {
    "sigkill_watched": ("moving", "measuring"),
    "second_session": ("zeroing",),
    "other_stop": ("moving", "measuring"),
    "foreign_stop": ("moving",),
    "suspended_stop": ("moving", "measuring"),
}
DEAF = ("dead_drive", "lost_request", "exception_reply")  # cannot take a stop
MAX_RESUMES = 6
HARNESS = pathlib.Path(__file__).with_name("harness.py")


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What one cell came to."""

    fault: str
    phase: str
    first_code: int
    resumes: int
    reason: str
    worst: float  # largest difference of A and b from the uninterrupted run's
    refused: bool = False  # no calibration came of it

    @property
    def word(self) -> str:
        if self.refused:
            return "refused"
        if self.first_code == 0:
            return "ridden out"
        if self.first_code == 4:
            return "paused"
        return "killed" if self.first_code == -9 else "stopped"


def calibration(folder: pathlib.Path) -> np.ndarray:
    summary = json.loads((folder / "summary.json").read_text())
    return np.column_stack([summary["A"], summary["b"]])


def uninterrupted(folder: pathlib.Path) -> np.ndarray:
    """A and b of a run without faults; fails where that does not end well."""
    config = fast_config()
    said: list[str] = []
    with simulator(config) as sim:
        code = session(sim.start(), folder, sim, said)
    assert code == 0, said
    return calibration(folder)


def check_invariants(folder: pathlib.Path, sim: Simulator, alive: bool, deaf: bool):
    """What must hold after every run, whatever was done to it."""
    records = read_journal(folder / "journal.jsonl")
    names: list[str] = []
    for record in records:
        if record["event"] == "posture":
            names.append(record["name"])
        elif record["event"] == "void":  # withdrawn, to be measured again
            names = [name for name in names if name not in record["names"]]
    assert len(names) == len(set(names)), f"a posture was counted twice: {names}"
    for drive, axis in zip(sim.drives, ("pitch", "yaw", "roll"), strict=True):
        asked = [
            r["pulses"]
            for r in records
            if r["event"] == "command" and r["axis"] == axis
        ]
        ran = drive.executions
        rest = iter(asked)
        missing = [target for target in ran if target not in rest]
        assert not missing, f"{axis} ran moves twice or without a command: {missing}"
    if not alive:
        return
    if deaf:  # the drives cannot say that they were told: the journal does
        assert any(r["event"] == "stop" for r in records), "no stop was sent"
    for drive in sim.drives:
        deadline = time.monotonic() + 2.0
        while drive.moving and time.monotonic() < deadline:
            with sim.server.lock:
                drive.advance()
            time.sleep(0.01)
        assert deaf or (drive.stops and not drive.moving), "a drive was not stopped"


def run_cell(
    fault: str, phase: str, truth: np.ndarray, folder: pathlib.Path
) -> Outcome:
    """Run one cell of the matrix; raises AssertionError where a promise is broken."""
    if fault in HOST_FAULTS or fault in HOST_PHASES:
        return _host_cell(fault, phase, truth, folder)
    if fault in UNKNOWN:
        return _unknown_cell(fault, folder)
    if fault in CHANGED:
        return _changed_cell(fault, folder)
    if phase == "start":
        return _start_cell(fault, truth, folder)
    if phase == "overnight":
        return _overnight_cell(fault, truth, folder)
    if phase == "axes":
        return _axes_cell(fault, folder)
    said: list[str] = []
    injected, transport, changes, _ = VARIED.get(fault, (fault, "tcp", {}, ()))
    spec = parse_fault(injected) if injected else None
    hasty = fast_config(HASTY)
    done: list[str] = []
    # No format has a checksum: the longer a stream is spoilt and waited for, the
    # likelier a changed digit is read that looks right.
    config = fast_config(UNSETTLED if fault == "imu_garbage" else changes)

    with simulator(config, transport=transport) as sim:

        def listen(run: Run, entered: str) -> None:
            if entered == phase and not done and in_the_middle(run, entered):
                done.append(entered)
                if fault in ACTS:
                    ACTS[fault](sim, run, served)
                if spec:
                    sim.faults.add(spec)
                    sim.enter(entered)

        served = sim.start()
        bus = changed(served.bus, timeout_s=hasty.bus.timeout_s)
        imu = changed(served.imu, stale_s=hasty.imu.stale_s)
        spoilt = changed(served, bus=bus, imu=imu)
        code = first = session(spoilt, folder, sim, said, [listen])
        assert done, f"the session never entered {phase}: {code}, {said[-3:]}"
        reason = next((s for s in reversed(said) if s.startswith("fault:")), "")
        deaf = spec is not None and spec.kind in DEAF
        check_invariants(folder, sim, alive=True, deaf=deaf)
        if refused := {"imu_second_sender", "imu_400_strangers"} & {
            fault.partition(",")[0]
        }:
            events = {r["event"] for r in read_journal(folder / "journal.jsonl")}
            assert "sender_refused" in events, f"{refused} was not refused"
        sim.repair()
        resumes = 0
        while code != 0 and resumes < MAX_RESUMES:
            resumes += 1
            code = session(served, folder, sim, said)
            # Refused where a drive was left unread: home it again. Nothing was armed.
            check_invariants(folder, sim, alive=code != 2, deaf=False)
    assert code == 0, said[-12:]
    assert "AssertionError" not in reason, reason
    worst = _equal(folder, truth, EQUAL.get(fault, 1e-6))
    return Outcome(fault, phase, first, resumes, reason, worst)


def _turn_the_heading(sim: Simulator, run: Run, served: RigConfig) -> None:
    heading = sim.plant.truth.heading_deg + TURNED_DEG
    sim.plant.truth = dataclasses.replace(sim.plant.truth, heading_deg=heading)


def _send_strangers(sim: Simulator, run: Run, served: RigConfig) -> None:
    """400 of another address, each with a body of 64 kB, refused unread."""
    port = run.journal.events("listening")[-1]["port"]
    head = b"POST / HTTP/1.1\r\nContent-Length: 1000000\r\n\r\n"
    before = threading.active_count()
    for _ in range(400):
        with socket.socket() as stranger:
            stranger.bind(("127.0.0.5", 0))
            with contextlib.suppress(OSError):  # it is refused while it sends
                stranger.connect(("127.0.0.1", port))
                stranger.sendall(head + b"x" * 65536)
        # A thread of the session itself may begin meanwhile.
        assert threading.active_count() < before + 5, "strangers have threads"


def _move_from_elsewhere(sim: Simulator, run: Run, served: RigConfig) -> None:
    """Another computer on the gateway, with a lock of its own, moves a drive."""
    axis, drive = served.axes[1], sim.drives[1]
    target = round(drive.position / 2)
    with Bus(served.bus) as bus:
        ModbusDrive(bus, axis).go(target)
    drive.executions.remove(target)  # it is in no journal of ours


ACTS: dict[str, Callable[[Simulator, Run, RigConfig], None]] = {
    "imu_new_heading": _turn_the_heading,
    "imu_400_strangers": _send_strangers,
    "other_controller": _move_from_elsewhere,
}


def _equal(folder: pathlib.Path, truth: np.ndarray, most: float = 1e-6) -> float:
    worst = float(np.abs(calibration(folder) - truth).max())
    assert worst < most, f"another calibration: {worst}"
    return worst


def _unknown_cell(fault: str, folder: pathlib.Path) -> Outcome:
    """What is refused with exit code 2 before anything moves."""
    generic = {'map = "leadshine_pr"': 'map = "generic"'}  # without a homed bit
    said: list[str] = []
    folder.mkdir(parents=True)
    with simulator(fast_config(generic)) as sim:
        served = changed(sim.start(), output=str(folder))
        record = DeviceRecord(folder / "device.json")
        operator = Operator(yes=True, say=said.append)
        place = Site(served, record, operator, full_speed=True, listeners=(sim.hear,))
        show_identity(place)
        assert go_home(place, here=True) == 0, said
        record.reach(SIGN_CHECKED, served)
        prove_stops(record, served)
        before = sim.executions()
        if fault == "pushed_while_off":
            for drive, axis in zip(sim.drives, served.axes, strict=True):
                drive.power_cycle(-drive.position / drive.pulses_per_deg)
                drive.offset -= round(10.0 * axis.pulses_per_deg)
            code = session(served, folder / "run", sim, said, record=record)
            reason = said[-1]
        else:
            made = uninterrupted(folder / "made") is not None
            path = folder / "made/calibration.json"
            content = json.loads(path.read_text())
            content["provenance"]["notes"]["simulated"] = made
            path.write_text(json.dumps(content))
            port = {"port = 5020": f"port = {served.bus.port}"}
            (folder / "rig.toml").write_text(fast_text(port))
            done = subprocess.run(
                [sys.executable, "-m", "rig", "goto", str(path), "--to", "0", "0", "0",
                 "--arm", "--zero", "--config", str(folder / "rig.toml")],
                capture_output=True, text=True, check=False,
            )  # fmt: skip
            code, reason = done.returncode, f"refused: {done.stderr.strip()}"
            assert "made with a simulated device" in reason, done
        assert code == 2, (code, said[-12:])
        assert sim.executions() == before, "refused, but something moved"
    return Outcome(fault, "start", code, 0, reason, 0.0, refused=True)


def _start_cell(fault: str, truth: np.ndarray, folder: pathlib.Path) -> Outcome:
    """A device that is so from the start: ridden out, or refused."""
    config = fast_config(WATCHED if fault == "idle_watchdog" else None)
    device = Truth(noise_deg=0.0, **REAL.get(fault, MISTAKES.get(fault)))
    said: list[str] = []
    with simulator(config, truth=device) as sim:
        code = session(sim.start(), folder, sim, said)
        reason = next((s for s in said if s.startswith(("fault:", "refused:"))), "")
        if fault in REAL:
            assert code == 0, said[-12:]
            check_invariants(folder, sim, alive=True, deaf=False)
            return Outcome(fault, "start", code, 0, "", _equal(folder, truth))
        assert code in (2, 3), (code, said[-12:])
        if code == 2:
            assert sim.executions() == [[], [], []], "refused, but something moved"
        else:
            check_invariants(folder, sim, alive=True, deaf=False)
    assert not (folder / "calibration.json").exists()
    return Outcome(fault, "start", code, 0, reason, 0.0, refused=True)


def _changed_cell(fault: str, folder: pathlib.Path) -> Outcome:
    """A session of a device that is not as it was when its axes were checked."""
    said: list[str] = []
    folder.mkdir(parents=True)
    near, more = fault == "near_limit", {}
    if near:  # joints count as they are commanded, one of them close to its limit
        fault, more = "regeared,axis=roll,factor=5", {"truth": Truth(
            matrix=tuple(map(tuple, np.eye(3))), bias=(0.0,) * 3, noise_deg=0.005
        )}  # fmt: skip
    config, too_fast = fast_config(), motion.TOO_FAST
    if fault.startswith("fast_drive"):  # at speeds of a device, and by its limit
        slow = {"speed_deg_s = 400": "speed_deg_s = 20", "_s2 = 8000": "_s2 = 400"}
        config, too_fast, more = fast_config(slow), AS_OF_A_DEVICE[2], {"speedup": 1.0}
    with (
        mock.patch.object(motion, "TOO_FAST", too_fast),
        simulator(config, **{"noise_deg": 0.005, **more}) as sim,
    ):
        if near:
            sim.drives[2].position = sim.config.axes[2].to_pulses(NEAR_DEG)
        served = sim.start()
        record = DeviceRecord(folder / "device.json")
        for state in (IDENTIFIED, HOMED):
            record.reach(state, served)
        record.reach(SIGN_CHECKED, served, turns=turns(sim, served))
        prove_stops(record, served)
        sim.faults.add(parse_fault(fault))
        far, away = _watch_joints(sim)
        code = session(served, folder, sim, said, record=record)
        reason = next((s for s in said if s.startswith("fault:")), "")
        assert code == 3, (code, said[-12:])
        assert far.max() < CHANGED_DEG, f"a joint went {far.max():.1f} deg"
        if near:
            fault, most = "near_limit", 20.0 + PAST_DEG
            assert away.max() < most, f"a joint stood at {away.max():.1f} deg"
        check_invariants(folder, sim, alive=True, deaf=False)
    assert not (folder / "calibration.json").exists()
    return Outcome(fault, "start", code, 0, reason, 0.0, refused=True)


def _watch_joints(sim: Simulator) -> tuple[np.ndarray, np.ndarray]:
    """(3,) degrees that the joints have gone, and how far they stood from zero, kept up
    while the phone looks."""
    start, far, away = sim.plant.joints(), np.zeros(3), np.zeros(3)
    attitude = sim.plant.attitude

    def watched() -> np.ndarray:
        joints = sim.plant.joints()
        far[:] = np.maximum(far, np.abs(joints - start))
        away[:] = np.maximum(away, np.abs(joints))
        return attitude()

    sim.plant.attitude = watched  # type: ignore[method-assign]
    return far, away


def _axes_cell(fault: str, folder: pathlib.Path) -> Outcome:
    """The check of the axes of a device that is not as the file says."""
    factor, kind = UNPROVED.get(fault, (1.0, fault))
    folder.mkdir(parents=True)
    said: list[str] = []
    faults = [parse_fault(kind)] if kind else []
    with simulator(fast_config(), faults=faults, speedup=1.0, noise_deg=0.005) as sim:
        served = sim.start()
        axes = tuple(
            changed(axis, reduction=factor * axis.reduction, speed_deg_s=10.0)
            for axis in served.axes
        )
        wrong = changed(served, axes=axes, output=str(folder))
        record = DeviceRecord(folder / "device.json")
        for state in (IDENTIFIED, HOMED):
            record.reach(state, wrong)
        operator = Operator(yes=fault != ENTER, read=lambda _: "", say=said.append)
        place = Site(wrong, record, operator, listeners=(sim.answer,))
        far, _ = _watch_joints(sim)
        try:
            code = check_the_axes(place)
        except Refused as error:
            code, said = 2, [f"fault: {error}"]
            assert sim.executions() == [[], [], []], "refused, but something moved"
    assert (code == 2) == (fault == ENTER) and code in (1, 2, 3), (code, said[-12:])
    assert far.max() < MOST_DEG, f"a joint went {far.max():.1f} deg"
    proof = STOP_PROVED if fault in UNSTOPPED else SIGN_CHECKED
    assert record.state(proof) is None
    reason = next((s for s in said if s.startswith("fault:")), "")
    found = next((s.strip() for s in said if ".reduction = " in s), "")
    return Outcome(
        fault, "axes", code, 0, reason or f"axes: {found}", 0.0, refused=True
    )


def _overnight_cell(fault: str, truth: np.ndarray, folder: pathlib.Path) -> Outcome:
    """A session that was stopped, a night without power, and a resumption."""
    counters, joints = OVERNIGHT[fault]
    said: list[str] = []
    with simulator(fast_config()) as sim:

        def stop(run: Run, entered: str) -> None:
            if entered == "moving" and in_the_middle(run, entered):
                run.signals.request_stop("in the evening", 143)

        served = sim.start()
        assert session(served, folder, sim, said, [stop]) == 143, said[-12:]
        kept = len(_postures(folder))
        sim.power_cycle((counters,) * 3)
        for axis, drive in zip(served.axes, sim.drives, strict=True):
            drive.offset -= round(joints * axis.pulses_per_deg)
        before = sim.executions()
        code = session(served, folder, sim, said)
        reason = said[-1] if code == 2 else said[-2]
        assert code in (2, 3), (code, said[-12:])
        assert len(_postures(folder)) == kept, "measured with a lost origin"
        assert code == 3 or sim.executions() == before, "refused, but something moved"
        sim.repair()
        resumes = 0
        while code != 0 and resumes < MAX_RESUMES:
            resumes += 1
            code = session(served, folder, sim, said)
        assert code == 0, said[-12:]
        check_invariants(folder, sim, alive=True, deaf=False)
    worst = _equal(folder, truth)
    return Outcome(fault, "overnight", 143, resumes, reason, worst, refused=True)


def _postures(folder: pathlib.Path) -> list[Any]:
    records = read_journal(folder / "journal.jsonl")
    return [record for record in records if record["event"] == "posture"]


FIRST_CODES = {
    "sigint": (4, 130),  # 130: in the last phase, with nothing left to pause, it ends
    "sigint_twice": (130,),
    "sigterm": (143,),
    "sigkill": (-9,),
    "sigkill_watched": (-9,),
    "full_disk": (3,),
    "second_session": (0,),
    "other_stop": (143,),
    "foreign_stop": (3,),
    "suspended_stop": (-9,),
}


def _host_cell(
    fault: str, phase: str, truth: np.ndarray, folder: pathlib.Path
) -> Outcome:
    folder.mkdir(parents=True, exist_ok=True)
    watched = fault == "sigkill_watched"
    given = fast_config(WATCHED if watched else None)
    device = Truth(noise_deg=0.0, idle_watchdog=watched)
    # Slow where a command from another terminal must come in time.
    slow = ("other_stop", "foreign_stop", "suspended_stop")
    speedup = 0.3 if fault == "second_session" else 0.1 if fault in slow else 1.0
    with simulator(given, truth=device, speedup=speedup) as sim:
        served, phone_port = sim.start(), free_port()
        text = fast_text(
            (WATCHED if watched else {})
            | {
                "port = 5020": f"port = {served.bus.port}",
                "port = 2055": f"port = {phone_port}",
            }
        )
        path = folder / "given.toml"
        path.write_text(text)
        sim.start_phone(phone_port)
        with subprocess.Popen(
            [sys.executable, str(HARNESS), str(folder), str(path), fault, phase],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        ) as child:  # fmt: skip
            killed = fault in OTHERS and _elsewhere(fault, folder, path, child)
            said_by_child, errors = child.communicate(timeout=90)
        first = child.returncode
        codes = (-9,) if killed else FIRST_CODES[fault]
        assert first in codes, (first, said_by_child, errors)
        alive = first != -9
        check_invariants(folder, sim, alive=alive, deaf=False)
        if watched:
            time.sleep(1.0)  # longer than their timeout: they have found out
            for drive in sim.drives:
                drive.advance()
                assert drive.alarm and not drive.moving, "a drive did not stop itself"
        config = parse_config(text)
        code, resumes, said = first, 0, []
        while code != 0 and resumes < MAX_RESUMES:
            resumes += 1
            code = session(config, folder, sim, said, answer=False)
            # Killed in its last phase, the run has nothing left to move or to stop.
            over = fault == "sigkill" and phase == "finishing"
            armed = not over and code != 2
            check_invariants(folder, sim, alive=armed, deaf=False)
        assert code == 0, said[-12:]
        if watched:  # what was lent is given back: no alarm when the line falls silent
            time.sleep(1.0)
            for drive in sim.drives:
                drive.advance()
                assert not drive.alarm, "the session ended well, its drive in alarm"
    found = re.findall(r"^(?:fault|stopped|paused): .*", said_by_child, re.M)
    reason = found[-1] if found else ""
    return Outcome(fault, phase, first, resumes, reason, _equal(folder, truth))


def _elsewhere(
    fault: str, folder: pathlib.Path, config: pathlib.Path, child: Any
) -> bool:
    """In another terminal, once the session is in the phase; whether stop said that it
    kills the session, which had no time to stop its drives itself."""
    deadline = time.monotonic() + 60
    while not (folder / ENTERED).exists():
        assert time.monotonic() < deadline, "the session never entered the phase"
        time.sleep(0.02)
    command = {
        "second_session": ["calibrate", "--arm", "--zero", "--out", str(folder / "2")],
        "other_stop": ["stop"],
        "foreign_stop": ["stop"],
        "suspended_stop": ["stop"],
    }[fault]
    if fault == "suspended_stop":
        child.send_signal(signal.SIGSTOP)
    # Another user, or another computer behind the same gateway: no lock is shared.
    foreign = {"JAXCAL_RIG_LOCKS": str(folder / "locks")} if "foreign" in fault else {}
    done = subprocess.run(
        [sys.executable, "-m", "rig", *command, "--config", str(config)],
        capture_output=True, text=True, timeout=60, check=False,
        env=os.environ | foreign,
    )  # fmt: skip
    said = done.stdout + done.stderr
    if fault == "second_session":
        assert done.returncode == 2 and "in use by" in said, (done.returncode, said)
        assert not (folder / "2").exists(), "a second session was begun"
    else:
        assert done.returncode == 0, said
        assert fault != "suspended_stop" or "killing it" in said, said
    return "killing it" in said


def cells() -> list[tuple[str, str]]:
    """Every fault with every phase in which it makes a difference."""
    simulated = [(fault, phase) for fault in FAULTS for phase in PHASES]
    simulated += [(fault, p) for fault, (*_, phases) in VARIED.items() for p in phases]
    host = [(fault, p) for fault in HOST_FAULTS for p in (*PHASES, "finishing")]
    host += [(fault, p) for fault, phases in HOST_PHASES.items() for p in phases]
    started = [(fault, "start") for fault in (*REAL, *MISTAKES)]
    started += [(fault, "start") for fault in UNKNOWN]
    started += [(fault, "start") for fault in CHANGED]
    started += [(fault, "axes") for fault in (*UNPROVED, *UNSTOPPED)]
    return simulated + host + started + [(fault, "overnight") for fault in OVERNIGHT]


def table(outcomes: list[Outcome]) -> str:
    """The published page: faults that ended alike share a row."""
    counts: dict[str, int] = {}
    rows: dict[str, dict[str, list[str]]] = {}  # fault, outcome, phases
    for outcome in outcomes:
        counts[outcome.word] = counts.get(outcome.word, 0) + 1
        said = f"{outcome.word} ({outcome.first_code})"
        ends = rows.setdefault(outcome.fault, {})
        ends.setdefault(said, []).append(outcome.phase)
    alike: dict[str, list[str]] = {}  # outcomes in words, faults
    for fault in dict.fromkeys(fault for fault, _ in cells()):
        ends = rows[fault]
        said = "; ".join(f"{word}: {_named(ends[word])}" for word in sorted(ends))
        alike.setdefault(said, []).append(f"`{fault}`")
    worst = max(outcome.worst for outcome in outcomes)
    counted = ", ".join(f"{count} {word}" for word, count in sorted(counts.items()))
    lines = [
        "# Faults of a rig",
        "",
        f"**{len(outcomes)} of {len(outcomes)} cells hold**: {counted}. A cell is a "
        "fault in one phase of a simulated session. Largest difference of any element "
        f"of A or b from a run without a fault: {worst:.1e} (readings are noise-free).",
        "",
        "`python tests/rig/fault_matrix.py docs/fault_matrix.md` writes this page and "
        "prints what the session said of each fault; the slow test "
        "`tests/rig/test_rig_faults.py` runs the same cells.",
        "",
        "A fault begins when the session enters the phase, after two recorded "
        "postures, and lasts until the session ends, unless it has a count. It is then "
        "repaired and the session resumed. A cell holds when the drives were told to "
        "stop and stand, every line of the journal reads, no move ran twice or without "
        "a line of the journal, no posture is recorded twice or missing, and the "
        "calibration is that of a run without a fault.",
        "",
        "- *Ridden out*: the first session reached the calibration by itself.",
        "- *Refused*: no calibration is saved; with exit code 2 nothing moved.",
        "- *start*: the device is so from the start. A joint whose gearing, phone or "
        f"speed changed since `axes` goes less than {CHANGED_DEG:g} degrees, and passes"
        f" its soft limit by {PAST_DEG:g} degree at most (`near_limit`).",
        "- *axes*: the check of the axes finds it, and no joint goes "
        f"{MOST_DEG:g} degrees.",
        "- *overnight*: the drives lost power, or the joints were moved, between a "
        "stopped session and its resumption; nothing is measured until the origin is "
        "found again.",
        "",
        "| outcome (exit code of the first session): phases | faults |",
        "|---|---|",
        *(f"| {said} | {', '.join(faults)} |" for said, faults in alike.items()),
        "",
        "Names that need a word: `other_stop`, `second_session`: a command in another "
        "terminal; `foreign_stop`: `stop` by another user or computer; "
        "`other_controller`: another computer on the gateway moves a drive; "
        "`drives_halted`: it stops them, and they say that they are done; `sto`: their "
        "power is off for a second; `stop_ignored`, `stop_resumes`: they acknowledge a "
        "stop and go on; `sigkill_watched`: they watch the line, and must stop by "
        "themselves; `pushed_while_off`: moved by 10 degrees without power; "
        f"`imu_new_heading`: the phone comes back turned by {TURNED_DEG:g} degrees; "
        "`imu_400_strangers`: 400 other senders at its port.",
    ]
    return "\n".join(lines) + "\n"


def _named(phases: list[str]) -> str:
    whole = "every phase"
    if set(PHASES) <= set(phases):
        phases = [whole, *(each for each in phases if each not in PHASES)]
    return ", ".join(phases)


def main(target: str, store: str = "", *only: str) -> int:
    """Run the cells, and write the page where all of them hold.

    With ``store``, outcomes are kept in that file of JSON lines, and those it holds are
    not run again: a run that was cut off goes on.
    """
    begun, broken = time.monotonic(), 0
    kept = pathlib.Path(store or "/dev/null")
    lines = kept.read_text().splitlines() if kept.is_file() else []
    outcomes = [Outcome(**json.loads(line)) for line in lines]
    known = {(o.fault, o.phase) for o in outcomes}
    with tempfile.TemporaryDirectory() as scratch, kept.open("a") as file:
        base = pathlib.Path(scratch)
        truth = uninterrupted(base / "uninterrupted")
        left = [c for c in cells() if c not in known]
        left = [c for c in left if not only or c[0].partition(",")[0] in only]
        for number, (fault, phase) in enumerate(left):
            try:
                outcome = run_cell(fault, phase, truth, base / f"cell{number}")
            except AssertionError as error:
                broken += 1
                print(f"BROKEN {fault} @ {phase}: {error}", flush=True)
                continue
            outcomes.append(outcome)
            print(json.dumps(dataclasses.asdict(outcome)), file=file, flush=True)
            print(
                f"{number + 1}/{len(left)} {fault} @ {phase}: {outcome.word} "
                f"({outcome.first_code}), {outcome.resumes} resumes; {outcome.reason}",
                flush=True,
            )
    print(f"{len(outcomes)} hold, {broken} broken, {time.monotonic() - begun:.0f} s")
    if not broken and len(outcomes) == len(cells()) and target != "-":
        pathlib.Path(target).write_text(table(outcomes))
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
