"""Settling and measuring: when a posture is at rest, and what its attitude is."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from rig.config.axis import Pulses
from rig.core.device import Device, Posture
from rig.core.motion import Arrival
from rig.drives.drive import Status
from rig.faults import MotionFault, NotFollowing
from rig.readings.geometry import Array, Frame, Reading

DISAGREEMENT_DEG = 45.0  # between IMU and command at a posture, at most
FOLLOW_MIN_DEG = 3.0  # a commanded change this large must be seen by the IMU
FOLLOW_SHARE = 0.1  # at least this share of it
FOLLOW_MODEL = 0.6  # of what the axis that changes most changes: a model's error
FOLLOW_LEADING = 0.3  # of axes that move at least this share of the largest move


def zeroed(device: Device, frame: Frame, zero: Posture) -> None:
    """Measure against this zero posture from now on."""
    device.frame, device.zero, device.heard = frame, zero, device.imu.connections
    at_deg = device.config.to_deg(zero.pulses)
    device.seen = at_deg, np.zeros(len(device.config.output_names))


def measure(standing: Arrival, samples: int | None = None) -> dict[str, Any]:
    """Wait until a device at a posture has settled, then average so many readings.

    Returns, for the journal: ``pulses`` commanded, ``feedback`` of the drives;
    ``commanded_deg``, ``measured_deg`` and, of single readings, ``std_deg``;
    ``samples``; ``attitude`` (3, 3), their mean; every single reading. MotionFault: it
    does not settle in time, or the IMU disagrees with the drives.
    """
    device, target = standing.device, standing.posture.pulses
    settle = device.config.settle
    deadline = time.monotonic() - device.paused_s + settle.timeout_s
    readings: list[Reading] = []
    while not readings:  # the stream paused, or what was read was not quiet
        device.emit("phase", phase="settling")
        statuses = _settled(device, deadline)
        device.emit("phase", phase="measuring")
        readings = _collect(device, samples or settle.samples)
        if readings:
            frame, values = _frame(device, readings), [r.value for r in readings]
            raw = frame.angles(values)
            std = raw.std(axis=0, ddof=1) if len(raw) > 1 else np.zeros(raw.shape[1])
            if (std > settle.std_deg).any():
                readings = []
    attitude = device.geometry.mean(values)
    angles, commanded = frame.angles(attitude), device.config.to_deg(target)
    before = [status.position for status in statuses]
    feedback = [status.position for status in device.statuses()]
    for places in (before, feedback):  # a drive may have moved meanwhile
        _check_position(device, target, places)
    if device.oriented:
        _check_agreement(device, commanded, angles)
    return {
        "pulses": list(target),
        "feedback": feedback,
        "commanded_deg": commanded.round(9).tolist(),
        "measured_deg": angles.round(9).tolist(),
        "std_deg": std.round(6).tolist(),
        "samples": len(readings),
        "attitude": attitude.round(12).tolist(),
        **device.geometry.raw(readings),
    }


def _frame(device: Device, readings: list[Reading]) -> Frame:
    """Before the zero is taken, the first of the readings stands for it."""
    return device.frame or device.geometry.frame(readings[0].value)


def _settled(device: Device, deadline: float) -> list[Status]:
    """Poll until drives and IMU are quiet; what the drives say then."""
    settle, since = device.config.settle, time.monotonic()
    while True:
        device.guard()
        paused_s = device.paused_s
        device.await_stream()
        statuses = device.statuses()
        now = time.monotonic()
        if device.paused_s > paused_s or any(status.moving for status in statuses):
            since = now
        if not (reason := _unquiet(device, device.imu.since(since), now)):
            return statuses
        if now - device.paused_s > deadline:
            text = f"the device did not settle in {settle.timeout_s:g} s"
            raise MotionFault(f"{text}: {reason}")
        time.sleep(device.config.motion.poll_s)


def _unquiet(device: Device, readings: list[Reading], now: float) -> str:
    """Why the last readings do not show a device at rest, and what to do."""
    settle = device.config.settle
    # The last that span the window; of a slow phone, or of bursts, they span more.
    newest = readings[-1].time if readings else now
    before = sum(reading.time <= newest - settle.window_s for reading in readings)
    first = min(before - 1, len(readings) - settle.min_samples)
    hint = f"{device.imu.lost}{device.imu.dropped}"
    if first < 0:
        span = newest - readings[0].time if readings else 0.0
        return (
            f"{len(readings)} readings in {span:.2f} s (needed: settle.min_samples = "
            f"{settle.min_samples} in {settle.window_s:g} s). {hint}"
        )
    readings = readings[first:]
    if now - readings[-1].time > device.imu.stale_s:
        return f"{device.imu.whose}'s readings are too old. {hint}"
    names, told = device.config.output_names, device.config.output_unit
    angles = _frame(device, readings).angles([reading.value for reading in readings])
    times = np.array([reading.time for reading in readings])
    times = times - times.mean()
    slope = np.abs(times @ (angles - angles.mean(axis=0)) / (times @ times))
    for what, values, limit, unit in (
        ("std_deg", angles.std(axis=0, ddof=1), settle.std_deg, told),
        ("slope_deg_s", slope, settle.slope_deg_s, f"{told}/s"),
    ):
        worst = int(np.argmax(values))
        if values[worst] > limit:
            return (
                f"{names[worst]} reads {values[worst]:.3f} {unit} (settle.{what} = "
                f"{limit:g}). Either something still vibrates, or the limit is below "
                f"{device.imu.whose}'s noise. `jaxcal-rig check imu` shows the noise; "
                "set the limit above it"
            )
    return ""


def _collect(device: Device, wanted: int) -> list[Reading]:
    """Fresh readings as wanted, or none where the stream paused or time is up."""
    config, settle, imu = device.config, device.config.settle, device.imu
    start = polled = time.monotonic()
    deadline = start + settle.timeout_s * max(1.0, wanted / settle.samples)
    while True:
        device.guard()
        readings = imu.since(start)
        if len(readings) >= wanted:
            return readings[:wanted]
        now = time.monotonic()
        newest = readings[-1].time if readings else start
        if now - newest > imu.stale_s or now > deadline:
            return []
        if now - polled > config.motion.poll_s:
            polled = now
            if any(status.moving for status in device.statuses()):
                text = "a drive moves during the measurement of the posture"
                raise MotionFault(f"{text}. Stop the other controller")
        time.sleep(0.002)


def _check_position(device: Device, target: Pulses, feedback: list[int]) -> None:
    tolerance = device.config.motion.position_tolerance_deg
    for axis, goal, here in zip(device.config.axes, target, feedback, strict=True):
        if abs(goal - here) > axis.pulses_within(tolerance):
            raise MotionFault(
                f"{axis.name} left its target while settling: it is at {here} pulses "
                f"instead of {goal}. Check holding torque and load, and that no other "
                "controller moves it"
            )


def _check_agreement(device: Device, commanded: Array, measured: Array) -> None:
    """The joints are where the drives say, roughly, and moved when they moved."""
    names, (start, first) = device.config.axis_names, device.seen
    # What are no angles of joints is compared by how it changes alone.
    apart = measured - commanded if device.geometry.of_joints else np.zeros(1)
    if (np.abs(apart) > DISAGREEMENT_DEG).any():
        worst = int(np.argmax(np.abs(apart)))
        raise MotionFault(
            f"the IMU reads {names[worst]} {abs(apart[worst]):.1f} deg away from the "
            f"command (limit {DISAGREEMENT_DEG:g} deg). Check the zero posture, then "
            "run `jaxcal-rig setup axes`"
        )
    way = commanded - start
    asked = np.abs(way)
    moved = device.moved(measured - first, start + way / 2.0)
    if moved is None:
        _check_predicted(device, commanded, measured)
    followed = np.sign(way) * (way if moved is None else moved)
    leading = max(FOLLOW_MIN_DEG, FOLLOW_LEADING * float(asked.max()))
    for index, name in enumerate(names):
        if asked[index] >= leading and followed[index] < FOLLOW_SHARE * asked[index]:
            axis, imu = device.config.axes[index], device.config.imu
            went = "turned" if axis.kind == "rotation" else "moved"
            hint = "a slipped coupling, a frozen stream, or axes mixed up"
            if followed[index] < -FOLLOW_SHARE * asked[index]:
                hint = f"axes.{name}.direction, its wiring, and "
                hint += "imu.signs" if imu else "readings.factors"
            raise NotFollowing(
                f"the drive of {name} {went} {asked[index]:.1f} {axis.unit_name}, but "
                f"the {'IMU' if imu else 'sensor'} saw {followed[index]:.2f}. Look for "
                f"{hint}"
            )
    device.seen = commanded, measured


def _check_predicted(device: Device, commanded: Array, measured: Array) -> None:
    """Numbers changed about as the model says, where axes cannot be told apart."""
    if device.predict is None:
        return
    place, first = device.seen
    before = device.predict(place)
    alone = place + np.diag(commanded - place)  # each axis by itself
    largest = max(np.linalg.norm(device.predict(at) - before) for at in alone)
    expected = device.predict(commanded) - before
    off = float(np.linalg.norm(measured - first - expected))
    if off > FOLLOW_MODEL * largest + FOLLOW_MIN_DEG * device.geometry.scale:
        raise NotFollowing(
            f"the readings differ from the model's prediction by {off:.3g} "
            f"{device.config.output_unit}; one axis changes them by at most "
            f"{largest:.3g}. Look for a slipped coupling, a frozen stream, exchanged "
            "axes, or a [model] of another device"
        )
