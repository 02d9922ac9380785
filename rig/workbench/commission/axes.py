"""Small moves of each axis that show what unit turns what, which way and how far."""

from __future__ import annotations

import numpy as np

from rig.core.device import Device, Posture
from rig.core.motion import move
from rig.core.proof import FIRST_MOTOR_DEG, slopes, unit_proved
from rig.faults import MotionFault, Refused
from rig.journal import SIGN_CHECKED
from rig.workbench.commission.axis_check import (
    CLEAR,
    Change,
    Stand,
    check_numbers,
    corner_name,
    corners_of,
    find,
    lines,
    proposals,
    rates_of,
    ratios_of,
    require_gearing,
    require_unit,
    stand_at,
)
from rig.workbench.commission.stops import prove_stops
from rig.workbench.run import Run

REACH_DEG = 3.0  # each way
FAR_ENOUGH = 1.1  # a move that would be no longer than that is not made
SURE_SIGMA = 3.0
CORNER_DEG = 6.0  # commanded at most, so that the phone turns about REACH_DEG
# Of the mean over the corners: two rotations of REACH_DEG make 0.08 deg there.
CORNER_STD_DEG = 0.015
ROOM_DEG = 0.2  # left to a limit
SEEN_DEG = 0.03  # the phone must turn at least this much in a whole move
SEEN_SIGMA = 6.0


def check_axes(run: Run, device: Device) -> list[Change]:
    """Move, measure and say what is found; the corrections that follow from it.

    Where nothing is to be corrected the device is SIGN_CHECKED, and once every way to
    stop it has been tried, STOP_PROVED.
    """
    stands = measure_axes(run, device)
    start, model, expected = stands["start"].pulses, run.model, None
    if run.config.imu is None:
        if model is not None:
            expected = slopes(model.predict, run.config.to_deg(start))
        changes, ratios = check_numbers(run.config, stands, expected)
        return _conclude(run, device, stands, changes, ratios, {})
    if model is not None and model.rotations is not None:
        expected = model.axes_at(run.config.to_deg(start))
    findings = find(run.config, stands, expected)
    told = [drive.pulses_per_rev() for drive in device.drives]
    ratios = ratios_of(run.config, findings)
    if run.config.phone.unit == "rad":
        require_unit(run.config, ratios, proved=True)
    require_gearing(run.config, ratios, told)
    changes = proposals(run.config, findings, told)
    run.say(*lines(run.config, findings))
    more = {"phone_turned_deg": round(findings.turned_deg, 2)}
    return _conclude(run, device, stands, changes, ratios, more)


def _conclude(
    run: Run,
    device: Device,
    stands: dict[str, Stand],
    changes: list[Change],
    ratios: list[float],
    more: dict[str, float],
) -> list[Change]:
    """Keep what was seen, where nothing is to be corrected, and prove the stops."""
    names = run.config.axis_names
    evidence = {
        "ratio": dict(zip(names, np.round(ratios, 4).tolist(), strict=True)),
        **more,
        "run": run.folder.name,
    }
    scales = np.array([axis.pulses_per_deg for axis in run.config.axes])
    turns = {
        "pulses": stands["start"].pulses.tolist(),
        "deg": (rates_of(run.config, stands) * scales).round(6).tolist(),
    }
    run.emit("axes", sync=True, **evidence, changes=[str(change) for change in changes])
    units = {axis.name: axis.unit_name for axis in run.config.axes}
    for name, pace in device.paces.items():
        run.say(
            f"  {name}: {pace.seen_deg_s:.3g} {units[name]}/s at least, "
            f"{pace.asked_deg_s:.3g} asked"
        )
    if not changes:
        run.record.reach(SIGN_CHECKED, run.config, **evidence, turns=turns)
        run.say("each unit turns its own joint, the right way and about as far as told")
        prove_stops(run, device)
    return changes


