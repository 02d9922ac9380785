"""Play, dead zone and breakaway of one axis.

First the play: PAIRS differences of one place reached from either side, away from where
a dead zone may be. Then the dead zone: of its two sides, reached from below, so that
the play shifts all alike. Then the breakaway: steps from rest, on in the direction in
which the axis came. Ways are degrees of its commands from where it stood, upwards.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import special

from rig.command_run import Run
from rig.core.device import Device, Posture
from rig.core.motion import move
from rig.core.proof import ALLOWED_DEG
from rig.faults import MotionFault, Refused
from rig.prove.axis_check import Stand, stand_at
from rig.prove.axis_moves import ROOM_DEG, SEEN_DEG
from rig.prove.steps import Site, number_of
from rig.readings.geometry import Array

LEVEL = 0.95
PAIRS = 8  # of readings, of the play and of the dead zone
MOST_DEG = 1.5  # of play
FAR_DEG = 1.5 * MOST_DEG  # of a move after which play and friction are taken up
ZONE_DEG = 0.8  # of the dead zone at most
CENTRE_DEG = 0.2  # of it from where the axis stood, at most
REACH_DEG = 0.5 * ZONE_DEG + CENTRE_DEG + 0.2  # either way, to be past the zone
BASE_DEG = FAR_DEG + REACH_DEG + MOST_DEG / 2.0  # where the play is measured
STEPS = 64  # of a breakaway; its threshold is looked for under so many
STEP_DEG = 0.01  # or the next whole number of pulses
ENOUGH_DEG = 0.02  # width of the breakaway's intervals
OVERSHOOT_DEG = 0.1  # by which a step may exceed the threshold
RISK = 0.05  # that it exceeds it by more
MOST_STEPS = 40
LEAST_SIGMA_DEG = 0.002  # of a reading: finer is not believed
OUTLIERS = 1e-3  # share of tests from rest that carry no information


class Estimate(NamedTuple):
    """A mean and an interval, degrees."""

    mean: float
    low: float
    high: float


class Breakaway:
    """Two thresholds, up and down, by tests from rest."""

    def __init__(
        self, cell_deg: float, cells: int, sigma_deg: float, spread_deg: float
    ) -> None:
        """A uniform belief of ``cells`` of this size for each direction; standard
        deviations ``sigma_deg`` of the difference of the readings before and after a
        step, ``spread_deg`` of a threshold from one test to the next."""
        self.centres = (np.arange(cells) + 0.5) * cell_deg
        self.edges = np.arange(cells + 1) * cell_deg
        self.steps = np.arange(1, cells) * cell_deg  # (S,) that may be tried
        self.weights = np.full((2, cells), 1.0 / cells)  # up, down
        yields = special.ndtr((self.steps[:, None] - self.centres) / spread_deg)
        misread = special.ndtr(-self.steps / (2.0 * sigma_deg))[:, None]
        moved = misread + (1.0 - 2.0 * misread) * yields
        # (S, cells) probability that a step is seen to move the joint.
        self.moved = OUTLIERS / 2.0 + (1.0 - OUTLIERS) * moved

    def propose(self, limit_deg: float, risk: float) -> tuple[int, int]:
        """Direction, 0 up or 1 down, and number of the step that tells most, of those
        whose probability to exceed the threshold by more than ``limit_deg`` is at most
        ``risk``; where there is none, of the least risky."""
        past = self.steps[:, None] - self.centres > limit_deg
        risks = self.weights @ past.T  # (2, S)
        chances = self.weights @ self.moved.T
        unsure = self.weights @ _entropy(self.moved).T
        gains = _entropy(chances) - unsure
        safe = risks <= max(risk, risks.min() + 1e-6)
        direction, number = np.unravel_index(
            np.where(safe, gains, -np.inf).argmax(), gains.shape
        )
        return int(direction), int(number)

    def saw(self, direction: int, number: int, moved: bool) -> None:
        """A step in a direction moved the joint, or did not."""
        told = self.moved[number] if moved else 1.0 - self.moved[number]
        self.weights[direction] *= told
        self.weights[direction] /= self.weights[direction].sum()

    def estimate(self, direction: int, level: float) -> Estimate:
        """Mean and equal-tailed interval of a threshold, uniform within each cell."""
        mass = self.weights[direction]
        below = np.concatenate([[0.0], np.cumsum(mass)])
        low, high = np.interp([0.5 - level / 2, 0.5 + level / 2], below, self.edges)
        return Estimate(float(mass @ self.centres), float(low), float(high))


def _entropy(probability: Array) -> Array:
    return special.entr(probability) + special.entr(1.0 - probability)


def step(site: Site, name: str) -> int:
    """Measure play, dead zone and breakaway of an axis; returns the exit code."""
    axis = number_of(site.config, name)
    site.operator.confirm(
        f"characterise: {name} will move up to {BASE_DEG + FAR_DEG:.2f} "
        f"{site.config.axes[axis].unit_name} from its present position, many times. "
        "Keep out of the device's reach",
        "characterise",
    )
    return site.run(
        "characterise", lambda run, device: characterise(run, device, axis),
        again=f"characterise {name}",
    )  # fmt: skip


class Probe:
    """The axis, where it began, and what its readings mean once that is known."""

    def __init__(self, run: Run, device: Device, axis: int) -> None:
        self.run, self.device = run, device
        self.geometry = device.geometry
        self.axis, self.name = axis, run.config.axis_names[axis]
        self.scale = run.config.axes[axis]
        self.start = device.positions()
        self.here_deg = here = self.scale.to_deg(self.start[axis])
        low, high = self.scale.min_deg, self.scale.max_deg
        up, down = BASE_DEG + FAR_DEG, REACH_DEG + FAR_DEG
        if here + up > high - ROOM_DEG or here - down < low + ROOM_DEG:
            raise Refused(
                f"{self.name} is at {here:.2f} deg, between its limits {low:g} and "
                f"{high:g}; {up:g} deg of room upwards and {down:g} deg downwards are "
                f"needed. Move it: jaxcal-rig setup jog {self.name} DEG"
            )
        self.count = 0  # measurements
        self._base = device.attitude()  # (3, 3) that readings are from
        self._line, self._rate = np.zeros(1), 1.0
        device.proof.stay_near(self._base, max(ALLOWED_DEG, 2.0 * up))

    def stand(self, label: str, *ways_deg: float) -> Stand:
        """Go the ways one after the other, and measure at the last."""
        *before, last = ways_deg
        for way in before:
            self.run.signals.check_pause()
            move(self.device, self.at(way, label))
        self.count += 1
        return stand_at(self.run, self.device, self.at(last, label))

    def at(self, way_deg: float, label: str = "back") -> Posture:
        """The axis this far from where it began, the others there."""
        target = list(self.start)
        target[self.axis] += self.scale.to_pulses(way_deg)
        return Posture(label, tuple(target))

    def way(self, found: Stand) -> float:
        """Degrees commanded from where the axis stood."""
        return self.scale.to_deg(found.pulses[self.axis] - self.start[self.axis])

    def read(self, found: Stand) -> float:
        """Commanded degrees along the axis, by the phone."""
        way = self.geometry.way(self._base, found.attitude)
        return float(way @ self._line / self._rate)

    def off(self, label: str, *ways_deg: float) -> float:
        """Reading less command at the last of the ways, degrees of the commands."""
        found = self.stand(f"{self.name}:{label}", *ways_deg)
        return self.read(found) - self.way(found)

    def play(self) -> tuple[Estimate, float]:
        """The play, and the noise of a reading: first how far and about what the axis
        turns the phone, from two moves of one length in one direction each."""
        at, far = BASE_DEG, FAR_DEG
        up = [self.stand("up", at - far, at), self.stand("top", at + far)]
        down = [self.stand("down", at), self.stand("bottom", at - far)]
        self._base = self.geometry.mean([up[0].attitude, down[0].attitude])
        turns = [self.geometry.way(self._base, s.attitude) for s in [*up, *down]]
        deg = (self.way(up[1]) - self.way(up[0]) + self.way(down[0])) / 2.0
        deg -= self.way(down[1]) / 2.0
        rate = (turns[1] - turns[0] + turns[2] - turns[3]) / 2.0 / deg
        self._rate = float(np.linalg.norm(rate))
        self._line = rate / self._rate
        if self._rate * deg < SEEN_DEG:
            raise MotionFault(
                f"{self.name} was moved by {deg:g} and {self.geometry.told} "
                f"{self._rate * deg:.3f} {self.geometry.unit}. Check the axes first: "
                "jaxcal-rig setup axes"
            )
        first = self.read(down[0]) - self.read(up[0])
        if first > 0.9 * MOST_DEG:
            raise self.too_much("play", first, MOST_DEG)
        noise = max(stand.std_deg / stand.samples**0.5 for stand in [*up, *down])
        sigma = max(noise / self._rate, LEAST_SIGMA_DEG)
        values = [
            self.off(f"down:{number}", at + far, at)
            - self.off(f"up:{number}", at - far, at)
            for number in range(PAIRS)
        ]
        return _mean(values, sigma), sigma

    def zone(self, play: float, sigma: float) -> Estimate:
        """The dead zone's width; the play, taken up from below, is put back."""
        above, below = play / 2.0 + REACH_DEG, play / 2.0 - REACH_DEG
        values = [
            self.off(f"below:{number}", below - FAR_DEG, below)
            - self.off(f"above:{number}", above - FAR_DEG, above)
            for number in range(PAIRS)
        ]
        width = _mean(values, sigma)
        if width.high > 0.98 * ZONE_DEG:
            raise self.too_much("dead zone", width.mean, ZONE_DEG)
        return width

    def breakaway(self, sigma: float) -> tuple[Estimate, Estimate]:
        """Steps up and down that the joint does not answer."""
        per_deg = abs(self.scale.pulses_per_deg)
        least = math.ceil(STEP_DEG * per_deg) / per_deg
        belief = Breakaway(least, STEPS, 2.0**0.5 * sigma, least / 2.5)
        for count in range(1, MOST_STEPS + 2):
            up, down = (belief.estimate(side, LEVEL) for side in (0, 1))
            widest = max(up.high - up.low, down.high - down.low)
            if count > MOST_STEPS or widest <= ENOUGH_DEG:
                break
            side, number = belief.propose(OVERSHOOT_DEG, RISK)
            step, direction = float(belief.steps[number]), 1.0 - 2.0 * side
            label = f"{self.name}:up:{count}"
            before = self.stand(label, BASE_DEG - direction * FAR_DEG, BASE_DEG)
            after = self.stand(f"{label}:on", BASE_DEG + direction * step)
            way = (self.read(after) - self.read(before)) * direction
            belief.saw(side, number, way > step / 2.0)
        for yields in (up, down):
            if yields.high > (STEPS - 0.5) * least:
                raise self.too_much("breakaway", yields.mean, STEPS * least)
        return up, down

    def too_much(self, what: str, deg: float, most: float) -> MotionFault:
        """What says that more was found than is looked for."""
        return MotionFault(
            f"{self.name} has {deg:.2f} deg of {what}; the search ends at {most:.3g} "
            "deg. Check for a loose coupling, or a joint that binds"
        )


