"""A session: arm, take the zero, visit, identify; stopped on every way out.

    with open_device(run) as device:
        take_zero(device)
        found = [visit(device, posture) for posture in plan]
    calibration = identify(found)

All that happens is an event of the run: it is journalled, and console, page, telemetry
and simulator listen. What the journal holds already is not measured again, so resuming
is running the same again.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from rig.config import RigConfig
from rig.config.axis import Pulses
from rig.core import record_check
from rig.core.device import Device, Lines, Posture, check_plan
from rig.core.joints import show
from rig.core.line_client import line_of
from rig.core.measure import measure, zeroed
from rig.core.motion import Arrival, move
from rig.drives import Drive
from rig.faults import (
    EndedShort,
    MotionFault,
    NotFollowing,
    Requests,
    Unreachable,
    ending,
)
from rig.journal.device import ZEROED, DeviceRecord
from rig.journal.lock import BusLock
from rig.journal.run_folder import Record, RunFolder
from rig.readings.attitude import Array, angle_between_deg
from rig.readings.geometry import Attitudes
from rig.readings.source import ReadingError

STREAM_WAIT_S = 60.0  # time to start the app on the phone
LEAST_TURN_DEG = 0.05  # of the phone's heading: less is its noise
ZERO_FACTOR = 4  # readings of the zero posture, in those of a posture
SAME_PLACE_DEG = 0.5  # two places where an axis ended short of one target
Check = Callable[[RigConfig, Sequence[Drive], DeviceRecord], None]


class SessionRun(RunFolder):
    """The folder of a run, and what its session is opened with."""

    record: DeviceRecord  # of what was proved of the device
    signals: Requests  # to pause or to stop, from outside
    reset_alarms: bool  # of drives that are in alarm
    # (m,) that is measured at (n,) commands, by its model as designed.
    predict: Callable[[Array], Array] | None
    # What runs while the ports are open, such as telemetry.
    beside: list[Callable[[Device], contextlib.AbstractContextManager[None]]]
    # What must hold of the drives before they are armed; Refused.
    check: Check = staticmethod(record_check.check_drives)
    lines: Lines = staticmethod(line_of)  # who makes its line and drives
    simulated = False  # nothing real moves: it need not be slow


@contextlib.contextmanager
def open_device(run: SessionRun) -> Iterator[Device]:
    """The device of a run, armed; however this ends its drives are stopped and looked
    at.

    Raises:
        MotionFault, BusError, ReadingError, Refused: not fit to move.
    """
    config, record, requests = run.config, run.record, run.signals
    device = Device(
        config, run, record, requests,
        simulated=run.simulated, lines=run.lines, predict=run.predict,
    )  # fmt: skip
    lock = BusLock(config.bus)
    # A request that came while something was computed may have been raised in a
    # callback that drops exceptions, as those of a garbage collection are.
    requests.check_stop()
    with contextlib.ExitStack() as stack:
        stack.callback(_close, device)
        reason, latch = "", False
        try:
            device.imu.open()
            kind = "numbers" if config.imu is None else config.imu.format
            device.emit("listening", port=device.imu.port, format=kind)
            device.line.open()
            run.check(config, device.drives, record)
            for other in run.beside:
                stack.enter_context(other(device))
            device.imu.wait_for_stream(STREAM_WAIT_S)
            lock.leave(config)
            requests.armed = True
            device.arm(run.reset_alarms)
            # Where they stand is not known until they do again.
            homed = [d.axis.name for d in device.drives if d.says_homed]
            record.left_at(dict.fromkeys(config.axis_names), homed)
            device.emit("armed", drives=len(device.drives), where=config.bus.where)
            yield device
        except BaseException as error:
            requests.ending = True
            _, event, reason = ending(error, run.folder)
            latch = event != "paused"
            raise
        finally:
            if requests.armed:
                results = device.stopper.stop(reason, latch)
                if all(result.standing for result in results):  # `stop` waits for it
                    gone = run.journal.records[0].get("simulated") is not None
                    lock.stood(forget=gone)
                if reason and not all(r.standing for r in device.stopper.stay()):
                    lock.leave(config)
                if reason and device.last_move:
                    device.emit("last_move", **_last_move(device))


def _last_move(device: Device) -> Record:
    """What moved last, from where to where, and where drives and phone are now."""
    assert device.last_move is not None
    config, (label, start, end) = device.config, device.last_move
    stands = [result.position for result in device.stopper.results]
    phone = None
    with contextlib.suppress(ReadingError):
        if device.oriented and device.frame:
            phone = device.frame.angles(device.imu.latest().value).round(3).tolist()
    return {
        "label": label,
        "axes": list(config.axis_names),
        "units": [axis.unit_name for axis in config.axes],
        "outputs": list(config.output_names),
        "from_deg": config.to_deg(start).round(3).tolist(),
        "to_deg": config.to_deg(end).round(3).tolist(),
        "drives_deg": [
            None if at is None else round(axis.to_deg(at), 3)
            for axis, at in zip(config.axes, stands, strict=True)
        ],
        "phone_deg": phone,
    }


def _close(device: Device) -> None:
    """Nothing more will move: note where the drives stand, close bus and phone."""
    if device.requests.armed:
        try:
            record_check.leave(device.drives, device.record)
        except OSError as error:
            text = f"{device.record.path} cannot be written: {error}"
            device.emit("note", text=text)
    device.close()
    device.requests.armed = False


# The zero posture


def take_zero(
    device: Device,
    at: Pulses | None = None,
    kept: record_check.ZeroRecord | None = None,
) -> None:
    """Measure the zero posture, that all others are measured against.

    Where postures were measured already, as in a run that is resumed, it must still
    read zero.

    Args:
        device: armed.
        at: pulses of the zero; where it stands when not given, or 0 as configured.
        kept: what a calibration keeps of it, to be found again; else MotionFault.
    """
    config, run = device.config, device.run
    if zeros := run.journal.events("zero"):
        before = Posture("reference", tuple(zeros[-1]["pulses"]))
        if run.postures():
            show(device)
            attitude = np.array(zeros[-1]["attitude"])
            zeroed(device, device.geometry.frame(attitude), before)
            return _check_reference(device, before)
        at = at or before.pulses
    elif at is None and config.session.zero == "drive":
        at = (0,) * len(config.axes)
    moves = at is not None or config.motion.approach_overshoot_deg > 0
    if moves:  # or the zero is measured first, where the device was put
        show(device)
    device.emit("phase", phase="zeroing")
    zero = Posture("zero", at or device.positions())
    standing = Arrival(device, zero)
    if moves:
        standing = move(device, zero)  # from the side of all references
    else:
        device.rest = zero.pulses  # nothing else is to move it from here
    check_plan(config, [zero.pulses])  # it is where a resumed run looks again
    while True:
        connection = device.imu.connections
        # Every posture is measured against this one: its noise must be the smaller.
        zero_record = measure(standing, ZERO_FACTOR * config.settle.samples)
        if device.imu.connections == connection:
            break
    attitude = np.array(zero_record["attitude"])
    _compare_zero(device, zero.pulses, attitude, kept)
    device.emit("zero", sync=True, **zero_record)
    zeroed(device, device.geometry.frame(attitude), zero)
    show(device)
    zeroed(device, device.geometry.frame(attitude), zero)


def _compare_zero(
    device: Device,
    pulses: Pulses,
    attitude: Array,
    kept: record_check.ZeroRecord | None,
) -> None:
    """With the calibration's zero posture, or else with the last one taken."""
    config, last = device.config, device.record.state(ZEROED)
    if kept is not None:
        device.emit("note", text=kept.check(config, pulses, attitude))
    elif last:
        then = np.array(last["attitude"])
        try:
            record_check.ZeroRecord("the last session", last["pulses"], then).check(
                config, pulses, attitude
            )
        except MotionFault as fault:  # a phone mounted anew is calibrated anew
            device.emit("note", text=f"WARNING: {fault}")
    evidence = {"pulses": list(pulses), "attitude": attitude.tolist()}
    device.record.reach(ZEROED, config, **evidence)


