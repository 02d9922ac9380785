"""What a simulated device is: what a calibration should find, and what disturbs it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from rig.config import RigConfig
from rig.readings.geometry import Array
from rig_workbench.model import model_of


@dataclasses.dataclass(frozen=True)
class Truth:
    """The defaults are the set values of the paper's Table 1 (pitch, yaw, roll) with a
    little cross-coupling; ``of_axes`` has those of other numbers."""

    matrix: tuple[tuple[float, ...], ...] = (
        (0.43, 0.012, -0.008),
        (-0.010, 0.71, 0.015),
        (0.006, -0.014, 0.87),
    )
    bias: tuple[float, ...] = (3.1, -5.8, 2.41)  # degrees
    noise_deg: float = 0.02  # white, each reading
    backlash_deg: float = 0.0  # play of each joint
    breakaway_deg: float = 0.0  # of its drive, until a joint at rest yields
    dead_zone_deg: float = 0.0  # of each joint, about where it stands at the start
    dead_centre_deg: float = 0.0  # of the zone, away from there
    drift_deg_per_min: float = 0.0  # of the phone's heading
    heading_deg: float = 170.0  # of the base in the phone's world
    parameters: tuple[float, ...] = ()  # of the device's model; none: as designed
    seed: int = 0
    # What is wired, set or lost otherwise than the configuration says:
    reversed: tuple[bool, ...] = (False, False, False)  # turns the other way
    swapped: tuple[int, ...] = (0, 1, 2)  # joint i is turned by drive swapped[i]
    drive_pulses_per_rev: tuple[int, ...] | None = None  # None: as configured
    lost_origin_deg: tuple[float, ...] = (0.0, 0.0, 0.0)  # of the counters
    # What real drives do besides what their registers say:
    latency_s: float = 0.0  # of every reply
    enable_delay_s: float = 0.0  # > 0: it starts disabled, and takes so long to enable
    reset_delay_s: float = 0.0  # until an alarm is gone after its reset
    jitter_counts: int = 0  # of the position read while it stands
    idle_watchdog: bool = False  # the comm timeout also acts while it stands

    @classmethod
    def of_axes(cls, count: int, outputs: int | None = None, **more: Any) -> Truth:
        """A truth of ``count`` axes, and of as many outputs unless said otherwise."""
        shape, paper = (outputs or count, count), cls()
        matrix = 0.01 * np.cos(np.arange(shape[0] * count)).reshape(shape)
        matrix += 0.8 * np.eye(*shape)
        least = min(*shape, len(paper.matrix))
        matrix[:least, :least] = np.array(paper.matrix)[:least, :least]
        bias = [*paper.bias, 1.3, -2.2, 0.7][: shape[0]]
        fields = {
            "matrix": tuple(map(tuple, matrix.tolist())),
            "bias": tuple(bias),
            "reversed": (False,) * count,
            "swapped": tuple(range(count)),
            "lost_origin_deg": (0.0,) * count,
        }
        return cls(**fields | more)

    @classmethod
    def of(cls, config: RigConfig, **more: Any) -> Truth:
        """A truth of a configured device."""
        count, model = len(config.axes), model_of(config)
        if model is not None:
            drawn = tuple(model.drawn(int(more.get("seed", 0))).tolist())
            matrix = tuple(map(tuple, np.eye(count).tolist()))
            given = {"matrix": matrix, "bias": (0.0,) * count, "parameters": drawn}
            more = given | more
        return cls.of_axes(count, len(config.output_names), **more)

    @property
    def jig_deg(self) -> Array:
        """(n,) turns of the motors, by axis, at which every joint stands at zero."""
        matrix, bias = np.array(self.matrix), np.array(self.bias)
        joints = np.linalg.lstsq(matrix, -bias, rcond=None)[0]
        motors = np.empty(len(joints))
        motors[list(self.swapped)] = joints
        return motors * self.signs

    @property
    def signs(self) -> Array:
        """(n,) -1 where a motor turns the other way."""
        return np.where(self.reversed, -1.0, 1.0)


REALISTIC: dict[str, Any] = {
    "latency_s": 0.004,
    "enable_delay_s": 0.5,
    "reset_delay_s": 0.3,
    "jitter_counts": 1,
    "idle_watchdog": True,
}


def truth_of(options: dict[str, Any], config: RigConfig) -> Truth:
    """The simulated device that the options of a command line describe; ValueError
    where ``swapped`` or ``reversed`` names no axes of it."""
    names = config.axis_names
    order = list(range(len(names)))
    for key in ("swapped", "reversed"):
        if unknown := set(options[key] or ()) - set(names):
            axis_names = ", ".join(names)
            raise ValueError(f"--{key}: no axis {min(unknown)!r} in {axis_names}")
    if swapped := options["swapped"]:
        if len(set(swapped)) != 2:
            raise ValueError(f"--swapped must name two axes, got {','.join(swapped)}")
        a, b = map(list(names).index, swapped)
        order[a], order[b] = b, a
    degrees = ("noise", "backlash", "breakaway", "dead_zone")
    pulses, turned = options["gearing"], options["reversed"] or ()
    return Truth.of(
        config,
        drift_deg_per_min=options["drift"],
        seed=config.session.seed,
        reversed=tuple(name in turned for name in names),
        swapped=tuple(order),
        drive_pulses_per_rev=pulses and (pulses,) * len(names),
        lost_origin_deg=(options["lost_origin"],) * len(names),
        **{f"{name}_deg": options[name] for name in degrees},
        **(REALISTIC if options["realistic"] else {}),
    )