def measure_axes(run: Run, device: Device) -> dict[str, Stand]:
    """Visit the places that ``axis_check.find`` reads from, and come back.

    Raises:
        Refused: an axis stands too near to a limit.
        MotionFault: an axis does not turn the phone, or turns it too far, or the unit
            of the phone's angles is not the one that is configured.
    """
    config, start = run.config, device.positions()
    stands: dict[str, Stand] = {}
    room: list[float] = []  # degrees from the start to the nearer limit of an axis
    for axis, pulses in zip(config.axes, start, strict=True):
        here = axis.to_deg(pulses)
        room.append(min(here - axis.min_deg, axis.max_deg - here) - ROOM_DEG)
        if room[-1] < REACH_DEG:
            raise Refused(
                f"{axis.name} stands {room[-1] + ROOM_DEG:.1f} deg from a limit; the "
                f"check moves it {REACH_DEG:g} deg either way. Move it inwards: "
                f"jaxcal-rig jog {axis.name} DEG"
            )

    def visit(name: str, offset: dict[int, int], samples: int = 0) -> Stand:
        """Stand at pulses away from the start, and measure."""
        target = tuple(p + offset.get(axis, 0) for axis, p in enumerate(start))
        stands[name] = stand_at(run, device, Posture(name, target), samples)
        return stands[name]

    names, geometry = config.axis_names, device.geometry
    # Of numbers it does not matter which axis carries which; of an arm it is known.
    corners = corners_of(len(config.axes)) if config.imu and not config.is_arm else []
    run.say(
        f"axes: about {1 + 7 * len(names) + len(corners)} places; each axis first by "
        f"{FIRST_MOTOR_DEG:g} deg of its motor, then as far as what is seen allows, "
        f"{REACH_DEG:g} deg or mm at most either way"
    )
    base = visit("start", {}, 4 * config.settle.samples)
    device.proof.stay_near(base.attitude)
    noise = SURE_SIGMA * base.std_deg * (2.0 / config.settle.samples) ** 0.5
    wanted = [axis.to_pulses(REACH_DEG) for axis in config.axes]

    def turned(stand: Stand) -> float:
        return geometry.apart(base.attitude, stand.attitude)

    def grow(j: int, unit: bool, samples: int = 0) -> tuple[int, ...]:
        """Move an axis further and further; pulses of the last two places."""
        reach = device.proof.renew(j, unit)
        way, counts = int(np.sign(wanted[j])), [0]
        while True:
            count = reach.pulses(wanted[j], REACH_DEG * geometry.scale)
            if count <= FAR_ENOUGH * counts[-1]:
                return way * counts[-2], way * counts[-1]
            look = visit(f"{names[j]}:plus", {j: way * count}, samples)
            reach.saw(count, turned(look), noise)
            counts.append(count)

    proved = unit_proved(config.source, base.attitude)
    if not proved:
        run.say(
            "  no angle of the phone is over 6.3, so degrees are not told from "
            "radians: shorter moves show first which they are"
        )
        ratios = []
        for j, axis in enumerate(config.axes):
            _, far = grow(j, False, 4 * config.settle.samples)
            seen = turned(stands[f"{names[j]}:plus"])
            told = device.drives[j].pulses_per_rev() or axis.pulses_per_rev
            geared = told / axis.pulses_per_rev
            ratios.append(geared * seen / abs(axis.to_deg(far)))
            visit(f"{names[j]}:back", {j: 0})
        require_unit(config, ratios)
    corner = [0] * len(names)
    for j, name in enumerate(names):
        axis = config.axes[j]
        look, far = grow(j, True)
        plus = stands[f"{name}:plus"]
        way = turned(plus)
        least = SEEN_SIGMA * base.std_deg / plus.samples**0.5
        if way < max(SEEN_DEG * geometry.scale, least):
            raise MotionFault(
                f"unit {axis.unit} turned its motor by {abs(axis.to_deg(far)):g} "
                f"{axis.unit_name} of {name}, and {geometry.told} {way:.3g}. Look for "
                "a "
                "loose "
                "coupling, a stream that does not change, or a reduction that is far "
                "too small"
            )
        # Once more on the way up, where its play is taken up.
        down = tuple(p - far * (i == j) for i, p in enumerate(start))
        move(device, Posture(name, down))
        visit(f"{name}:look", {j: look if 2 * abs(look) <= abs(far) else far // 4})
        visit(f"{name}:plus", {j: far})
        visit(f"{name}:back", {j: 0})
        visit(f"{name}:minus", {j: -far})
        move(device, Posture(name, start))
        most = min(CORNER_DEG, room[j])
        corner[j] = round(far * min(REACH_DEG / way, most / abs(axis.to_deg(far))))
        run.say(
            f"  {name}: {abs(axis.to_deg(far)):.2f} {axis.unit_name} commanded, "
            f"{geometry.told} {way:.3g}"
        )
    clear = CLEAR * base.std_deg / CORNER_STD_DEG
    clear = int(np.ceil(clear**2 / max(1, len(corners))))
    samples = min(max(clear, config.settle.samples), 8 * config.settle.samples)
    for signs in corners:
        ways = {j: sign * corner[j] for j, sign in enumerate(signs)}
        visit(corner_name(config, signs), ways, samples)
    move(device, Posture("back", start))
    return stands
