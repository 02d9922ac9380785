"""Real arms: how many random choices beat a chosen one, by rule and number of poses.

  python -m benchmarks.choosing [--motoman FOLDER] [--tiago FOLDER]

A UR5 by a tracker and a Panda and a KUKA in sockets are in ``examples``. FOLDER of a
Motoman by a tracker is ``UserData/Robots/Motoman/Dataset/leica_dataset`` of
ctu-vras/multirobot-calibration; that of TIAGo has ``fit_37.csv``, ``heldout_62.csv``
(``examples/tiago/data/calibration/mocap`` of figaroh-examples) and ``tiago.urdf``.
Nothing of either is in this repository.

A draw offers at most 150 poses. Each rule chooses K of them, and so does chance, ten
times; ``identify`` fits each choice by default, and is judged by its mean error at
poses that were not offered: the others of the tracker, another day's of TIAGo, sockets
at other places. ``re-chosen`` fits half of its poses first and chooses the others with
the arm and the noise that it found. ``best of 50`` is the best by I of 50 random
choices.
"""

from __future__ import annotations

import argparse
import pathlib
import sys
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import io
from scipy.spatial.transform import Rotation

import jaxcal
from benchmarks.arm_sensors import table_of, tracked
from jaxcal.models import SerialChain

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Case = tuple[SerialChain, Array, Array, Callable[[jaxcal.Calibration], float]]
"""Model, offered commands (N, c) and readings (N, q), error elsewhere in mm."""

DRAWS = 5
CHANCES = 10
COUNTS = (8, 12, 20)
OFFERED = 150
EXAMPLES = pathlib.Path(__file__).parents[1] / "examples"

MOTOMAN = [  # a, alpha, d, theta: S L U R B T of its makers, metres and degrees
    (0.150, -90, 1.4159, 0),
    (0.614, 180, 0, -90),
    (0.2, -90, 0, 0),
    (0, 90, -0.64, 0),
    (0.03, 90, 0, -90),
    (0, 0, 0.2, 0),
]
REFLECTORS = {  # column of the first joint, tool in metres
    "right": (7, (0.0418, -0.0167, 0.245)),
    "left": (13, (0.05, 0.0, 0.25)),
}


def placed(model: SerialChain, joints: Array, reached: Array) -> Array:
    """(4, 4) the arm's base as a tracker sees it, by the nominal arm."""
    points = model.predict(joints)
    turn, _ = Rotation.align_vectors(
        reached - reached.mean(axis=0), points - points.mean(axis=0)
    )
    base = np.eye(4)
    base[:3, :3] = turn.as_matrix()
    base[:3, 3] = reached.mean(axis=0) - turn.apply(points.mean(axis=0))
    return base


