"""Is each sensor's calibration of an arm as uncertain as it says?

    python -m benchmarks.arm_sensors [draws]

Arms whose errors are drawn from the default prior, each sensor alone and in pairs, 60
readings of each or more: how many 95 % intervals of the parameters hold the truth.
Then positions of a UR5 whose errors are 0.2 to 10 times the tolerances: the error
elsewhere of a fit with the right tolerances over that with sizes from the readings.
"""

from __future__ import annotations

import pathlib
import sys
import warnings

import numpy as np
from numpy.typing import NDArray

import jaxcal
from jaxcal.models import (
    Board,
    Distance,
    Gravity,
    Plane,
    Pose,
    Position,
    Sensor,
    SerialChain,
    Several,
    Socket,
)

Array = NDArray[np.float64]

EXAMPLES = pathlib.Path(__file__).parents[1] / "examples"
READINGS = 60  # of each sensor: 20 postures of three readings
NEAR = {  # where sockets, planes and anchors stand, in metres
    "socket": [[0.4, 0.1, 0.3], [0.4, 0.15, 0.3]],
    "plane": [[0.0, 0.0, 1.0, 0.2], [1.0, 0.0, 0.0, 0.5], [0.0, 1.0, 0.0, 0.4]],
    "distance": [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.3, 0.0], [-0.8, -0.8, 0.0, 0.0]],
}
ALONE: dict[str, Sensor] = {
    "position": Position(),
    "pose": Pose(),
    "socket": Socket(2, NEAR["socket"], distances=[(0, 1, 0.05, 1e-4)]),
    "plane": Plane(3, NEAR["plane"]),
    "distance": Distance(3, NEAR["distance"]),
    "gravity": Gravity(),
    "camera": Board("camera", np.eye(4)),
    "board": Board("board", np.eye(4)),
}
PAIRS = [("position", "gravity"), ("socket", "gravity"), ("plane", "distance")]


def arm(joints: int, sensor: Sensor) -> SerialChain:
    """A UR5 or a Panda, in metres."""
    if joints == 7:
        path = EXAMPLES / "contacts" / "panda.urdf"
        return SerialChain.from_urdf(path, tip="ball_link", sensor=sensor)
    table = np.loadtxt(EXAMPLES / "ur5" / "dh.csv", delimiter=",", skiprows=1)
    table[:, [0, 2]] *= 1e-3
    return SerialChain.from_dh(table, tool=(0.0, 0.0, 0.031), sensor=sensor)


def commands(model: SerialChain, sensor: Sensor, rng: np.random.Generator) -> Array:
    """(N, n) random postures, the columns of the sensor after them."""
    low, high = np.clip(model.limits, -150.0, 150.0).T
    count = max(20, READINGS // len(sensor.outputs))
    joints = rng.uniform(low, high, (count, model.num_joints))
    if isinstance(sensor, Board):  # as the nominal arm would see it
        blank = np.hstack([joints, np.zeros((count, 6))])
        return np.hstack([joints, model.measured_with(sensor).predict(blank)])
    which = np.arange(count)[:, None] % getattr(sensor, "count", 1)
    return np.hstack([joints, which[:, : len(sensor.inputs)]])


def covered(joints: int, names: tuple[str, ...], draws: int) -> tuple[float, float]:
    """Share of intervals that hold the truth, and its standard error by draws."""
    sensors = [ALONE[name] for name in names]
    alone = len(sensors) == 1
    model = arm(joints, sensors[0] if alone else Several(tuple(sensors)))
    prior = model.default_prior()
    std = np.asarray(prior.std, dtype=np.float64)
    free = np.array([name not in prior.fixed for name in model.names])
    std = np.where(np.isfinite(std), std, 0.0)  # things stand where they are said to
    noise = np.asarray(model.default_noise().std)
    shares = []
    for draw in range(draws):
        rng = np.random.default_rng(draw)
        truth = model.nominal + free * std * rng.normal(size=len(std))
        rows = [commands(model, one, rng) for one in sensors]
        table = rows[0]
        if not alone:
            zeros = [
                np.zeros((len(each), len(one.outputs)))
                for each, one in zip(rows, sensors, strict=True)
            ]
            table, _ = model.together(*zip(rows, zeros, strict=True))
        clean = model.predict(table, truth)
        there = (clean != 0.0) | (model.predict(table) != 0.0)  # of all its readings
        measured = clean + there * noise * rng.normal(size=clean.shape)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            found = jaxcal.identify(table, measured, model=model)
        low, high = found.confidence_intervals().T
        inside = (low <= truth) & (truth <= high)
        shares.append(inside[free].mean())
    return float(np.mean(shares)), float(np.std(shares) / np.sqrt(draws))


def sized(factor: float, count: int, draws: int) -> float:
    """Mean error elsewhere with the right prior over that with a sized one."""
    model = arm(6, Position())
    prior = model.default_prior()
    std = np.asarray(prior.std, dtype=np.float64)
    std[: model.table.size] *= factor
    noise = float(np.asarray(model.default_noise().std)[0])
    errors: dict[str, list[float]] = {"right": [], "sized": []}
    for draw in range(draws):
        rng = np.random.default_rng(draw)
        truth = model.nominal + std * rng.normal(size=len(std))
        joints, elsewhere = (rng.uniform(-120.0, 120.0, (n, 6)) for n in (count, 100))
        measured = model.predict(joints, truth) + noise * rng.normal(size=(count, 3))
        for name, known in (("right", jaxcal.Prior(std)), ("sized", prior)):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                found = jaxcal.identify(joints, measured, model=model, prior=known)
            off = found.predict(elsewhere) - model.predict(elsewhere, truth)
            errors[name].append(float(np.linalg.norm(off, axis=1).mean()))
    return float(np.mean(errors["right"]) / np.mean(errors["sized"]))


def main(draws: int) -> None:
    """Print the table."""
    print(f"| sensor | 6 axes | 7 axes |  ({draws} draws)\n| --- | --- | --- |")
    for names in [*((name,) for name in ALONE), *PAIRS]:
        cells = [covered(joints, names, draws) for joints in (6, 7)]
        row = " | ".join(f"{share:.1%} ({error:.1%})" for share, error in cells)
        print(f"| {' and '.join(names)} | {row} |", flush=True)
    counts = (8, 12, 20)
    print("| errors | " + " | ".join(map(str, counts)) + " poses |")
    print("| --- " * (1 + len(counts)) + "|")
    for factor in (0.2, 1.0, 3.0, 10.0):
        row = " | ".join(f"{sized(factor, count, draws):.0%}" for count in counts)
        print(f"| {factor:g} times | {row} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
