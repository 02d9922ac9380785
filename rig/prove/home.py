"""Home: what place the drives' counts mean; and what the drives are."""

from __future__ import annotations

import time

from rig.command_run import Run
from rig.config import RigConfig
from rig.core.device import Device
from rig.core.proof import BLIND, NOISE_DEG
from rig.drives.drive import HOME, Drive
from rig.drives.line import BusError
from rig.faults import MotionFault, Refused
from rig.journal.device import HOMED
from rig.readings.geometry import Array, Reading

NO_LIMIT_DEG = 1e9
HOME_S = 120.0  # for one axis on its own way home
SET_S, SET_TRIES = 1.0, 3  # until a drive counts from its new zero
ANSWER_S = 0.5  # until a drive that was sent home moves
RATE_S = 0.2  # time over which the speed of a homing is taken
BLIND_DEG = 10.0  # of a joint, of which the phone must see SEEN_DEG
SEEN_DEG = 0.5
POLL_S = 0.05


def unlimited(config: RigConfig) -> RigConfig:
    """``config`` without soft limits, for drives whose counts mean nothing yet."""
    axes = tuple(
        axis.model_copy(update={"min_deg": -NO_LIMIT_DEG, "max_deg": NO_LIMIT_DEG})
        for axis in config.axes
    )
    return config.model_copy(update={"axes": axes})


def can_home(config: RigConfig) -> bool:
    return all(axis.map.has("home") for axis in config.axes)


def home(run: Run, device: Device, config: RigConfig, here: bool) -> None:
    """Make the counts of ``unlimited`` drives mean a place; the device is HOMED.
    ``config``'s limits watch a homing. ``here``: the device stands at home, and each
    drive is told so, or its count is noted; else it homes itself."""
    for drive, axis in zip(device.drives, config.axes, strict=True):
        if here:
            _set_zero(run, device, drive)
        else:
            _go_home(run, device, drive, axis.max_deg - axis.min_deg)
    positions = list(device.positions())
    how = "here" if here else "drive"
    run.emit("homed", sync=True, how=how, pulses=positions)
    origins = {drive.axis.name: drive.origin for drive in device.drives}
    run.record.reach(HOMED, run.config, how=how, pulses=positions, origins=origins)
    run.say(f"home: the drives count {positions} pulses")


def _set_zero(run: Run, device: Device, drive: Drive) -> None:
    if not drive.can_set_zero:
        here = drive.status().position
        run.say(f"  {drive.axis.name} cannot be set to a count: home is {here}")
        return
    if drive.counts_from_home:
        if _counts_from(device, drive, HOME) is None:
            return
        run.say(
            f"  {drive.axis.name}: the drive does not accept the count {HOME}, so it "
            "is set to 0; a loss of power while it is at 0 is not detected"
        )
    if (fault := _counts_from(device, drive, 0)) is not None:
        raise MotionFault(f"{fault}. Set it with the maker's tool")


def _counts_from(device: Device, drive: Drive, origin: int) -> str | None:
    """Make where the drive stands its origin; why it is not, or None."""
    tolerance = drive.axis.pulses_within(device.config.motion.position_tolerance_deg)
    lost = ""
    for _ in range(SET_TRIES):  # the same once more where a frame was lost
        try:
            drive.set_zero(origin)
        except BusError as error:
            lost = f" ({error})"
        end = time.monotonic() + SET_S
        while True:
            drive.forget_origin()
            count = drive.sound().position + drive.origin
            if abs(count - origin) <= tolerance:
                return None
            device.guard()
            if time.monotonic() > end:
                break
            time.sleep(POLL_S)
    return (
        f"{drive.axis.name} still counts {count} pulses after its position was set to "
        f"{origin}{lost}"
    )


def _go_home(run: Run, device: Device, drive: Drive, range_deg: float) -> None:
    """Let a drive home itself, as far and as fast as it is set to, under the phone."""
    axis, motion = drive.axis, device.config.motion
    run.say(f"  {axis.name} goes home")
    run.emit("command", label="home", axis=axis.name, pulses=None)
    base, begun, gone = device.attitude(), time.monotonic(), 0
    device.proof.stay_near(base, range_deg + motion.envelope_margin_deg)
    last = drive.status().position
    drive.home()
    while True:
        device.guard(moving=True)
        status = drive.sound()
        reading = device.imu.latest()
        device.proof.watch(reading.value)
        _check_homing(device, drive, reading, base, gone)
        way = abs(status.position - last)
        gone += way if way < axis.pulses_per_rev else 0  # or it counts anew
        last = status.position
        waited = time.monotonic() - begun
        done = not drive.tells_homed or drive.says_homed
        if not status.moving and waited > ANSWER_S and done:
            break
        if waited > HOME_S:
            text = f"{axis.name} is not home after {HOME_S:g} s. Check its home switch"
            raise MotionFault(f"{text} and the homing set in the drive")
        time.sleep(motion.poll_s)
    drive.forget_origin()
    device.guard()


def _check_homing(
    device: Device, drive: Drive, reading: Reading, base: Array, gone: int
) -> None:
    """The phone has turned in so many pulses, and no faster than it may."""
    axis, most = drive.axis, device.config.motion.max_speed_deg_s
    recent = device.imu.since(reading.time - RATE_S)
    apart, scale = device.geometry.apart, device.geometry.scale
    turned = apart(recent[0].value, reading.value)
    # Numbers have no speed of a joint.
    if device.config.imu and turned > most * RATE_S + NOISE_DEG:
        raise MotionFault(
            f"{axis.name} homes at {turned / RATE_S:.0f} deg/s by the phone, more than "
            f"motion.max_speed_deg_s = {most:g}. Set its homing to a lower speed"
        )
    if abs(axis.to_deg(gone)) > BLIND_DEG and (
        apart(base, reading.value) < SEEN_DEG * scale
    ):
        raise MotionFault(
            f"the drive of {axis.name} has turned {abs(axis.to_deg(gone)):.0f} deg "
            f"towards home, but {device.imu.whose} measured no motion. {BLIND}"
        )


def identity(drives: list[Drive]) -> dict[str, dict[str, int | str]]:
    """What tells the drive of each axis from others; Refused: of another family."""
    identities: dict[str, dict[str, int | str]] = {}
    for drive in drives:
        axis, verb = drive.axis, "is not"
        try:
            values = drive.ids()
            drive.status()
            fault = drive.foreign(values)
        except BusError as error:
            fault, verb = str(error) or repr(error), "does not answer like"
        if fault:
            raise Refused(
                f"{axis.name} (unit {axis.unit}) {verb} {axis.map.name}: {fault}. Run "
                "`jaxcal-rig check scan`"
            )
        identities[axis.name] = drive.lasting(values)
    if len(drives) > 1 and drives[0].line.answers_for_every_unit():
        raise Refused(
            f"{drives[0].line.settings.where} answers for every unit id, so the drives "
            "cannot be told apart. Set the gateway to use the unit id"
        )
    return identities
