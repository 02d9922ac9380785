"""Is each sensor's calibration of an arm as uncertain as it says? Ten tables more.

    python -m benchmarks.arm_sensors [draws] [NAMES OF TABLES]

``intervals``: arms whose errors are drawn from the default prior, each sensor alone and
in pairs, 60 readings of each or more: how many 95 % intervals hold the truth.
``sizes``: positions of a UR5 whose errors are 0.2 to 10 times the tolerances: the error
elsewhere of a fit with the right tolerances over that with sizes from the readings,
and over that of ``identify`` as it comes, with harmonics.
``misfit``: positions of arms that no table explains (cables, eccentric gears): the
error elsewhere with and without harmonics of the joints. ``trial``: the simulated ones
fitted as a real one was. ``chance``: of a linear WAM whose misfit and sizes the choice
knows exactly, how many random choices are better on one arm. ``servos``: what contacts
of a servo arm determine, by where the sockets stand. ``checks``: what a few chosen
postures and random ones can tell of a drift. ``slips``: how many slips of a joint 6 and
24 readings show, and could show at best. ``contacts``: of real arms, trained on one
place and judged at the others: 12 and 16 contacts that are random or chosen, and all;
likewise with stiff joints, stated tolerances and noise (of the choice and the fit); and
what is expected of those chosen, and at best (chosen for the very postures they are
judged at), of a model without any error, with the noise and sizes that all contacts of
the place show; then trained on two places and on three. ``distances``: how far apart
sockets of other places are found, which were printed 50 mm (0.1) apart. ``files``:
what files without compliance have there, as they are written and made otherwise.
"""

from __future__ import annotations

import dataclasses
import pathlib
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats
from scipy.spatial.transform import Rotation

import jaxcal
from jaxcal.arms.written import for_file
from jaxcal.calibration.fit import linearised
from jaxcal.calibration.fit_model import fitted_again
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

PLAY = 2e-4  # m, of a ball in its socket
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
CAMERA = (1280.0, 960.0, 900.0, 900.0, 640.0, 480.0)  # pixels
CORNERS = Board(
    "camera",
    np.block([[np.eye(3), np.array([[-0.55], [0.1], [0.0]])], [np.eye(4)[3:]]]),
    [[0.03 * x, 0.03 * y, 0.0] for x in range(6) for y in range(5)],
    CAMERA[2:],
)
PAIRS = [("position", "socket"), ("position", "gravity"), ("socket", "gravity"),
         ("plane", "distance")]  # fmt: skip


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


def sized(factor: float, count: int, draws: int) -> tuple[float, float]:
    """Mean error elsewhere with the right prior over that sized, and by default."""
    model = arm(6, Position())
    prior = model.default_prior()
    std = np.asarray(prior.std, dtype=np.float64)
    std[: model.table.size] *= factor
    noise = float(np.asarray(model.default_noise().std)[0])
    priors = {"right": jaxcal.Prior(std), "sized": prior, "default": None}
    errors: dict[str, list[float]] = {name: [] for name in priors}
    for draw in range(draws):
        rng = np.random.default_rng(draw)
        truth = model.nominal + std * rng.normal(size=len(std))
        joints, elsewhere = (rng.uniform(-120.0, 120.0, (n, 6)) for n in (count, 100))
        measured = model.predict(joints, truth) + noise * rng.normal(size=(count, 3))
        for name, known in priors.items():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                found = jaxcal.identify(joints, measured, model=model, prior=known)
            off = found.predict(elsewhere) - model.predict(elsewhere, truth)
            errors[name].append(float(np.linalg.norm(off, axis=1).mean()))
    right, *others = (float(np.mean(each)) for each in errors.values())
    return right / others[0], right / others[1]


WAM = [  # a cable-driven arm, mm
    (0, -90, 0, 0),
    (0, 90, 0, 0),
    (45, -90, 550, 0),
    (-45, 90, 0, 0),
    (0, -90, 300, 0),
    (0, 90, 0, 0),
    (0, 0, 60, 0),
]
SPAN = (150.0, 100.0, 150.0, 120.0, 120.0, 80.0, 150.0)


