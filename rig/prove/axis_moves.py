"""Small moves of each axis that show what unit turns what, which way and how far."""

from __future__ import annotations

import numpy as np

from rig.command_run import Run
from rig.config.axis import Axis
from rig.core.device import Device, Posture
from rig.core.motion import move
from rig.core.proof import BLIND, FIRST_MOTOR_DEG, slopes, unit_proved
from rig.faults import MotionFault, Refused
from rig.journal.device import SIGN_CHECKED
from rig.prove import axis_check
from rig.prove.axis_check import Change, Stand
from rig.prove.stops import prove_stops

REACH_DEG = 3.0  # each way
FAR_ENOUGH = 1.1  # a move that would be no longer than that is not made
SURE_SIGMA = 3.0
CORNER_DEG = 6.0  # commanded at most, so that the phone turns about REACH_DEG
CORNER_STD_DEG = 0.015  # of the mean over corners, where rotations make 0.08 deg
ROOM_DEG = 0.2  # left to a limit
SEEN_DEG = 0.03  # the phone must turn at least this much in a whole move
SEEN_SIGMA = 6.0
TAKEN_UP = 0.5  # of what an axis turns for a pulse: its play was not in between


def check_axes(run: Run, device: Device) -> list[Change]:
    """Move, measure, say what is found; the corrections that follow. Without any the
    device is SIGN_CHECKED and, once every way to stop it was tried, STOP_PROVED."""
    config, stands = run.config, measure_axes(run, device)
    start, model, expected = stands["start"].pulses, run.model, None
    more: dict[str, float] = {}
    if config.imu is None:
        if model is not None:
            expected = slopes(model.predict, config.to_deg(start))
        changes, ratios = axis_check.check_numbers(config, stands, expected)
    else:
        if model is not None and model.rotations is not None:
            expected = model.axes_at(config.to_deg(start))
        findings = axis_check.find(config, stands, expected)
        told = [drive.pulses_per_rev() for drive in device.drives]
        ratios = axis_check.ratios_of(config, findings)
        if config.phone.unit == "rad":
            axis_check.require_unit(config, ratios, proved=True)
        axis_check.require_gearing(config, ratios, told)
        changes = axis_check.proposals(config, findings, told)
        run.say(*axis_check.lines(config, findings))
        more = {"phone_turned_deg": round(findings.turned_deg, 2)}
    rounded = np.round(ratios, 4).tolist()
    evidence = {
        "ratio": dict(zip(config.axis_names, rounded, strict=True)),
        **more,
        "run": run.folder.name,
    }
    run.emit("axes", sync=True, **evidence, changes=[str(change) for change in changes])
    if not changes:
        scales = [axis.pulses_per_deg for axis in config.axes]
        turned = (axis_check.rates_of(config, stands) * scales).round(6).tolist()
        turns = {"pulses": start.tolist(), "deg": turned}
        run.record.reach(SIGN_CHECKED, config, **evidence, turns=turns)
        run.say("each unit turns its joint in the right direction, about as commanded")
        prove_stops(run, device)
    return changes


def measure_axes(run: Run, device: Device) -> dict[str, Stand]:
    """Visit the places that ``axis_check.find`` reads from, and come back. Refused: an
    axis stands too near to a limit. MotionFault: one does not turn the phone, or too
    far, or the unit of the phone's angles is not the configured one."""
    config, start = run.config, device.positions()
    room = [_room_deg(axis, at) for axis, at in zip(config.axes, start, strict=True)]
    # Of numbers it does not matter which axis carries which; of an arm it is known.
    ordered = config.imu is None or config.is_arm
    corners = [] if ordered else axis_check.corners_of(len(config.axes))
    run.say(
        f"axes: about {1 + 6 * len(start) + len(corners)} places; each axis first by "
        f"{FIRST_MOTOR_DEG:g} deg of its motor, then as far as the measured motion "
        f"allows, at most {REACH_DEG:g} deg or mm in either direction"
    )
    tour = _Tour(run, device, start)
    device.proof.stay_near(tour.base.attitude)
    if not unit_proved(config.source, tour.base.attitude):
        tour.prove_unit()
    corner: list[int] = []  # pulses of each axis
    for j, axis in enumerate(config.axes):
        far, turned = tour.measure_axis(j)
        most = min(CORNER_DEG, room[j]) / abs(axis.to_deg(far))
        corner.append(round(far * min(REACH_DEG / turned, most)))
    clear = axis_check.CLEAR * tour.base.std_deg / CORNER_STD_DEG
    clear = int(np.ceil(clear**2 / max(1, len(corners))))
    samples = min(max(clear, config.settle.samples), 8 * config.settle.samples)
    # The first sign changes most often: that of the axis with the shortest way.
    pairs = zip(config.axes, corner, strict=True)
    quickest = np.argsort([abs(axis.to_deg(count)) for axis, count in pairs])
    for changed in corners:
        signs = [changed[rank] for rank in np.argsort(quickest)]
        ways = {j: sign * corner[j] for j, sign in enumerate(signs)}
        tour.visit(axis_check.corner_name(config, signs), ways, samples)
    move(device, Posture("back", start))
    return tour.stands


