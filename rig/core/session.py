"""A session: arm, take the zero, visit, identify; stopped on every way out.

All that happens is an event of the run: journalled, and told to console, page,
telemetry and simulator. What the journal holds is not measured again: resuming is
running the same again.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from rig.config.axis import Pulses
from rig.core import record_check
from rig.core.device import Device, Posture, SessionRun, check_plan
from rig.core.measure import measure, zeroed
from rig.core.motion import Arrival, move
from rig.core.proof import Turns, slopes
from rig.core.record_check import ZeroRecord
from rig.faults import (
    EndedShort,
    MotionFault,
    NotFollowing,
    TurnedTooFar,
    Unreachable,
    ending,
)
from rig.journal.device import SIGN_CHECKED, ZEROED
from rig.journal.lock import BusLock
from rig.journal.run_folder import Record
from rig.readings.geometry import Array, Attitudes, angle_between_deg
from rig.readings.source import ReadingError

STREAM_WAIT_S = 60.0  # time to start the app on the phone
LEAST_TURN_DEG = 0.05  # of the phone's heading: less is its noise
ZERO_FACTOR = 4  # readings of the zero posture, in those of a posture
SAME_PLACE_DEG = 0.5  # two places where an axis ended short of one target
SHOWN_DEG = 3.0  # that each axis is moved, from a third of it to the whole
RATIO = (2 / 3, 4 / 3)  # of what `axes` saw
ASIDE_DEG = 4.0  # between the axes of two turns, and ...
SURE_SIGMA = 4.0  # ... of what the noise of the readings makes


@contextlib.contextmanager
def open_device(run: SessionRun) -> Iterator[Device]:
    """The device of a run, armed; however this ends its drives are stopped and looked
    at. MotionFault, BusError, ReadingError, Refused: not fit to move."""
    config, record, requests = run.config, run.record, run.signals
    device, lock = Device(run), BusLock(config.bus)
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
    device: Device, at: Pulses | None = None, kept: ZeroRecord | None = None
) -> None:
    """Measure the zero posture, that all others are measured against: ``at`` these
    pulses, or where the device stands, or 0 as configured. In a run that is resumed it
    must still read zero, with ``kept`` be that of a calibration; else MotionFault."""
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
    here = device.positions()
    device.check_untouched(here)  # since it was found
    zero = Posture("zero", at or here)
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
    device: Device, pulses: Pulses, attitude: Array, kept: ZeroRecord | None
) -> None:
    """With the calibration's zero posture, or else with the last one taken."""
    config, last = device.config, device.record.state(ZEROED)
    if kept is not None:
        device.emit("note", text=kept.check(config, pulses, attitude))
    elif last:
        then = np.array(last["attitude"])
        before = ZeroRecord("the last session", last["pulses"], then)
        try:
            before.check(config, pulses, attitude)
        except MotionFault as fault:  # a phone mounted anew is calibrated anew
            device.emit("note", text=f"WARNING: {fault}")
    evidence = {"pulses": list(pulses), "attitude": attitude.tolist()}
    device.record.reach(ZEROED, config, **evidence)


def _check_reference(device: Device, zero: Posture) -> None:
    """Before a resumed run goes on: the zero posture must still read zero."""
    angles, config = measure(move(device, zero))["measured_deg"], device.config
    limit, unit = config.session.reference_tolerance_deg, config.output_unit
    device.emit("reference", sync=True, angles=angles, limit=limit, unit=unit)
    if max(map(abs, angles)) > limit:
        moved = record_check.axes_text(config.output_names, unit, angles)
        raise MotionFault(
            f"the zero posture of this run has moved: {moved} (limit {limit:g}): the "
            f"drives lost their origin, or {device.imu.whose} or the device was moved. "
            "Start a new run"
        )


def _reorient(device: Device) -> None:
    """Read the zero again where the phone came back on a new connection."""
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
    """Move, measure and record with ``fields``, once in a run; None: out of reach."""
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
        while measurement is None or not device.oriented:  # the phone came back
            _reorient(device)
            measurement = measure(move(device, posture))
    except NotFollowing:
        # A coupling slips, perhaps by a little before it was seen: what was measured
        # since the zero posture was read last is measured again.
        looked = [*run.journal.events("zero"), *run.journal.events("reference")]
        since = max((record["seq"] for record in looked), default=0)
        if names := [n for n, r in run.postures().items() if r["seq"] > since]:
            run.emit("void", sync=True, names=names)
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