def _check_reference(device: Device, zero: Posture) -> None:
    """Before a resumed run goes on: the zero posture must still read zero."""
    angles = measure(move(device, zero))["measured_deg"]
    limit = device.config.session.reference_tolerance_deg
    unit = device.config.output_unit
    device.emit("reference", sync=True, angles=angles, limit=limit, unit=unit)
    if max(map(abs, angles)) > limit:
        config = device.config
        moved = record_check.axes_text(config.output_names, config.output_unit, angles)
        raise MotionFault(
            "the zero posture of this run has moved: "
            f"{moved} (limit {limit:g}): the "
            f"drives lost their origin, or {device.imu.whose} or the device was moved. "
            "Start a "
            "new run"
        )


def _reorient(device: Device) -> None:
    """Read the zero again where the phone came back on a new connection.

    Its world may have turned about the vertical since; later readings are turned back,
    so that one frame holds for the whole run.

    Raises:
        MotionFault: the zero posture is elsewhere in another way than that.
    """
    config, frame, zero = device.config, device.frame, device.zero
    while not device.oriented:
        assert frame is not None and zero is not None
        count = device.imu.connections
        device.emit("imu_reconnected", sync=True, connection=count)
        device.frame = None  # no comparison with the drives before it is known
        measured = measure(move(device, Posture("reference", zero.pulses)))
        if device.imu.connections != count:
            continue
        now = np.array(measured["attitude"])
        told = record_check.check_zero(config, frame.zero, now, "this run")
        assert isinstance(device.geometry, Attitudes)  # numbers stay as they are
        turn = device.geometry.heading_turn(frame.zero, now)
        if (turned := angle_between_deg(np.eye(3), turn)) > LEAST_TURN_DEG:
            device.imu.turn(turn)
        zeroed(device, frame, zero)
        device.emit(
            "reoriented", sync=True, turned_deg=round(turned, 4), told=told,
            world=device.imu.world.tolist(),
        )  # fmt: skip