def _room_deg(axis: Axis, pulses: int) -> float:
    """Degrees from here to the nearer limit, less what is left to it."""
    here = axis.to_deg(pulses)
    room = min(here - axis.min_deg, axis.max_deg - here) - ROOM_DEG
    if room < REACH_DEG:
        raise Refused(
            f"{axis.name} is {room + ROOM_DEG:.1f} deg from a limit; it must go "
            f"{REACH_DEG:g} either way. Move it: jaxcal-rig setup jog {axis.name} DEG"
        )
    return room


class _Tour:
    """The places around the start, each of them measured."""

    def __init__(self, run: Run, device: Device, start: tuple[int, ...]) -> None:
        self.run, self.device, self.start = run, device, start
        self.stands: dict[str, Stand] = {}
        samples = run.config.settle.samples
        self.base = self.visit("start", {}, 4 * samples)
        self.noise = SURE_SIGMA * self.base.std_deg * (2.0 / samples) ** 0.5

    def visit(self, name: str, offset: dict[int, int], samples: int = 0) -> Stand:
        target = tuple(p + offset.get(axis, 0) for axis, p in enumerate(self.start))
        posture, stands = Posture(name, target), self.stands
        stands[name] = axis_check.stand_at(self.run, self.device, posture, samples)
        return stands[name]

    def turned(self, stand: Stand) -> float:
        """How far the phone turned from the start, or the numbers changed."""
        return self.device.geometry.apart(self.base.attitude, stand.attitude)

    def grow(self, j: int, unit: bool, samples: int = 0) -> list[tuple[int, Stand]]:
        """Move an axis further and further; pulses and the places, from the start."""
        config, geometry = self.run.config, self.device.geometry
        reach = self.device.proof.renew(j, unit)
        furthest, places = config.axes[j].to_pulses(REACH_DEG), [(0, self.base)]
        way = int(np.sign(furthest))
        while True:
            count = reach.pulses(furthest, REACH_DEG * geometry.scale)
            if count <= FAR_ENOUGH * abs(places[-1][0]):
                return places
            name = f"{config.axis_names[j]}:plus"
            stand = self.visit(name, {j: way * count}, samples)
            reach.saw(count, self.turned(stand), self.noise)
            places.append((way * count, stand))

    def taken_up(self, places: list[tuple[int, Stand]]) -> bool:
        """Whether an axis had its play taken up at the last two of its places: it
        turned the phone on the way to the first of them as it did between them."""
        if len(places) < 3 or 2 * abs(places[-2][0]) > abs(places[-1][0]):
            return False
        pulses = [abs(count) for count, _ in places[-3:]]
        turned = [self.turned(stand) for _, stand in places[-3:]]
        before, between = np.diff(turned) / np.diff(pulses)
        return bool(before > TAKEN_UP * between)

    def prove_unit(self) -> None:
        """Short moves that tell degrees of the phone from radians."""
        config = self.run.config
        self.run.say(
            "  no angle of the phone exceeds 6.3, so the unit (degrees or radians) is "
            "unknown: shorter moves find it first"
        )
        ratios = []
        for j, axis in enumerate(config.axes):
            far, _ = self.grow(j, False, 4 * config.settle.samples)[-1]
            turned = self.turned(self.stands[f"{axis.name}:plus"])
            told = self.device.drives[j].pulses_per_rev() or axis.pulses_per_rev
            geared = told / axis.pulses_per_rev
            ratios.append(geared * turned / abs(axis.to_deg(far)))
            self.visit(f"{axis.name}:back", {j: 0})
        axis_check.require_unit(config, ratios)

    def measure_axis(self, j: int) -> tuple[int, float]:
        """Places of one axis, both ways; pulses of the furthest, and what it turned."""
        axis, geometry = self.run.config.axes[j], self.device.geometry
        places = self.grow(j, True)
        far, plus = places[-1]
        turned = self.turned(plus)
        commanded = abs(axis.to_deg(far))
        least = SEEN_SIGMA * self.base.std_deg / plus.samples**0.5
        if turned < max(SEEN_DEG * geometry.scale, least):
            raise MotionFault(
                f"unit {axis.unit} turned its motor by {commanded:g} {axis.unit_name} "
                f"of {axis.name}, and {geometry.told} {turned:.3g}. {BLIND}"
            )
        # Up to its place its play is taken up on one side, down to it on the other.
        more = [("back", 0), ("minus", -far)]
        if self.taken_up(places):
            self.stands[f"{axis.name}:look"] = places[-2][1]
        else:
            more += [("look", far // 4), ("plus", far)]
        for name, count in more:
            self.visit(f"{axis.name}:{name}", {j: count})
        move(self.device, Posture(axis.name, self.start))
        self.run.say(
            f"  {axis.name}: {commanded:.2f} {axis.unit_name} commanded, "
            f"{geometry.told} {turned:.3g}"
        )
        return far, turned