def _ended_there(device: Device, ended: Record) -> bool:
    """Whether this axis ended short at this place before, on the way to a posture."""
    axis = next(axis for axis in device.config.axes if axis.name == ended["axis"])
    near, same = axis.pulses_within(SAME_PLACE_DEG), (ended["name"], ended["axis"])
    return any(
        (record["name"], record["axis"]) == same
        and abs(record["pulses"] - ended["pulses"]) <= near
        for record in device.run.journal.events("ended_short")
    )


def _leave_out(device: Device, name: str, reason: str) -> None:
    """Go on without a posture that is out of reach, once all drives stand."""
    stopper = device.stopper
    stand = all(r.standing for r in stopper.stop(reason, latch=False))
    if not (stand and all(r.standing for r in stopper.stay())):
        raise MotionFault(f"{reason}, and not all drives are at rest")
    device.untrack()
    device.emit("unreachable", sync=True, name=name, reason=reason)
    _check_lost(device)


def _check_lost(device: Device) -> None:
    most = device.config.session.max_unreachable
    lost = {record["name"] for record in device.run.journal.events("unreachable")}
    if len(lost) > most:
        raise MotionFault(
            f"{len(lost)} postures are out of reach, more than session.max_unreachable "
            f"({most}). Narrow session.*_range_deg to what the device reaches, and "
            "start a new run"
        )


# What each axis turns


def show(device: Device) -> None:
    """Each axis by itself turns the phone as `axes` saw it, or SIGN_CHECKED is void."""
    turns, config, start = Turns.of(device.record), device.config, device.positions()
    if turns is None or device.shown:
        return
    device.emit("phase", phase="showing")
    expected = turns.at(config, start)
    if device.predict and not config.chain:  # numbers may change otherwise elsewhere
        at_start, then = (config.to_deg(place) for place in (start, turns.pulses))
        change = slopes(device.predict, at_start) - slopes(device.predict, then)
        expected = expected + change
    for j, axis in enumerate(config.axes):
        here = axis.to_deg(start[j])
        middle = (axis.min_deg + axis.max_deg) / 2.0  # a limit may be why it is here
        room = axis.max_deg - here if here <= middle else axis.min_deg - here
        way = min(max(room, -SHOWN_DEG), SHOWN_DEG)
        # Over the first third its play is taken up.
        near, far = (axis.to_pulses(here + share * way) for share in (1 / 3, 1.0))
        measurements = []
        for pulses in (near, far):
            place = tuple(pulses if i == j else p for i, p in enumerate(start))
            posture = Posture(f"show {axis.name}", place)
            try:
                measurements.append(measure(move(device, posture)))
            except TurnedTooFar as fault:
                device.record.void(SIGN_CHECKED, str(fault))
                raise
        attitudes = [np.array(m["attitude"]) for m in measurements]
        turn = device.geometry.way(*attitudes) / axis.to_deg(far - near)
        noise = max(max(m["std_deg"]) / m["samples"] ** 0.5 for m in measurements)
        _compare(device, j, turn, expected[:, j], noise / abs(axis.to_deg(far - near)))
        move(device, Posture("where it began", start))
    device.shown = True


def _compare(device: Device, j: int, turn: Array, then: Array, noise: float) -> None:
    """Turns for a degree of axis j (3,), or of numbers (m,), with those at `axes`."""
    size, before = float(np.linalg.norm(turn)), float(np.linalg.norm(then))
    share, axis, geometry = size / before, device.config.axes[j], device.geometry
    one = "degree" if axis.unit_name == "deg" else axis.unit_name
    along = float(turn @ then)
    across = max(size**2 * before**2 - along**2, 0.0) ** 0.5
    aside = np.degrees(np.arctan2(across, along))
    device.emit(
        "shown", sync=True, axis=axis.name, ratio=round(size, 4),
        before=round(before, 4), aside_deg=round(float(aside), 2),
    )  # fmt: skip
    fault = ""
    if not RATIO[0] <= share <= RATIO[1]:
        fault = (
            f"{axis.name} {geometry.changed} {size:.3g} {geometry.unit} per commanded "
            f"{one}; `axes` measured {before:.3g}. Its drive, setting or gearbox was "
            "exchanged, or the coupling slips"
        )
    elif aside > ASIDE_DEG + np.degrees(SURE_SIGMA * noise / before):
        did, what = "turned the phone about an axis", "phone or its holder was turned"
        if device.config.imu is None:
            did, what = "changed the readings in a direction", "sensor was moved"
        fault = f"{axis.name} {did} {aside:.1f} deg from the one that `axes` measured: "
        fault += f"the {what} since"
    if fault:
        device.record.void(SIGN_CHECKED, fault)
        raise MotionFault(f"{fault}. Correct it, then run `jaxcal-rig setup axes`")
