"""What a degree of each axis turns of the phone: as `axes` saw it, and as it is now.

A gearbox, a drive or its setting may have been exchanged since, or the phone turned on
its holder. So a session begins with small moves of one axis after the other, each of
which must turn the phone as `axes` saw: as far within a third, about the same axis.
"""

from __future__ import annotations

import numpy as np

from rig.core.device import Device, Posture
from rig.core.measure import measure
from rig.core.motion import move
from rig.core.proof import Turns, slopes
from rig.faults import MotionFault, TurnedTooFar
from rig.journal.device import SIGN_CHECKED
from rig.readings.attitude import Array

SHOWN_DEG = 3.0  # that each axis is moved, from a third of it to the whole
RATIO = (2 / 3, 4 / 3)  # of what `axes` saw
ASIDE_DEG = 4.0  # between the axes of two turns, and ...
SURE_SIGMA = 4.0  # ... of what the noise of the readings makes


def show(device: Device) -> None:
    """Each axis by itself turns the phone as `axes` saw it, or SIGN_CHECKED is void.

    Raises:
        MotionFault: it does not, or it moves too fast.
    """
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
        attitudes = [np.array(measurement["attitude"]) for measurement in measurements]
        turn = device.geometry.way(*attitudes) / axis.to_deg(far - near)
        noise = max(
            max(measurement["std_deg"]) / measurement["samples"] ** 0.5
            for measurement in measurements
        )
        _compare(device, j, turn, expected[:, j], noise / abs(axis.to_deg(far - near)))
        move(device, Posture("where it began", start))
    device.shown = True


def _compare(device: Device, j: int, turn: Array, then: Array, noise: float) -> None:
    """(3,) turns for a degree of axis j, or (m,) of numbers, now and at `axes`; the
    noise of each part."""
    size, before = float(np.linalg.norm(turn)), float(np.linalg.norm(then))
    share, axis, geometry = size / before, device.config.axes[j], device.geometry
    one = "degree" if axis.unit_name == "deg" else axis.unit_name
    along = float(turn @ then)
    across = max(size**2 * before**2 - along**2, 0.0) ** 0.5
    aside = np.degrees(np.arctan2(across, along))
    device.emit(
        "shown", sync=True, axis=axis.name, ratio=round(size, 4),
        before=round(before, 4), aside_deg=round(float(aside), 2),
        speed_deg_s=round(device.paces[axis.name].seen_deg_s, 2),
    )  # fmt: skip
    fault = ""
    if not RATIO[0] <= share <= RATIO[1]:
        fault = (
            f"{axis.name} {geometry.changed} {size:.3g} {geometry.unit} per commanded "
            f"{one}; `axes` measured {before:.3g}. Its drive, setting or gearbox was "
            "exchanged, or the coupling slips"
        )
    elif aside > ASIDE_DEG + np.degrees(SURE_SIGMA * noise / before):
        fault = (
            f"{axis.name} turned the phone about an axis {aside:.1f} deg from the one "
            "that `axes` measured: the phone or its holder was turned since"
        )
        if device.config.imu is None:
            fault = (
                f"{axis.name} changed the readings in a direction {aside:.1f} deg from "
                "the one that `axes` measured: the sensor was moved since"
            )
    if fault:
        device.record.void(SIGN_CHECKED, fault)
        raise MotionFault(f"{fault}. Correct it, then run `jaxcal-rig setup axes`")