def table_of(joints: int, **options: object) -> SerialChain:
    """A UR5 or a WAM in mm."""
    if joints == 7:
        return SerialChain.from_dh(WAM, tool=(0.0, 0.0, 60.0), **options)
    table = np.loadtxt(EXAMPLES / "ur5" / "dh.csv", delimiter=",", skiprows=1)
    return SerialChain.from_dh(table, tool=(0.0, 0.0, 31.0), **options)


def cable_driven(
    joints: int,
    draw: int,
    *,
    errors: float = 1.0,
    drums: float = 0.0,
    smooth: float = 0.0,
    rough: float = 0.0,
    paths: bool = True,
) -> tuple[Array, Array]:
    """Joints (400, n) and positions of an arm that no table explains.

    Its table is off by ``errors`` tolerances, base and tool by a tenth of one. Beyond
    that, drums are eccentric (degrees), and in x, y, z (mm) it is off smoothly with the
    joints, as cables stretch, and anyhow, as friction holds them. Postures are along
    ``paths`` between 16, as a robot records them, or anywhere.
    """
    rng = np.random.default_rng(100 + draw)
    arm = table_of(joints, harmonics=range(1, joints + 1))
    std = np.array(arm.default_prior().std, dtype=np.float64)
    std[: arm.table.size] *= errors
    std[arm.table.size :] *= 0.1
    std[-arm.waves.size :] = drums
    truth = arm.nominal + std * rng.normal(size=len(std))
    span = np.array(SPAN) if joints == 7 else 120.0
    asked = span * rng.uniform(-1.0, 1.0, (400, joints))
    if paths:
        at = np.linspace(0.0, 15.0, 400)
        asked = [np.interp(at, np.arange(16), each) for each in asked[:16].T]
        asked = rng.permutation(np.stack(asked, axis=1))
    angles = np.radians(asked)
    turns = np.hstack([angles, 2.0 * angles])
    waves = np.hstack([np.sin(turns), np.cos(turns)]) / np.sqrt(2.0 * joints)
    off = smooth * waves @ rng.normal(size=(4 * joints, 3))
    off += np.hypot(rough, 0.1) * rng.normal(size=off.shape)
    return asked, arm.predict(asked, truth) + off


def tracked(draw: int) -> tuple[Array, Array]:
    """400 of the poses of a real UR5 and its measured positions."""
    path = EXAMPLES / "ur5" / "ur5_grid_1000.csv"
    data = np.genfromtxt(path, delimiter=",", names=True)
    joints = np.stack([data[f"joint_{i}"] for i in range(1, 7)], axis=1)
    places = [data[f"{axis}_t"] + data[f"{axis}_dif"] for axis in "xyz"]
    rows = np.random.default_rng(draw).permutation(1000)[:400]
    return joints[rows], np.stack(places, axis=1)[rows]


Made = Callable[[int], tuple[Array, Array]]
MISFIT: dict[str, tuple[int, Made]] = {
    "UR5, real": (6, tracked),
    "UR5, no misfit": (6, partial(cable_driven, 6, paths=False)),
    "UR5, cables": (6, partial(cable_driven, 6, errors=0.8, smooth=1.0, rough=1.0)),
    "WAM, cables": (7, partial(cable_driven, 7, errors=0.7, smooth=1.0, rough=1.0)),
    "WAM, eccentric drums": (
        7,
        partial(cable_driven, 7, errors=0.3, drums=0.1, rough=1.0),
    ),
    "UR5, cables, anywhere": (
        6,
        partial(cable_driven, 6, errors=0.5, smooth=1.0, rough=1.0, paths=False),
    ),
}