def characterise(run: Run, device: Device, axis: int) -> None:
    """Measure an axis, say what is found and journal it, in degrees of its commands.

    Refused where it stands too near to a limit, before it moves; MotionFault where it
    does not turn the phone, or has more than is looked for.
    """
    probe = Probe(run, device, axis)
    play, sigma = probe.play()
    zone = probe.zone(play.mean, sigma)
    up, down = probe.breakaway(sigma)
    move(device, probe.at(0.0))
    told = {
        "play": play, "dead zone": zone, "breakaway up": up, "breakaway down": down
    }  # fmt: skip
    for name, estimate in told.items():
        run.say(
            f"{probe.name}: {name} {estimate.mean:.4f} deg of its commands, "
            f"{LEVEL:.0%} interval {estimate.low:.4f}..{estimate.high:.4f}"
        )
    run.say(
        f"from {probe.count} measurements. If the backlash exceeds the accuracy you "
        "need, set motion.approach_overshoot_deg above it, and calibrate"
    )
    run.emit(
        "characterised", sync=True, axis=probe.name, level=LEVEL,
        backlash_deg=_kept(play), dead_zone_deg=_kept(zone),
        dead_zone_at_deg=round(probe.here_deg, 5),  # give or take CENTRE_DEG
        breakaway_deg=[_kept(up), _kept(down)], measurements=probe.count,
    )  # fmt: skip


def _kept(found: Estimate) -> dict[str, float]:
    each = {"value": found.mean, "low": found.low, "high": found.high}
    return {name: round(value, 5) for name, value in each.items()}


def _mean(values: list[float], sigma: float) -> Estimate:
    """Mean difference of two readings, each with at least this standard deviation."""
    spread = max(2.0**0.5 * sigma, float(np.std(values, ddof=1))) / len(values) ** 0.5
    half = float(special.stdtrit(len(values) - 1, 0.5 + LEVEL / 2)) * spread
    mean = max(0.0, float(np.mean(values)))
    return Estimate(mean, max(0.0, mean - half), mean + half)
