"""Small moves of each axis that show what unit turns what, which way and how far."""

from __future__ import annotations

import itertools

import numpy as np

from rig.commission.bench import Bench
from rig.commission.chain import CLEAR
from rig.commission.findings import Findings, find
from rig.commission.proposals import Change, lines, proposals
from rig.commission.stands import Stand, turn
from rig.config import AXIS_NAMES
from rig.config.axis import Pulses
from rig.core.faults import MotionFault, Refused
from rig.core.record import SIGN_CHECKED

LOOK_DEG = 0.5  # the first move of an axis whose gearing is not proved
REACH_DEG = 3.0  # each way
PAIR_DEG = 6.0  # commanded at most, so that the phone turns about REACH_DEG
PAIR_STD_DEG = 0.03  # two rotations of REACH_DEG in either order are 0.16 deg apart
ROOM_DEG = 0.2  # left to a limit
SEEN_DEG = 0.03  # the phone must turn at least this much in a whole move
SEEN_SIGMA = 6.0


def check_axes(run: Bench, names_known: bool) -> tuple[Findings, list[Change]]:
    """Move, measure and say what is found; the corrections that follow from it.

    Where nothing is to be corrected the device is SIGN_CHECKED.
    """
    stands = measure(run)
    found = find(run.config, stands, names_known)
    device = run.arm()
    told = [drive.pulses_per_rev() for drive in device.drives]
    changes = proposals(run.config, found, told)
    ratios = [
        float(abs(each * axis.pulses_per_deg))
        for each, axis in zip(found.deg_per_pulse, run.config.axes, strict=True)
    ]
    evidence = {
        "ratio": dict(zip(AXIS_NAMES, np.round(ratios, 4).tolist(), strict=True)),
        "off_deg": found.off_deg.round(2).tolist(),
        "backlash_deg": found.backlash_deg.round(4).tolist(),
        "phone_turned_deg": round(found.turned_deg, 2),
        "run": run.folder.name,
    }
    run.emit("axes", sync=True, **evidence, changes=[str(change) for change in changes])
    run.say(*lines(run.config, found))
    if not changes:
        run.record.reach(SIGN_CHECKED, run.plain, **evidence)
        run.say("each unit turns its own joint, the right way and about as far as told")
    return found, changes


def measure(run: Bench) -> dict[str, Stand]:
    """Visit the places that ``findings.find`` reads from, and come back.

    Raises:
        Refused: an axis stands too near to a limit.
        MotionFault: an axis does not turn the phone, or turns it too far.
    """
    device = run.arm()
    config, start = run.config, device.positions()
    _check_room(run, start)
    stands: dict[str, Stand] = {}
    run.planned = 1 + 5 * 3 + 2 * 3

    def visit(name: str, offset: dict[int, float], samples: int = 0) -> Stand:
        """Stand at degrees away from the start, and measure."""
        target = list(start)
        for axis, way in offset.items():
            target[axis] += config.axes[axis].to_pulses(way)
        pitch, yaw, roll = target
        run.signals.check_pause()
        run.small.move_to((pitch, yaw, roll), name)
        measured = run.observer.measure((pitch, yaw, roll), name, samples or None)
        run.emit("stand", sync=True, name=name, **measured)
        stands[name] = Stand.of(measured)
        return stands[name]

    run.say(f"axes: {run.planned} places, each axis up to {REACH_DEG:g} deg either way")
    base = visit("start", {}, 4 * config.settle.samples)
    run.small.stay_near(base.attitude, REACH_DEG)
    pair = [0.0, 0.0, 0.0]
    for j, name in enumerate(AXIS_NAMES):
        look = visit(f"{name}:look", {j: LOOK_DEG})
        ratio = float(np.linalg.norm(turn(base.attitude, look.attitude))) / LOOK_DEG
        reach = REACH_DEG / max(1.0, ratio)
        if reach < 2 * LOOK_DEG:  # geared far too high: look again, from below
            run.small.move_to(_moved(run, start, j, -reach), name)
            visit(f"{name}:look", {j: reach / 4})
        plus = visit(f"{name}:plus", {j: reach})
        turned = float(np.linalg.norm(turn(base.attitude, plus.attitude)))
        if turned < max(SEEN_DEG, SEEN_SIGMA * base.std_deg / plus.samples**0.5):
            axis = config.axes[j]
            raise MotionFault(
                f"unit {axis.unit} turned its motor by {reach:g} deg of {name}, and "
                f"the phone turned {turned:.3f}. Look for a loose coupling, a stream "
                "that does not change, or a reduction that is far too small"
            )
        visit(f"{name}:back", {j: 0.0})
        visit(f"{name}:minus", {j: -reach})
        visit(f"{name}:up", {j: 0.0})
        pair[j] = min(PAIR_DEG, REACH_DEG * reach / turned, _room(run, start, j))
        run.say(f"  {name}: {reach:.2f} deg commanded, the phone turned {turned:.3f}")
    wanted = int(np.ceil(2.0 * (CLEAR * base.std_deg / PAIR_STD_DEG) ** 2))
    samples = min(max(wanted, config.settle.samples), 8 * config.settle.samples)
    for a, b in itertools.combinations(range(3), 2):
        for sign in "-+":
            way = pair[a] if sign == "+" else -pair[a]
            visit(
                f"{AXIS_NAMES[a]}{sign}{AXIS_NAMES[b]}+", {a: way, b: pair[b]}, samples
            )
    run.small.move_to(start, "back")
    return stands


def _moved(run: Bench, start: Pulses, axis: int, way_deg: float) -> Pulses:
    target = list(start)
    target[axis] += run.config.axes[axis].to_pulses(way_deg)
    a, b, c = target
    return a, b, c


def _room(run: Bench, start: Pulses, axis: int) -> float:
    """Degrees from the start to the nearer limit of an axis."""
    each = run.config.axes[axis]
    here = each.to_deg(start[axis])
    return min(here - each.min_deg, each.max_deg - here) - ROOM_DEG


def _check_room(run: Bench, start: Pulses) -> None:
    for j, name in enumerate(AXIS_NAMES):
        if (room := _room(run, start, j)) < REACH_DEG:
            raise Refused(
                f"{name} stands {room + ROOM_DEG:.1f} deg from a limit; the check "
                f"moves it {REACH_DEG:g} deg either way. Move it inwards: jaxcal-rig "
                f"jog {name}"
            )