# Postures


def visit(device: Device, posture: Posture, **fields: Any) -> Record | None:
    """Move, measure and record, once in the life of a run; None where out of reach.

    The record has the posture's name, and ``fields`` besides what is measured.
    """
    run, name = device.run, posture.name
    if name in (measured := run.postures()):
        return measured[name]
    if any(record["name"] == name for record in run.journal.events("unreachable")):
        _check_lost(device)
        return None
    device.requests.check_pause()
    device.emit("visit", name=name, pulses=list(posture.pulses))
    measurement = None
    try:
        while (
            measurement is None or not device.oriented
        ):  # the phone came back in between
            _reorient(device)
            measurement = measure(move(device, posture))
    except NotFollowing:
        _withdraw(run)
        raise
    except EndedShort as fault:
        ended = {"name": name, "axis": fault.axis, "pulses": fault.pulses}
        twice = _ended_there(device, ended)
        device.emit("ended_short", sync=True, **ended)
        if not twice:  # going on is typed
            raise
        _leave_out(device, name, f"{fault}. It ended there before")
        return None
    except Unreachable as reason:
        _leave_out(device, name, str(reason))
        return None
    device.emit("phase", phase="saving")
    record = device.emit("posture", sync=True, name=name, **measurement, **fields)
    device.requests.check_pause()
    return record


def _withdraw(run: RunFolder) -> None:
    """A coupling slips, perhaps by a little before it was seen: what was measured
    since the zero posture was read last is measured again."""
    looked = [*run.journal.events("zero"), *run.journal.events("reference")]
    since = max((record["seq"] for record in looked), default=0)
    names = [n for n, record in run.postures().items() if record["seq"] > since]
    if names:
        run.emit("void", sync=True, names=names)


def _ended_there(device: Device, ended: Record) -> bool:
    """Whether this axis ended short at this place before, on the way to a posture."""
    axis = next(axis for axis in device.config.axes if axis.name == ended["axis"])
    return any(
        (record["name"], record["axis"]) == (ended["name"], ended["axis"])
        and abs(record["pulses"] - ended["pulses"])
        <= axis.pulses_within(SAME_PLACE_DEG)
        for record in device.run.journal.events("ended_short")
    )


def _leave_out(device: Device, name: str, reason: str) -> None:
    """Go on without a posture that is out of reach, once all drives stand.

    Raises:
        MotionFault: they do not, or that is one more than may be.
    """
    results = device.stopper.stop(reason, latch=False)
    if not all(r.standing for r in results) or not all(
        r.standing for r in device.stopper.stay()
    ):
        raise MotionFault(f"{reason}, and not all drives are at rest")
    device.untrack()
    device.emit("unreachable", sync=True, name=name, reason=reason)
    _check_lost(device)


def _check_lost(device: Device) -> None:
    """No more postures are out of reach than may be."""
    most = device.config.session.max_unreachable
    lost = {record["name"] for record in device.run.journal.events("unreachable")}
    if len(lost) > most:
        raise MotionFault(
            f"{len(lost)} postures are out of reach, more than session.max_unreachable "
            f"({most}). Narrow session.*_range_deg to what the device reaches, and "
            "start a new run"
        )
