"""goto: a posture through a calibration, with the play that the calibration keeps.

A joint with play of width w stands behind its drive by w / 2, on the side it comes
from. A calibration whose postures were reached from both sides stands in the middle:
the command is w / 2 further the way the axis arrives. One whose postures were all
reached from below (``motion.approach_overshoot_deg``) has that side in it: nothing is
added from below, and from above the command is the whole of w less.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rig.config import AXIS_NAMES, RigConfig
from rig.core.attitude import Array, Frame
from rig.core.device import Device, Posture
from rig.core.faults import EXIT_OK, EXIT_RECALIBRATE, LimitError
from rig.core.known import unseen
from rig.core.motion import move
from rig.core.session import visit
from rig.workbench.run import Run

CHARACTERISED = "characterised"  # the calibration's note of it
CENTRE_DEG = 0.2  # of a dead zone from where it was looked for, at most
MARGIN_DEG = 0.5  # by which the last move exceeds what it has to take up


class Play(NamedTuple):
    """Of pitch, yaw and roll, in degrees of commands; 0 where none was measured."""

    axes: Mapping[str, Any]  # what ``characterise`` found of an axis, by its name
    from_below: bool  # the calibration's postures were all reached from below
    widths: Array  # (3,) the best values
    run_up: Array  # (3,) length of a move that surely takes up play and friction

    @classmethod
    def of(cls, notes: Mapping[str, Any]) -> Play:
        """What a calibration's notes say."""
        axes, widths, run_up = notes.get(CHARACTERISED, {}), np.zeros(3), np.zeros(3)
        for i, name in enumerate(AXIS_NAMES):
            if found := axes.get(name):
                widths[i] = found["backlash_deg"]["value"]
                most = max(each["high"] for each in found["breakaway_deg"])
                run_up[i] = found["backlash_deg"]["high"] + most + MARGIN_DEG
        below = notes.get("approach_overshoot_deg", 0.0) > 0.0
        return cls(axes, below, widths, run_up)

    @property
    def most(self) -> Array:
        """(3,) by which a command is changed at most."""
        return self.widths * (1.0 if self.from_below else 0.5)

    def shift(self, direction: Array) -> Array:
        """(3,) what is added to a command that is reached in (3,) directions, +-1."""
        return self.widths / 2.0 * (direction - self.from_below)

    def lines(self, command: Array, direction: Array) -> Iterator[str]:
        """What is done, and what is not, in words."""
        for i, name in enumerate(AXIS_NAMES):
            if not (found := self.axes.get(name)):
                continue
            yield (
                f"  {name} has {self.widths[i]:.3f} deg of play and arrives "
                f"{'upwards' if direction[i] > 0 else 'downwards'}: command "
                f"{self.shift(direction)[i]:+.3f} deg"
            )
            zone, apart = found["dead_zone_deg"]["low"], found["dead_zone_at_deg"]
            if zone and abs(command[i] - apart) < CENTRE_DEG + zone / 2.0:
                yield f"  NOTE: {name} may not answer there: its dead zone is near"


def goto(run: Run, calibration: Any, desired: Array, play: Play) -> int:
    """Move the end-effector to (3,) desired degrees through a calibration.

    Args:
        run, calibration, desired: what moves, by what, and where to.
        play: of the axes, put back by the direction in which each arrives.
    """
    config = run.config
    command = np.asarray(calibration.command_for(desired), dtype=np.float64)
    for axis, value, most in zip(config.axes, command, play.most, strict=True):
        if not axis.min_deg + most <= value <= axis.max_deg - most:
            raise LimitError(
                f"{desired.tolist()} deg needs {axis.name} commanded to {value:.3f} "
                f"deg, outside [{axis.min_deg:g}, {axis.max_deg:g}]"
                + f" less its play, {most:.3f} deg" * bool(most)
                + ". Choose a target further inside"
            )

    def told(command: Array) -> None:
        run.say(
            f"desired {desired.tolist()} deg: command {command.round(4).tolist()} deg, "
            f"pulses {list(config.to_pulses(command))}"
        )

    if run.dry_run or not play.axes:
        told(command)
    if run.lacks(["goto"]):
        with run.device() as device:
            if play.axes:
                command = _with_play(run, device, command, play)
                told(command)
            visit(device, Posture("goto", config.to_pulses(command)), role="goto")
            counted = [drive.axis.name for drive in device.drives if drive.origin]
            names = unchecked(config, device.frame, counted)
        if names:
            run.say(
                f"NOT CHECKED: whether {', '.join(names)} was moved while without "
                "power. The drive does not tell, and the phone does not see a turn "
                "about the vertical. If in doubt: jaxcal-rig home"
            )
    record = run.postures().get("goto")
    if record is None:
        return EXIT_RECALIBRATE
    reached = np.array(record["measured_deg"])
    run.say(
        f"reached {reached.round(4).tolist()} deg, off by "
        f"{(reached - desired).round(4).tolist()}"
    )
    return EXIT_OK


def unchecked(
    config: RigConfig, frame: Frame | None, told: Sequence[str] = ()
) -> list[str]:
    """Axes of which neither drive nor phone tells that they were moved when off.

    A drive without homed bit and absolute encoder counts from 0 when it is switched on:
    where it was left there, its count says nothing. That of ``told`` axes does, whose
    home is at a count of its own.
    """
    seen = [] if frame is None else unseen(config, frame.zero)
    return [
        axis.name
        for axis in config.axes
        if axis.name in seen
        and not (axis.map.homed or axis.map.absolute_encoder or axis.name in told)
    ]


def _with_play(run: Run, device: Device, command: Array, play: Play) -> Array:
    """(3,) the command with the play put back, once a move from below has taken it up.

    From above, where there is no room below.
    """
    config, direction = run.config, np.ones(3)
    if not config.motion.approach_overshoot_deg:  # else every posture is so reached
        low = [axis.min_deg for axis in config.axes]
        direction = np.where(command - play.run_up < low, -1.0, 1.0)
        begin = command - direction * play.run_up
        move(device, Posture("goto", config.to_pulses(begin)))
    run.say(*play.lines(command, direction))
    return command + play.shift(direction)
