"""Figure 10: an old calibration (X_0) and a recent one (X_*) predict later sessions.

The paper compares X_0, from an early session, with X_*, from the det-maximal postures
of a later one. Two things differ: the age and the choice of postures. Here every choice
is tried at every age, on devices whose bias takes a random step between sessions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.candidates import uniform_candidates
from jaxcal.evaluation.parameters import least_squares, predict
from jaxcal.paper.datasets import AXES, NOISE_STD_DEG, RANGES
from jaxcal.paper.exhibits.columns import by_axis, from_rows
from jaxcal.paper.exhibits.devices import Device, pick, rms
from jaxcal.paper.exhibits.exhibit import Exhibit, Verdict
from jaxcal.paper.exhibits.figures.recalibration import by_age, traces
from jaxcal.paper.exhibits.intervals import (
    median_interval,
    paired,
    share_interval,
)
from jaxcal.paper.exhibits.material import Material
from jaxcal.selection import exact_batch

__all__ = ["DRIFT_DEG", "exhibits"]

Array = NDArray[np.float64]

DRIFT_DEG = 0.3  # step of the bias from a session to the next
SESSIONS = 20
LATER = 10  # index of the session of X_*; X_0 is of session 0
POINTS = 8  # postures predicted in a session
TRACED = 6  # sessions drawn point by point
CHOICES = ("random", "policy", "det-maximal")
COMPARED = {  # choice and session of the first calibration, then of the second
    "random_x0_against_x_star": (("random", 0), ("det-maximal", LATER)),
    "policy_x0_against_x_star": (("policy", 0), ("det-maximal", LATER)),
    "age_alone_policy": (("policy", 0), ("policy", LATER)),
    "choice_alone_at_x0": (("random", 0), ("det-maximal", 0)),
    "choice_alone_at_x_star": (("random", LATER), ("det-maximal", LATER)),
}


def exhibits(material: Material) -> list[Exhibit]:
    """Figure 10 on devices that drift, and on the rig recordings."""
    return [_drifting(material), _recorded(material)]


def _choose(choice: str, sets: Array, rng: np.random.Generator) -> NDArray[np.int64]:
    """(E, 4) of (E, M, 3)."""
    if choice == "random":
        return np.argsort(rng.random(sets.shape[:2]), axis=1)[:, :4]
    if choice == "det-maximal":
        return exact_batch(sets, 4).indices
    from jaxcal.selection.policy import select_batch

    return np.asarray(select_batch(sets, 4), dtype=np.int64)


def _drifting(material: Material) -> Exhibit:
    settings = material.settings
    count = min(settings.repeats, 250)
    rng = settings.rng(20)
    unit = uniform_candidates(rng, count * SESSIONS, 50, 3)
    commands = RANGES.denormalise(unit).reshape(count, SESSIONS, 50, 3)
    unit = unit.reshape(commands.shape)
    steps = rng.normal(0.0, DRIFT_DEG, (count, SESSIONS, 3))
    steps[:, 0] = 0.0
    device = Device()
    walk = np.cumsum(steps, axis=1)
    measured, _ = device.record(commands, rng, walk)
    tested, seen = commands[:, :, -POINTS:], measured[:, :, -POINTS:]
    parameters: dict[tuple[str, int], Array] = {}
    error: dict[tuple[str, int], Array] = {}
    for choice in CHOICES:
        for session in (0, LATER):
            # The eight postures that are predicted are not offered.
            offered = slice(50 - POINTS)
            material.progress("recalibration", len(parameters), 2 * len(CHOICES))
            chosen = _choose(choice, unit[:, session, offered], rng)
            found = least_squares(
                pick(commands[:, session, offered], chosen),
                pick(measured[:, session, offered], chosen),
            )
            parameters[choice, session] = found
            left = predict(found[:, None], tested) - seen
            error[choice, session] = np.sqrt((left**2).mean(axis=(-2, -1)))
    after = slice(LATER + 1, None)
    numbers: dict[str, Any] = {"after_later": {}, "other_sessions": {}}
    for (choice, session), values in error.items():
        rest = np.delete(values, session, axis=1)
        name = f"{choice}, {'X_0' if session == 0 else 'X_*'}"
        numbers["after_later"][name] = median_interval(values[:, after].mean(axis=1))
        numbers["other_sessions"][name] = median_interval(rest.mean(axis=1))
    ratios = {
        name: paired(
            error[second][:, after].mean(axis=1),
            error[first][:, after].mean(axis=1),
            settings.rng(21, index),
            settings.resamples,
        ).ratio_of_medians
        for index, (name, (first, second)) in enumerate(COMPARED.items())
    }
    numbers["error_of_second_over_first"] = ratios
    age = from_rows(
        ("choice", "calibrated_in", "session", "median_rms_deg", "low", "high"),
        [
            (choice, session + 1, number, middle.value, middle.low, middle.high)
            for (choice, session), values in error.items()
            for number, middle in enumerate(map(median_interval, values.T), 1)
        ],
    )
    trace = _trace(commands, measured, parameters)
    pays = all(
        ratios[f"{x}_x0_against_x_star"].high < 1.0 for x in ("policy", "random")
    )
    title = "one device that drifts, sessions after X$_*$"
    return Exhibit.from_texts(
        "figure_10",
        {
            **{"count": count, "sessions": SESSIONS, "later": LATER + 1},
            **{"points": POINTS, "drift_deg": DRIFT_DEG, "noise": NOISE_STD_DEG},
        },
        verdict="agrees" if pays else "agrees in part",
        figures={
            "figure_10a_predictions": traces(trace, title),
            "figure_10b_error_by_session": by_age(age, LATER + 1, DRIFT_DEG),
        },
        data={
            "predictions": trace,
            "error_by_session": age,
            "error_by_device": {
                "device": np.arange(1, count + 1),
                **{
                    f"{choice}_session_{session + 1}_rms_deg": values[:, after].mean(
                        axis=1
                    )
                    for (choice, session), values in error.items()
                },
            },
        },
        numbers=numbers,
    )


def _trace(
    commands: Array, measured: Array, parameters: dict[tuple[str, int], Array]
) -> dict[str, Any]:
    """Measured and predicted angles of the first device after the later session."""
    sessions = np.arange(LATER + 1, LATER + 1 + TRACED)
    u = commands[0, sessions, -POINTS:].reshape(-1, 3)
    columns: dict[str, Any] = {
        "session": np.repeat(sessions + 1, POINTS),
        "point": np.tile(np.arange(1, POINTS + 1), len(sessions)),
    }
    shown = {
        "measured": measured[0, sessions, -POINTS:].reshape(-1, 3),
        "x0_random": predict(parameters["random", 0][0], u),
        "x0_policy": predict(parameters["policy", 0][0], u),
        "x_star": predict(parameters["det-maximal", LATER][0], u),
    }
    return columns | dict(by_axis(shown))


# -- recordings ------------------------------------------------------------------------


def _recorded(material: Material) -> Exhibit:
    settings = material.settings
    rng = settings.rng(22)
    (u0,), (y0,) = material.measured("dataset5")
    u1, y1 = material.measured("dataset4")
    repeats = settings.random_draws
    picks = np.argsort(rng.random((repeats, len(u0))), axis=1)[:, :4]
    best = int(np.argmax(material.evaluation("dataset4").reference))
    exact = material.result("dataset4", "exact")
    every = material.result("dataset4", "policy").parameters
    assert exact.parameters is not None and every is not None
    policy = _choose("policy", material.dataset("dataset5").candidates, rng)[0]
    others = np.delete(np.arange(len(u1)), best)
    # Postures that X_* was identified from are not predicted.
    own = pick(u1, exact.indices[:, 0])[best]
    order = rng.random(u1.shape[:2])
    order[(u1[:, :, None] == own).all(-1).any(-1)] = 2.0
    points = np.argsort(order, axis=1)[others, :POINTS]
    tested, seen = pick(u1[others], points), pick(y1[others], points)
    found = {
        "x0_policy": least_squares(u0[policy], y0[policy]),
        "x_star": exact.parameters[best, 0],
    }
    random = least_squares(u0[picks], y0[picks])
    error = {name: rms(predict(p, tested) - seen) for name, p in found.items()}
    each = predict(random[:, None], tested[None]) - seen[None]
    error["x0_random"] = np.median(np.sqrt((each**2).mean(axis=(-2, -1))), axis=0)
    peers = predict(every[others], tested[None]) - seen[None]
    peer_error = np.sqrt((peers**2).mean(axis=(-3, -2, -1)))
    lean = {
        name: (predict(p, tested) - seen).mean(axis=(0, 1)) for name, p in found.items()
    }
    star = float(np.sqrt((error["x_star"] ** 2).mean()))
    ahead = share_interval(peer_error > star)
    trace: dict[str, Any] = {
        "session": np.repeat(others[:TRACED] + 1, POINTS),
        "point": np.tile(np.arange(1, POINTS + 1), TRACED),
    }
    flat = tested[:TRACED].reshape(-1, 3)
    shown = {"measured": seen[:TRACED].reshape(-1, 3)}
    shown["x0_random"] = predict(random[0], flat)
    shown |= {name: predict(p, flat) for name, p in found.items()}
    trace |= by_axis(shown)
    ratio = {
        name: paired(
            error["x_star"], error[name], settings.rng(23, i), settings.resamples
        ).ratio_of_medians
        for i, name in enumerate(("x0_policy", "x0_random"))
    }
    verdict: Verdict = "agrees in part"
    if all(r.high < 1.0 for r in ratio.values()):
        verdict = "agrees"
    elif all(r.low > 1.0 for r in ratio.values()):
        verdict = "disagrees"
    caution = " The largest determinant alone does not single one out."
    return Exhibit.from_texts(
        "figure_10_recorded",
        {
            **{"repeats": repeats, "best": best + 1, "points": POINTS},
            **{"others": len(others), "traced": TRACED},
            "recordings": settings.about_recordings,
            "lean_star": _in_words(lean["x_star"]),
            "lean_policy": _in_words(lean["x0_policy"]),
            "caution": caution if ahead.low < 0.9 else "",
        },
        verdict=verdict,
        figures={
            "figure_10c_recordings": traces(trace, "recordings, dataset4's episodes")
        },
        data={
            "predictions": trace,
            "error_by_episode": {
                "episode": others + 1,
                **{f"{name}_rms_deg": values for name, values in error.items()},
            },
            "error_of_other_calibrations": {
                "episode": others + 1,
                "rms_deg": peer_error,
            },
        },
        numbers={
            "x_star_over": ratio,
            "rms_deg": {
                name: median_interval(values) for name, values in error.items()
            },
            "share_of_other_calibrations_behind_x_star": ahead,
            "mean_error_deg": lean,
        },
    )


def _in_words(mean_error_deg: Array) -> str:
    pairs = zip(mean_error_deg, AXES, strict=True)
    return ", ".join(f"{value:+.2f}° ({axis})" for value, axis in pairs)
