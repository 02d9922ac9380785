"""My arm is 1 cm off: calibrate real arms from a ball put into two printed sockets.

    python examples/contacts.py           # one arm
    python examples/contacts.py --full    # three arms, and contacts.md

Some of the contacts of one place are chosen, the arm is identified from them alone, and
judged at the other places: how far the predicted ball is from the mean of its socket.
"""

from __future__ import annotations

import csv
import sys
import warnings

import common
import numpy as np
from numpy.typing import NDArray

import jaxcal
from jaxcal.models import SerialChain, Socket
from jaxcal.progress import Progress

Array = NDArray[np.float64]
Place = tuple[Array, Array]  # joints (N, n) in degrees, sockets (N,)

ARMS = {"panda_1": "panda", "kuka_14": "iiwa14", "dinova_1": "gen3lite"}
APART = [(0, 1, 0.05, 1e-4)]  # the sockets are printed 50 mm apart, to 0.1 mm
COUNTS = (8, 12, 16)
RULES = ("random", "I")
DRAWS = 5
# Its file has +-120 degrees; the postures that were measured reach 157.
LIMITS = {"dinova_1": {"joint_6": (-160.0, 160.0)}}
TRAINED = "front"  # place of the contacts that are fitted


def arm(name: str) -> SerialChain:
    """An arm as its maker describes it, with a ball at its tip and two sockets."""
    path = common.HERE / "contacts" / f"{ARMS[name]}.urdf"
    return SerialChain.from_urdf(
        path,
        tip="ball_link",
        sensor=Socket(2, distances=APART),
        limits=LIMITS.get(name),
    )


def load(name: str) -> dict[str, Place]:
    """Contacts of an arm by the place where the sockets stood."""
    with (common.HERE / "contacts" / f"{name}.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    joints = list(lines[0])[2:]
    found: dict[str, list[list[float]]] = {}
    for line in lines:
        row = [float(line[each]) for each in (*joints, "socket")]
        found.setdefault(line["place"], []).append(row)
    tables = {place: np.array(rows) for place, rows in found.items()}
    return {p: (np.degrees(t[:, :-1]), t[:, -1]) for p, t in tables.items()}


def consistency(found: SerialChain, place: Place) -> float:
    """Mean distance of the predicted balls from the mean of their socket, mm."""
    joints, sockets = place
    points = 1000.0 * found.predict(joints)
    off = [points[sockets == k] - points[sockets == k].mean(axis=0) for k in (0, 1)]
    return float(np.linalg.norm(np.vstack(off), axis=1).mean())


def identify(name: str, place: Place, chosen: Array) -> jaxcal.Calibration:
    """From the contacts ``chosen`` alone."""
    commands = np.column_stack(place)[chosen]
    with warnings.catch_warnings():  # bad fits of a few contacts are what is compared
        warnings.simplefilter("ignore", UserWarning)
        return jaxcal.identify(commands, np.zeros((len(chosen), 3)), model=arm(name))


def choose(rule: str, name: str, place: Place, k: int, rng) -> Array:
    """(k,) indices of contacts, of either socket."""
    commands = np.column_stack(place)
    if rule == "all":
        return np.arange(len(commands))
    if rule == "random":
        return rng.choice(len(commands), min(k, len(commands)), replace=False)
    return jaxcal.select(
        commands, min(k, len(commands)), "exchange", model=arm(name), criterion=rule
    ).indices


def study(full: bool) -> dict[tuple[str, str, int], list[float]]:
    """(arm, rule, K) to the errors at the other places, mm."""
    names = list(ARMS) if full else ["panda_1"]
    cells = [("nominal", 0), ("all", 0)]
    cells += [(rule, k) for k in (COUNTS if full else (12,)) for rule in RULES]
    found: dict[tuple[str, str, int], list[float]] = {}
    progress = Progress()
    for i, name in enumerate(names):
        progress("arms", i, len(names))
        places = load(name)
        elsewhere = [place for other, place in places.items() if other != TRAINED]
        for rule, k in cells:
            errors = []
            for draw in range(DRAWS if rule == "random" else 1):
                model = arm(name).calibrated(arm(name).nominal)
                if rule != "nominal":
                    rng = np.random.default_rng(draw)
                    chosen = choose(rule, name, places[TRAINED], k, rng)
                    model = identify(name, places[TRAINED], chosen).arm
                errors += [consistency(model, place) for place in elsewhere]
            found[name, rule, k] = errors
    progress.clear()
    return found


def rows(found: dict[tuple[str, str, int], list[float]]) -> common.Rows:
    """Mean over the other places, and over the draws of random ones."""
    return [
        common.row({"arm": name, "rule": rule, "k": k or ""},
                   ["error_mm"], [np.mean(errors)], ".3f")
        for (name, rule, k), errors in found.items()
    ]  # fmt: skip


def draw(axes, rows: common.Rows) -> None:
    """Error elsewhere against K, of the first arm."""
    first = [row for row in rows if row["arm"] == rows[0]["arm"]]
    for row in first:
        if not row["k"]:
            level = float(row["error_mm"])
            axes.axhline(level, color="grey", linestyle=":")
            axes.annotate(row["rule"], (COUNTS[0], level), va="bottom")
    chosen = [row for row in first if row["k"]]
    common.curves(axes, chosen, "rule", "k", "error_mm", "error at other places, mm")


if __name__ == "__main__":
    common.main(sys.modules[__name__])