def misfit(draws: int) -> None:
    """Chosen of 150 poses and judged at 250, without and with harmonics."""
    print("| arm | K | without | with harmonics | gain | random ones that are better |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, (joints, make) in MISFIT.items():
        model = table_of(joints)
        known = model.default_prior()  # a prior that is given has none
        for count in (8, 20):
            without = _errors(model, count, make, draws, 0, prior=known)[:, 0]
            errors = _errors(model, count, make, draws, 6)
            gain = np.log(without / errors[:, 0])
            better = (errors[:, 1:] < errors[:, :1]).mean()
            print(
                f"| {name} | {count} | {without.mean():.3g} | "
                f"{errors[:, 0].mean():.3g} | {gain.mean():.0%} +- "
                f"{gain.std() / np.sqrt(draws):.0%} | {better:.0%} |",
                flush=True,
            )


def trial(draws: int) -> None:
    """Cable-driven arms fitted as one that is kept back was: are they like it?

    That arm, chosen and random, K = 8: 4.35 and 7.55 mm with noise of 0.1 mm, 3.25 and
    4.11 with 1 mm, 3.3 with a noise from the residuals, and 33 % of random choices
    better; then 2.48 and 22 % with K = 20.
    """
    print("| arm | K | noise, mm | chosen | random | random ones that are better |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name in ("WAM, cables", "WAM, eccentric drums"):
        joints, make = MISFIT[name]
        model = table_of(joints)
        known = dataclasses.replace(model.default_prior(), by_data=False)
        for count in (8, 20):
            for std in (0.1, 1.0, None):
                plain = {"prior": known, "noise": std and jaxcal.Noise(std)}
                loss = "gaussian" if std else None
                errors = _errors(model, count, make, draws, 6, loss, **plain)
                better = (errors[:, 1:] < errors[:, :1]).mean()
                print(
                    f"| {name} | {count} | {std or 'residuals'} | "
                    f"{errors[:, 0].mean():.3g} | {errors[:, 1:].mean():.3g} | "
                    f"{better:.0%} |",
                    flush=True,
                )


def _errors(
    model: SerialChain,
    count: int,
    make: Made,
    draws: int,
    random: int,
    loss: str | None = None,
    **known: object,
) -> Array:
    """(draws, 1 + random) mean errors at 250 poses of a chosen set and random ones."""
    result = np.zeros((draws, 1 + random))
    for draw in range(draws):
        joints, reached = make(draw)
        rng = np.random.default_rng(draw)
        best = jaxcal.select(joints[:150], count, "exchange", model=model, **known)
        sets = [rng.choice(150, count, replace=False) for _ in range(random)]
        for at, rows in enumerate([best.indices, *sets]):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                found = jaxcal.identify(
                    joints[rows], reached[rows], model=model, loss=loss, **known
                )
            off = found.predict(joints[150:]) - reached[150:]
            result[draw, at] = np.linalg.norm(off, axis=1).mean()
    return result


SERVO_ARM = [  # five axes, of the size of an SO-101, metres
    (0.03, 90, 0.12, 0),
    (0.116, 0, 0, 0),
    (0.135, 0, 0, 0),
    (0, 90, 0, 90),
    (0, 0, 0.06, 0),
]
SOCKETS = {  # where they stand, metres
    "two, 50 mm apart": [[0.22, 0.025, 0.05], [0.22, -0.025, 0.05]],
    "two, 300 mm apart": [[0.2, 0.15, 0.05], [0.2, -0.15, 0.05]],
    "two, one 200 mm higher": [[0.2, 0.1, 0.05], [0.2, -0.1, 0.25]],
    "four, far and near, high and low": [
        [0.28, 0.1, 0.05], [0.28, -0.1, 0.2], [0.15, 0.1, 0.2], [0.15, -0.1, 0.05],
    ],
}  # fmt: skip


def servos(draws: int) -> None:
    """What contacts determine of a servo arm with play, by where the sockets stand."""
    print("| sockets | error anywhere, mm: uncalibrated, calibrated | stated | good |")
    print("| --- | --- | --- | --- |")
    for name, places in SOCKETS.items():
        rows = [_of_servos(np.array(places), draw) for draw in range(draws)]
        before, after, stated, good = np.mean(rows, axis=0)
        cells = f"{before:.1f}, {after:.1f} | {stated:.1f} | {good:.0%}"
        print(f"| {name} | {cells} |", flush=True)


def _of_servos(places: Array, draw: int) -> tuple[float, float, float, float]:
    """Errors of the tip anywhere, moved as a whole to fit, and the stated deviation."""
    count = len(places)
    apart = [
        (0, i, float(np.linalg.norm(places[i] - places[0])), 2e-4)
        for i in range(1, count)
    ]
    model = SerialChain.from_dh(
        SERVO_ARM,
        tool=(0.02, 0.0, 0.1),
        sensor=Socket(count, places, distances=apart),
        limits=[(-110.0, 110.0)] * 4 + [(-160.0, 160.0)],
        compliance=(),
    )
    rng = np.random.default_rng(draw)
    truth = model.nominal.copy()
    names = np.array(model.names)
    zeros = np.char.startswith(names, "theta")
    truth[zeros] += 2.0 * rng.normal(size=zeros.sum())  # degrees
    std = np.asarray(model.default_prior().std)[: model.table.size]
    lengths = np.array(model.units)[: model.table.size] == "length"
    truth[: len(std)] += 3.0 * lengths * std * rng.normal(size=len(std))
    offered = model.postures(100, seed=draw)
    plan = offered[jaxcal.select(offered, 24, "exchange", model=model).indices]
    play = np.zeros(plan.shape)
    play[:, :5] = rng.uniform(-0.3, 0.3, (24, 5))
    noise = model.noise_with_play(0.6)
    off = model.predict(plan + play, truth)
    low, high = model.limits.T
    anywhere = rng.uniform(low, high, (200, 5))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = jaxcal.identify(plan, off, model=model, noise=noise)
    wanted = model.calibrated(truth).predict(anywhere)
    errors = []
    for theta in (model.nominal, found.parameters):
        points = model.calibrated(theta).predict(anywhere)
        turn, _ = Rotation.align_vectors(
            wanted - wanted.mean(0), points - points.mean(0)
        )
        left = turn.apply(points - points.mean(0)) + wanted.mean(0) - wanted
        errors.append(1e3 * float(np.linalg.norm(left, axis=1).mean()))
    told = found.verdict
    return errors[0], errors[1], 1e3 * float(told.anywhere), float(told.good)


def chance(draws: int) -> None:
    """What the best choice gains on a WAM that is as the choice believes, linear.

    Expected errors at 250 other poses; on one arm, how many random choices come out
    better; how many random poses are as good, expected.
    """
    print(
        "| poses | misfit | K | expected, of random | random better | as many random |"
    )
    print("| --- | --- | --- | --- | --- | --- |")
    for paths, size in ((True, 0.3), (True, 2.0), (False, 0.3), (False, 2.0)):
        for count in (8, 20, 40):
            found = [_by_chance(paths, size, count, draw) for draw in range(draws)]
            ratio, better, same = np.mean(found, axis=0)
            print(
                f"| {'along paths' if paths else 'anywhere'} | {size:g} mm | {count} | "
                f"{ratio:.2f} | {better:.0%} | {same:.0f} |",
                flush=True,
            )


def _by_chance(
    paths: bool, size: float, count: int, draw: int
) -> tuple[float, float, float]:
    """Expected error over that of random ones, share of these that are better, K."""
    model = table_of(7)
    joints, _ = cable_driven(7, draw, paths=paths)
    std = np.array(model.default_prior().std, dtype=np.float64)
    std[: model.table.size] *= 0.7
    std[model.table.size :] *= 0.1
    angles = np.radians(joints)
    turns = np.hstack([angles, 2.0 * angles])
    waves = size * np.hstack([np.sin(turns), np.cos(turns)]) / np.sqrt(14.0)
    smooth = np.einsum("nk,ab->nakb", waves, np.eye(3)).reshape(len(joints), 3, -1)
    slopes = np.concatenate([model.jacobian(joints) * std, smooth], axis=-1)
    noise, p = np.hypot(size, 0.1), slopes.shape[-1]
    blocks, region = slopes[:150] / noise, slopes[150:]
    design = jaxcal.Design.from_blocks(blocks, prior=np.eye(p))
    best = design.select(count, jaxcal.I(region), "exchange").indices
    rng = np.random.default_rng(draw)

    def spread(rows: Array) -> tuple[Array, float]:
        gram = np.eye(p) + np.einsum("nqi,nqj->ij", blocks[rows], blocks[rows])
        covariance = np.linalg.inv(gram)
        variance = np.einsum("nqi,ij,nqj->n", region, covariance, region)
        return covariance, float(np.sqrt(variance + 3.0 * noise**2).mean())

    def by_random(k: int) -> float:
        return float(np.mean([spread(rng.permutation(150)[:k])[1] for _ in range(20)]))

    sets = [best, *(rng.permutation(150)[:count] for _ in range(20))]
    spreads = [spread(rows) for rows in sets]
    shares = []
    for _ in range(20):  # arms
        truth = rng.normal(size=p)
        read = slopes @ truth + noise * rng.normal(size=(len(joints), 3))
        errors = []
        for rows, (covariance, _) in zip(sets, spreads, strict=True):
            found = covariance @ (blocks[rows].reshape(-1, p).T @ read[rows].ravel())
            off = region @ found / noise - read[150:]
            errors.append(np.linalg.norm(off, axis=1).mean())
        shares.append(np.mean(np.array(errors[1:]) < errors[0]))
    aim, same = spreads[0][1], count
    while same < 150 and by_random(same) > aim:
        same += max(1, count // 10)
    ratio = aim / np.mean([each[1] for each in spreads[1:]])
    return float(ratio), float(np.mean(shares)), float(same)


def checks(draws: int) -> None:
    """Power against a drift by 0.15 mm, and parameters whose drift could hide."""
    model = table_of(6)
    rng = np.random.default_rng(0)
    std = np.asarray(model.default_prior().std)
    joints = rng.uniform(-120.0, 120.0, (60, 6))
    truth = model.nominal + 0.5 * std * rng.normal(size=len(std))
    measured = model.predict(joints, truth) + 0.05 * rng.normal(size=(60, 3))
    found = jaxcal.identify(joints, measured, model=model, noise_std=0.05)
    offered = rng.uniform(-120.0, 120.0, (200, 6))
    print("| postures | mean power | drifts that could hide |\n| --- | --- | --- |")
    rows = [("chosen", 2), ("chosen", 3), ("chosen", 4), ("random", 3), ("random", 6)]
    for rule, count in rows:
        told = []
        for _ in range(1 if rule == "chosen" else draws):
            at = rng.choice(200, count, replace=False)
            if rule == "chosen":
                at = found.verification(offered, count, tolerance=0.15)
            there = offered[at]
            told.append(found.check(there, found.predict(there), tolerance=0.15))
        power = np.mean([one.power for one in told])
        hidden = np.mean([len(one.unseen) for one in told])
        print(f"| {count} {rule} | {power:.0%} | {hidden:.1f} |", flush=True)


def files(draws: int) -> None:
    """What a file without compliance can say of real arms: mm at the other places.

    As it is written, fitted again without compliance, and by least squares nearest to
    the calibrated arm's tip over all postures, or over those that were measured.
    """
    sys.path.insert(0, str(EXAMPLES))
    import contacts as example

    lines = []
    for name in ("panda_1", "kuka_14"):
        places = example.load(name)
        for trained, (joints, sockets) in places.items():
            rows = np.arange(len(sockets))
            found = example.identify(name, (joints, sockets), rows)
            plain: Any = found.model.writable()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                written = for_file(found)[np.isin(found.names, plain.names)]
                again = fitted_again(found, plain, plain.default_prior())
            low, high = np.clip(plain.limits, -180.0, 180.0).T
            anywhere = np.random.default_rng(0).uniform(low, high, (500, len(low)))
            arms = [found.arm, plain.calibrated(written), again.arm]
            arms += [_nearest(plain, found, at) for at in (anywhere, joints)]
            others = [place for other, place in places.items() if other != trained]
            errors = [[example.consistency(one, at) for at in others] for one in arms]
            lines.append(np.mean(errors, axis=1))
            print(name, trained, lines[-1].round(3), flush=True)
    print("| calibration | file | stiff fit | nearest over all | over the measured |")
    print("| --- | --- | --- | --- | --- |")
    print("| " + " | ".join(f"{mean:.2f}" for mean in np.mean(lines, axis=0)) + " |")


def _nearest(plain: Any, found: Any, postures: Array) -> SerialChain:
    """The stiff arm whose tip is nearest to that of the calibrated one there."""
    tracked = plain.measured_with(Position())
    start = np.array([found.parameters[found.names.index(n)] for n in tracked.names])
    std = np.asarray(plain.default_prior().std)
    size = np.array([std[plain.names.index(name)] for name in tracked.names])
    wanted, unit = found.arm.predict(postures), 1e-4 * np.sqrt(len(postures))

    def off(steps: Array) -> Array:
        here = tracked.predict(postures, start + size * steps)
        return np.concatenate([(here - wanted).ravel() / unit, 1e-3 * steps])

    def slopes(steps: Array) -> Array:
        by = tracked.jacobian(postures, start + size * steps).reshape(-1, len(start))
        return np.vstack([by * size / unit, 1e-3 * np.eye(len(start))])

    steps = optimize.least_squares(off, np.zeros(len(start)), slopes).x
    return tracked.calibrated(start + size * steps)


def slips(draws: int) -> None:
    """How many slips of a joint by 0.05 degrees 6 and 24 chosen readings show.

    Beside it the power of the best test of the six that knows which joint may have
    slipped, of this calibration and of one without any error; and how many checks of
    an arm that did not slip say that it holds.
    """
    print("| sensor | 6 | 24 | at best | of an exact arm | unchanged: holds |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name in ("position", "pose", "socket", "camera", "corners"):
        rows = [_slipped(ALONE.get(name, CORNERS), seed) for seed in range(draws)]
        means = " | ".join(f"{mean:.2f}" for mean in np.mean(rows, axis=0))
        print(f"| {name} | {means} |", flush=True)


def _slipped(sensor: Sensor, seed: int) -> tuple[float, ...]:
    """Shares of the joints' slips: seen by 6, 24, at best, of an exact arm; holds."""
    rng = np.random.default_rng(seed)
    model = arm(6, sensor)
    bent = model.fitting.misfit_model()
    prior = model.default_prior()
    std, free = np.asarray(prior.std), ~np.isin(model.names, prior.fixed)
    truth = bent.nominal.copy()
    free &= np.isfinite(std)
    truth[: len(std)][free] += 0.5 * std[free] * rng.normal(size=free.sum())
    truth[len(std) :] = 0.015 * rng.normal(size=bent.waves.size)  # degrees
    near, camera = NEAR.get(sensor.kind), CAMERA if sensor is CORNERS else None
    made = bent.calibrated(truth, sensor)  # which touches what the arm touches
    offered = rng.permutation(made.postures(60, seed=seed, near=near, camera=camera))
    noise = np.asarray(model.default_noise().std) * np.ones(model.num_outputs)

    def read(rows: Array, theta: Array) -> Array:
        return bent.predict(rows, theta) + noise * rng.normal(size=(len(rows), q))

    q, used = model.num_outputs, offered[:24]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        found = jaxcal.identify(used, read(used, truth), model=model)
    rest = offered[24:]
    few, many = (rest[found.verification(rest, count)] for count in (6, 24))
    holds = found.check(few, read(few, truth)).says == "holds"
    slopes, covariance = linearised(found, few)
    rows = slopes.reshape(6 * q, -1)
    of_noise = np.diag(np.tile(np.asarray(found.noise_std) ** 2, 6))
    shares = []
    for i in range(model.num_joints):
        joint = model.names.index(f"theta{i + 1}")
        if model.names[joint] in prior.fixed:
            continue
        slipped = truth.copy()
        slipped[joint] += 0.05
        told = [found.check(at, read(at, slipped)).says for at in (few, many)]
        shares.append([float(said == "does not hold") for said in told])
        shift = 0.05 * rows[:, joint]
        for spread in (rows @ covariance @ rows.T, 0.0):
            far = np.sqrt(shift @ np.linalg.solve(of_noise + spread, shift))
            power = stats.norm.sf(1.96 - far) + stats.norm.cdf(-1.96 - far)
            shares[-1].append(float(power))
    return *np.mean(shares, axis=0), float(holds)


def intervals(draws: int) -> None:
    """How many of the 95 % intervals hold the truth."""
    print(f"| sensor | 6 axes | 7 axes |  ({draws} draws)\n| --- | --- | --- |")
    for names in [*((name,) for name in ALONE), *PAIRS]:
        cells = [covered(joints, names, draws) for joints in (6, 7)]
        row = " | ".join(f"{share:.1%} ({error:.1%})" for share, error in cells)
        print(f"| {' and '.join(names)} | {row} |", flush=True)


def sizes(draws: int) -> None:
    """What sizes from the readings reach of what the right ones do."""
    counts = (8, 12, 20)
    print("| errors | " + " | ".join(map(str, counts)) + " poses |")
    print("| --- " * (1 + len(counts)) + "|")
    for factor in (0.2, 1.0, 3.0, 10.0):
        pairs = [sized(factor, count, draws) for count in counts]
        row = " | ".join(f"{one:.0%}, {other:.0%}" for one, other in pairs)
        print(f"| {factor:g} times | {row} |", flush=True)


def contacts(draws: int) -> None:
    """Errors at other places: mm, and what a choice could reach at best."""
    sys.path.insert(0, str(EXAMPLES))
    import contacts as example

    print(
        "| arm, trained on | K | mm: random, chosen, all | stiff: random, chosen, all "
        "| over random, expected: chosen, at best |\n| --- | --- | --- | --- | --- |"
    )
    arms = {name: example.load(name) for name in ("panda_1", "kuka_14")}
    for k in (12, 16):
        lines = []
        for name, places in arms.items():
            for trained in places:
                lines.append(_trained(example, name, trained, k, draws))
                _print_contacts(f"{name}, {trained}", k, lines[-1])
        mean = np.mean(lines, axis=0)
        _print_contacts("mean", k, mean)
        for i, label in ((0, "by default"), (3, "stiff")):
            random, chosen, every = mean[i : i + 3]
            print(f"{label}, {k}: {chosen / every:.2f} of all, ", end="")
            print(f"{chosen / random:.2f} of random", flush=True)
    print("\n| arm | judged at | trained on the other places, mm | on all |")
    print("| --- | --- | --- | --- |")
    for name, places in arms.items():
        for judged, place in places.items():
            others = [each for at, each in places.items() if at != judged]
            both = [
                _together(example, name, kept) for kept in (others, places.values())
            ]
            cells = " | ".join(f"{example.consistency(on, place):.2f}" for on in both)
            print(f"| {name} | {judged} | {cells} |", flush=True)


def _print_contacts(label: str, k: int, values: Sequence[float]) -> None:
    cells = [f"{each:.2f}" for each in values]
    groups = (", ".join(cells[i:j]) for i, j in ((0, 3), (3, 6), (6, 8)))
    print(f"| {label} | {k} | {' | '.join(groups)} |", flush=True)


def _together(example: ModuleType, name: str, places: Iterable[Any]) -> SerialChain:
    """The arm fitted to all contacts of several places, two sockets each."""
    tables = [
        np.column_stack([joints, sockets + 2 * i])
        for i, (joints, sockets) in enumerate(places)
    ]
    apart = [(2 * i, 2 * i + 1, 0.05, 1e-4) for i in range(len(tables))]
    table = np.vstack(tables)
    model = example.arm(name).measured_with(Socket(2 * len(tables), distances=apart))
    return jaxcal.identify(table, np.zeros((len(table), 3)), model=model).arm


def _trained(
    example: ModuleType, name: str, trained: str, k: int, draws: int
) -> list[float]:
    """Errors at the other places, mm: random, chosen, all; stiff; expected ratios."""
    places, arm = example.load(name), example.arm(name)
    others = [each for at, each in places.items() if at != trained]
    table = np.column_stack(places[trained])
    stiff = dataclasses.replace(arm, compliance=(), yields=np.zeros(0))
    stated = dataclasses.replace(stiff.default_prior(), by_data=False)
    as_stated = {
        "model": stiff, "prior": stated, "noise_std": PLAY, "loss": "gaussian"
    }  # fmt: skip

    def error(rows: Array, **options: Any) -> float:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            zeros = np.zeros((len(rows), 3))
            found = jaxcal.identify(table[rows], zeros, **({"model": arm} | options))
        return float(np.mean([example.consistency(found.arm, at) for at in others]))

    rng = np.random.default_rng(0)
    random = [rng.choice(len(table), k, replace=False) for _ in range(draws)]
    chosen = example.choose("I", name, places[trained], k, rng)
    plain = jaxcal.select(
        table, k, "exchange", model=stiff, prior=stated, noise=jaxcal.Noise(std=PLAY)
    ).indices
    every = np.arange(len(table))
    found = []
    for rows, options in ((chosen, {}), (plain, as_stated)):
        found.append(np.mean([error(each, **options) for each in random]))
        found += [error(rows, **options), error(every, **options)]
    expected, best = _expected(arm, table, others)
    by_chance = np.mean([expected(each) for each in random])
    return [*found, expected(chosen) / by_chance, expected(best(k)) / by_chance]


def _expected(
    arm: SerialChain, table: Array, others: list[tuple[Array, Array]]
) -> tuple[Callable[[Array], float], Callable[[int], Array]]:
    """Error of some rows at other places, linear, and the best k rows for it."""
    found = jaxcal.identify(table, np.zeros((len(table), 3)), model=arm)
    model, theta = found.model, found.parameters
    free = found.free[: len(theta)] > 0.0
    blocks = model.jacobian(table, theta)[..., free] / np.mean(found.noise_std)
    known = model.fitting.facts(theta)[1][:, free]
    prior = np.diag(found.prior_precision[: len(theta)][free]) + known.T @ known
    judged = []
    for joints, sockets in others:
        moves = model.jacobian(np.column_stack([joints, sockets]), theta)[..., free]
        judged += [moves[sockets == i] - moves[sockets == i].mean(0) for i in (0, 1)]
    region = np.concatenate(judged)

    def error(rows: Array) -> float:
        gram = prior + np.einsum("nqi,nqj->ij", blocks[rows], blocks[rows])
        spread = region @ np.linalg.inv(gram) @ np.matrix_transpose(region)
        return float(np.sqrt(np.trace(spread, axis1=1, axis2=2)).mean())

    def best(k: int) -> Array:
        design = jaxcal.Design.from_blocks(blocks, prior=prior)
        return design.select(k, jaxcal.I(region), "exchange").indices

    return error, best


def distances(_: int) -> None:
    """How far apart an arm fitted at one place puts the sockets of another: 50 mm.

    The half width is that of scatter that is independent from contact to contact, then
    of scatter that all contacts of a socket share, as where the arm makes it: it does
    not average out. Last, what the other place's own contacts say, no distance given.
    """
    sys.path.insert(0, str(EXAMPLES))
    import contacts as example

    print("| arm, trained on | judged at | distance, mm | 95 % | shared | own |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name in ("panda_1", "kuka_14"):
        places = example.load(name)
        freed = example.arm(name).measured_with(Socket(2))
        own_mm = {where: _apart(freed, place) for where, place in places.items()}
        for trained, place in places.items():
            found = example.identify(name, place, np.arange(len(place[0])))
            own = [found.names.index(each) for each in found.model.sensor.names]
            for other, (joints, sockets) in places.items():
                if other == trained:
                    continue
                table = np.column_stack([joints, sockets])
                slopes, covariance = linearised(found, table)
                slopes[..., own] = 0.0  # those sockets are of the other place
                which = [sockets == 0, sockets == 1]
                points = [found.arm.predict(joints[at]).mean(axis=0) for at in which]
                apart = points[1] - points[0]
                far = float(np.linalg.norm(apart))
                first, last = (slopes[at].mean(axis=0) for at in which)
                by = apart / far @ (last - first)
                std = np.sqrt(by @ covariance @ by + 1e-4**2)
                noise, t = found.noise_std[0], stats.t.ppf(0.975, found.noise_dof)
                halves = [
                    1e3 * t * np.hypot(std, noise * np.sqrt(share))
                    for share in (sum(1.0 / at.sum() for at in which), len(which))
                ]
                print(
                    f"| {name}, {trained} | {other} | {1e3 * far:.2f} | "
                    f"{halves[0]:.2f} | {halves[1]:.2f} | {own_mm[other]} |"
                )


def _apart(model: SerialChain, place: tuple[Array, Array]) -> str:
    """Distance of two sockets in mm by their contacts alone, and its 95 %."""
    found = jaxcal.identify(np.column_stack(place), model=model)
    first, second = (
        [found.names.index(f"socket{i} {axis}") for axis in "xyz"] for i in (0, 1)
    )
    by = found.parameters[second] - found.parameters[first]
    far = float(np.linalg.norm(by))
    slopes = np.zeros(len(found.names))
    slopes[second], slopes[first] = by / far, -by / far
    std = np.sqrt(slopes @ np.asarray(found.covariance) @ slopes)
    half = stats.t.ppf(0.975, found.noise_dof) * std
    return f"{1e3 * far:.2f} +- {1e3 * half:.2f}"


_ALL = (
    *(intervals, sizes, misfit, trial, chance, servos),
    *(checks, slips, contacts, distances, files),
)
TABLES = {each.__name__: each for each in _ALL}

if __name__ == "__main__":
    given = sys.argv[1:]
    draws = int(given.pop(0)) if given and given[0].isdigit() else 200
    for name in given or TABLES:
        TABLES[name](draws)