def by_tracker(
    model: SerialChain, joints: Array, reached: Array, unit: float, draw: int
) -> Case:
    """Some of a tracker's poses, judged at the others."""
    order = np.random.default_rng(draw).permutation(len(joints))
    offered, rest = np.split(order, [min(OFFERED, len(joints) * 6 // 10)])

    def error(fit: jaxcal.Calibration) -> float:
        off = fit.predict(joints[rest]) - reached[rest]
        return unit * float(np.linalg.norm(off, axis=1).mean())

    return model, joints[offered], reached[offered], error


def motoman(folder: pathlib.Path, side: str) -> tuple[SerialChain, Array, Array]:
    """One of its arms, joints in degrees, the reflector's places in metres."""
    first, tool = REFLECTORS[side]
    name = f"leica_{side}_hand_6x6x6_dataset.mat"
    table = io.loadmat(folder / name)["dataset"]  # a row for each marker that was seen
    table = table[np.abs(table[:, 19:22]).sum(axis=1) > 0.0]
    columns = np.r_[first : first + 6, 19:22]
    seen = np.unique(table[:, first : first + 6].round(4), axis=0, return_index=True)[1]
    joints, reached = np.split(table[seen][:, columns], [6], axis=1)
    joints = np.degrees(joints)
    base = placed(SerialChain.from_dh(MOTOMAN, tool=tool), joints, reached)
    return SerialChain.from_dh(MOTOMAN, tool=tool, base=base), joints, reached


def tiago(folder: pathlib.Path, _: int) -> Case:
    """One session, judged by another day's; every draw is the same."""

    def read(name: str) -> tuple[Array, Array]:
        table = np.genfromtxt(folder / name, delimiter=",", skip_header=1)
        return np.hstack([table[:, 3:4], np.degrees(table[:, 4:])]), table[:, :3]

    (joints, reached), (others, there) = read("fit_37.csv"), read("heldout_62.csv")
    model = SerialChain.from_urdf(folder / "tiago.urdf", tip="arm_7_link")
    return (
        model,
        joints,
        reached,
        lambda fit: (
            1e3 * float(np.linalg.norm(fit.predict(others) - there, axis=1).mean())
        ),
    )


def in_sockets(name: str, draw: int) -> Case:
    """Contacts at one place, judged at the others."""
    sys.path.insert(0, str(EXAMPLES))
    import contacts

    places = contacts.load(name)
    trained = list(places)[draw % len(places)]
    table = np.column_stack(places[trained])
    others = [place for where, place in places.items() if where != trained]
    return (
        contacts.arm(name),
        table,
        np.zeros((len(table), 3)),
        lambda fit: float(
            np.mean([contacts.consistency(fit.arm, place) for place in others])
        ),
    )


def arms(
    motoman_folder: pathlib.Path | None, tiago_folder: pathlib.Path | None
) -> Iterator[tuple[str, Callable[[int], Case]]]:
    """Each arm that is here, and its draws."""

    def ur5(draw: int) -> Case:
        joints, reached = tracked(draw)
        return by_tracker(table_of(6), joints, reached, 1.0, draw)

    yield "UR5, tracker", ur5
    if motoman_folder:
        for side in REFLECTORS:
            data = motoman(motoman_folder, side)
            yield f"Motoman {side}, tracker", partial(by_tracker, *data, 1e3)
    if tiago_folder:
        yield "TIAGo, another day", partial(tiago, tiago_folder)
    yield "Panda, sockets", partial(in_sockets, "panda_1")
    yield "KUKA, sockets", partial(in_sockets, "kuka_14")


def far_apart(joints: Array, k: int, rng: np.random.Generator) -> Rows:
    """(k,) poses, each the farthest from those before it."""
    scaled = (joints - joints.mean(axis=0)) / joints.std(axis=0).clip(1e-9)
    rows = [int(rng.integers(len(scaled)))]
    while len(rows) < k:
        apart = np.linalg.norm(scaled[:, None] - scaled[rows], axis=-1).min(axis=1)
        rows.append(int(apart.argmax()))
    return np.array(rows)


def choices(case: Case, k: int, draw: int) -> dict[str, Rows]:
    """(k,) rows by each rule."""
    model, commands, readings, _ = case
    rng = np.random.default_rng(draw)

    def select(count: int, arm: SerialChain = model, **options: Any) -> Rows:
        return jaxcal.select(commands, count, "exchange", model=arm, **options).indices

    first = select(max(k // 2, 6))
    others = np.setdiff1d(np.arange(len(commands)), first)
    few = jaxcal.identify(commands[first], readings[first], model=model)
    noise = np.asarray(few.noise_std, dtype=np.float64)
    again = jaxcal.Noise(std=noise) if np.isfinite(noise).all() else None
    design = jaxcal.Design(commands, model=model)
    drawn = [rng.choice(len(commands), k, replace=False) for _ in range(50)]
    scores = []
    for rows in drawn:
        try:
            scores.append(design.score(rows, criterion="I").value)
        except ValueError:  # a socket without a contact
            scores.append(np.inf)
    return {
        "I (default)": select(k),
        "D": select(k, criterion="D"),
        "far apart": far_apart(commands[:, : model.num_joints], k, rng),
        "half random": np.r_[first, rng.permutation(others)[: k - len(first)]],
        "re-chosen": select(k, few.model, required=first, noise=again),
        "best of 50": drawn[int(np.argmin(scores))],
    }


def compared(make: Callable[[int], Case], count: int) -> str:
    """Mean error of random choices; of each rule, and how many of those are better."""
    errors: dict[str, list[float]] = {}
    better: dict[str, list[float]] = {}
    for draw in range(DRAWS):
        case = model, commands, readings, error = make(draw)
        k = min(count, len(commands))
        rng = np.random.default_rng(1000 + draw)
        chances = [rng.choice(len(commands), k, replace=False) for _ in range(CHANCES)]
        rules = {f"chance {i}": rows for i, rows in enumerate(chances)}
        found = {
            rule: error(jaxcal.identify(commands[rows], readings[rows], model=model))
            for rule, rows in (rules | choices(case, k, draw)).items()
        }
        by_chance = [found.pop(rule) for rule in rules]
        errors.setdefault("random", []).extend(by_chance)
        for rule, off in found.items():
            errors.setdefault(rule, []).append(off)
            better.setdefault(rule, []).append(float(np.less(by_chance, off).mean()))
    cells = [
        f"{rule} {np.mean(errors[rule]):.3g}, {np.mean(better[rule]):.0%}"
        for rule in better
    ]
    return f"{np.mean(errors['random']):.3g} | {'; '.join(cells)}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--motoman", type=pathlib.Path)
    parser.add_argument("--tiago", type=pathlib.Path)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    print("| arm | K | random, mm | rule: mean error, random choices that are better |")
    print("| --- | --- | --- | --- |", flush=True)
    for name, make in arms(given.motoman, given.tiago):
        for count in COUNTS:
            print(f"| {name} | {count} | {compared(make, count)} |", flush=True)


if __name__ == "__main__":
    main()
