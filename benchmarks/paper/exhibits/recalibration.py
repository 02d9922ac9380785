"""Figure 10: an old calibration (X_0) and a recent one (X_*) predict later sessions.

The paper compares X_0, from an early session, with X_*, from the det-maximal postures
of a later one. Two things differ: the age and the choice of postures. Here every choice
is tried at every age, on devices whose bias takes a random step between sessions; and
on the rig recordings, X_0 from dataset5 and X_* from dataset4.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.paper.exhibits.devices import Device, pick, rms
from benchmarks.paper.exhibits.exhibit import Exhibit, by_axis, from_rows, judge
from benchmarks.paper.exhibits.intervals import (
    band,
    median_interval,
    ratio_interval,
    share_interval,
)
from benchmarks.paper.exhibits.study import Study, choose, predict
from jaxcal.evaluation.methods import least_squares
from jaxcal.paper.datasets import AXES, NOISE_STD_DEG, RANGES
from jaxcal.reports.plots import (
    BLACK,
    COLOURS,
    GREY,
    MARKERS,
    legend_right,
    panels,
)
from jaxcal.selection import exact_batch

Array = NDArray[np.float64]

DRIFT_DEG = 0.3  # step of the bias from a session to the next
SESSIONS = 20
LATER = 10  # index of the session of X_*; X_0 is of session 0
CHOICES = {"random": GREY, "policy": COLOURS[0], "det-maximal": COLOURS[1]}
COMPARED = {  # choice and session of the first calibration, then of the second
    "random_x0_against_x_star": (("random", 0), ("det-maximal", LATER)),
    "policy_x0_against_x_star": (("policy", 0), ("det-maximal", LATER)),
    "age_alone_policy": (("policy", 0), ("policy", LATER)),
    "choice_alone_at_x0": (("random", 0), ("det-maximal", 0)),
    "choice_alone_at_x_star": (("random", LATER), ("det-maximal", LATER)),
}
POINTS = 8  # postures predicted in a session
TRACED = 6  # sessions drawn point by point
_LOOKS = {
    "measured": ("measured", BLACK, "-", ""),
    "x0_random": ("X$_0$, random postures", GREY, ":", "x"),
    "x0_policy": ("X$_0$, PPO's postures", COLOURS[1], "--", "s"),
    "x_star": ("X$_*$", COLOURS[0], "-", "o"),
}


def exhibits(study: Study) -> list[Exhibit]:
    """Figure 10 on devices that drift, and on the recordings."""
    return [_drifting(study), _recorded(study)]


def _drifting(study: Study) -> Exhibit:
    settings = study.settings
    count = min(settings.size("repeats"), 250)
    rng = settings.rng(20)
    unit = rng.random((count * SESSIONS, 50, 3))
    commands = RANGES.denormalise(unit).reshape(count, SESSIONS, 50, 3)
    unit = unit.reshape(commands.shape)
    steps = rng.normal(0.0, DRIFT_DEG, (count, SESSIONS, 3))
    steps[:, 0] = 0.0
    measured, _ = Device().record(commands, rng, np.cumsum(steps, axis=1))
    tested, seen = commands[:, :, -POINTS:], measured[:, :, -POINTS:]
    parameters: dict[tuple[str, int], Array] = {}
    error: dict[tuple[str, int], Array] = {}
    for choice in CHOICES:
        for session in (0, LATER):
            # The eight postures that are predicted are not offered.
            at = (slice(None), session, slice(50 - POINTS))
            study.progress("recalibration", len(parameters), 2 * len(CHOICES))
            chosen = _choose(choice, unit[at], rng)
            found = least_squares(
                pick(commands[at], chosen), pick(measured[at], chosen)
            )
            parameters[choice, session] = found
            error[choice, session] = rms(predict(found[:, None], tested) - seen)
    after = {key: values[:, LATER + 1 :].mean(axis=1) for key, values in error.items()}
    names = {key: f"{key[0]}, {'X_*' if key[1] else 'X_0'}" for key in error}
    others = {
        key: np.delete(e, key[1], axis=1).mean(axis=1) for key, e in error.items()
    }
    ratios = {
        name: ratio_interval(
            np.median,
            after[second],
            after[first],
            settings.rng(21, index),
            settings.size("resamples"),
        )
        for index, (name, (first, second)) in enumerate(COMPARED.items())
    }
    age = from_rows(
        ("choice", "calibrated_in", "session", "median_rms_deg", "low", "high"),
        [
            (choice, session + 1, number, middle.value, middle.low, middle.high)
            for (choice, session), values in error.items()
            for number, middle in enumerate(map(median_interval, values.T), 1)
        ],
    )
    later = slice(LATER + 1, LATER + 1 + TRACED)  # of the first device
    shown = {
        "x0_random": parameters["random", 0][0],
        "x0_policy": parameters["policy", 0][0],
        "x_star": parameters["det-maximal", LATER][0],
    }
    sessions = np.arange(SESSIONS)[later] + 1
    trace = _trace_columns(sessions, tested[0, later], seen[0, later], shown)
    ends = [ratios[f"{x}_x0_against_x_star"].high for x in ("policy", "random")]
    title = "one device that drifts, sessions after X$_*$"
    return Exhibit.from_texts(
        "figure_10",
        {
            **{"count": count, "sessions": SESSIONS, "later": LATER + 1},
            **{"points": POINTS, "drift_deg": DRIFT_DEG, "noise": NOISE_STD_DEG},
        },
        verdict=judge(max(ends) < 1.0, True),
        figures={
            "figure_10a_predictions": _traces(trace, title),
            "figure_10b_error_by_session": _by_age(age),
        },
        data={
            "predictions": trace,
            "error_by_session": age,
            "error_by_device": {
                "device": np.arange(1, count + 1),
                **{f"{c}_session_{s + 1}_rms_deg": e for (c, s), e in after.items()},
            },
        },
        numbers={
            "after_later": {names[k]: median_interval(e) for k, e in after.items()},
            "other_sessions": {
                names[key]: median_interval(e) for key, e in others.items()
            },
            "error_of_second_over_first": ratios,
        },
    )


def _choose(choice: str, sets: Array, rng: np.random.Generator) -> NDArray[np.int64]:
    """(E, 4) of (E, M, 3)."""
    if choice == "random":
        return np.argsort(rng.random(sets.shape[:2]), axis=1)[:, :4]
    if choice == "det-maximal":
        return exact_batch(sets, 4).indices
    return choose(sets)


def _by_age(columns: dict[str, Any]) -> Figure:
    """Error of prediction in each session, by choice and session of the calibration."""
    title = f"Old and recent calibration, bias drifting {DRIFT_DEG}° per session"
    figure, axes = panels((8.0, 4.0), title)
    for session, name, line in ((1, "X$_0$", "--"), (LATER + 1, "X$_*$", "-")):
        for i, (choice, colour) in enumerate(CHOICES.items()):
            keep = columns["choice"] == choice
            keep &= columns["calibrated_in"] == session
            x, value, low, high = (
                columns[c][keep] for c in ("session", "median_rms_deg", "low", "high")
            )
            look: dict[str, Any] = {"color": colour, "marker": MARKERS[i]}
            look["label"] = f"{name} of session {session}, {choice}"
            if choice == "det-maximal":  # lies on the policy's curve: markers alone
                look |= {"linestyle": "none", "markersize": 7}
                axes.plot(x, value, markerfacecolor="none", **look)
            else:
                band(axes, x, value, low, high, linestyle=line, markersize=3.5, **look)
    axes.set_xlabel("session predicted")
    axes.set_ylabel("error of prediction\n(° rms, median; band: its 95 % interval)")
    axes.set_ylim(bottom=0.0)
    axes.set_xticks(np.unique(columns["session"])[:: LATER // 2])
    legend_right(axes)
    return figure


# -- on the recordings -----------------------------------------------------------------


def _recorded(study: Study) -> Exhibit:
    """Each calibration predicts eight postures of every other episode."""
    settings = study.settings
    rng = settings.rng(22)
    (u0,), (y0,) = study.measured("dataset5")
    u1, y1 = study.measured("dataset4")
    repeats = settings.size("random_draws")
    picks = np.argsort(rng.random((repeats, len(u0))), axis=1)[:, :4]
    best = int(np.argmax(study.evaluation("dataset4").reference))
    (policy,) = choose(study.dataset("dataset5").candidates)
    others = np.delete(np.arange(len(u1)), best)
    # Postures that X_* was identified from are not predicted.
    own = u1[best][study.result("dataset4", "exact").indices[best, 0]]
    order = rng.random(u1.shape[:2])
    order[(u1[:, :, None] == own).all(-1).any(-1)] = 2.0
    points = np.argsort(order, axis=1)[others, :POINTS]
    tested, seen = pick(u1[others], points), pick(y1[others], points)
    random = least_squares(u0[picks], y0[picks])
    found = {
        "x0_policy": least_squares(u0[policy], y0[policy]),
        "x_star": study.parameters("dataset4", "exact")[best, 0],
    }
    off = {name: predict(p, tested) - seen for name, p in found.items()}
    error = {name: rms(errors) for name, errors in off.items()}
    each = rms(predict(random[:, None], tested[None]) - seen[None])
    error["x0_random"] = np.median(each, axis=0)
    every = study.parameters("dataset4", "policy")[others]
    peers = predict(every, tested[None]) - seen[None]
    peer_error = np.sqrt((peers**2).mean(axis=(-3, -2, -1)))
    ahead = share_interval(peer_error > np.sqrt((error["x_star"] ** 2).mean()))
    lean = {name: errors.mean(axis=(0, 1)) for name, errors in off.items()}
    shown = {"x0_random": random[0]} | found
    first = slice(TRACED)
    trace = _trace_columns(others[first] + 1, tested[first], seen[first], shown)
    ratio = {
        name: ratio_interval(
            np.median,
            error["x_star"],
            error[name],
            settings.rng(23, i),
            settings.size("resamples"),
        )
        for i, name in enumerate(("x0_policy", "x0_random"))
    }
    caution = " The largest determinant alone does not single one out."
    title = "recordings, dataset4's episodes"
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
        verdict=judge(
            all(r.high < 1.0 for r in ratio.values()),
            any(r.low <= 1.0 for r in ratio.values()),
        ),
        figures={"figure_10c_recordings": _traces(trace, title)},
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
            "rms_deg": {name: median_interval(e) for name, e in error.items()},
            "share_of_other_calibrations_behind_x_star": ahead,
            "mean_error_deg": lean,
        },
    )


def _in_words(mean_error_deg: Array) -> str:
    pairs = zip(mean_error_deg, AXES, strict=True)
    return ", ".join(f"{value:+.2f}° ({axis})" for value, axis in pairs)


# -- predicted postures one by one -----------------------------------------------------


def _trace_columns(
    sessions: NDArray[np.int64],
    commands: Array,
    measured: Array,
    parameters: Mapping[str, Array],
) -> dict[str, Any]:
    """Measured and predicted angles, a row per posture.

    Of (S,) sessions, (S, POINTS, 3) commands and readings in degrees, and the (12,)
    parameters of each calibration.
    """
    u = commands.reshape(-1, 3)
    shown = {name: predict(found, u) for name, found in parameters.items()}
    return {
        "session": np.repeat(sessions, POINTS),
        "point": np.tile(np.arange(1, POINTS + 1), len(sessions)),
        **by_axis({"measured": measured.reshape(-1, 3)} | shown),
    }


def _traces(columns: Mapping[str, Any], title: str) -> Figure:
    """The angles and the errors of each calibration, axis by axis."""
    title = f"Predicted postures: {title}"
    figure, axes = panels((11.0, 6.6), title, (3, 2), sharex=True)
    x = np.arange(len(columns["session"])) + 1
    edges = x[1:][np.diff(columns["session"]) != 0] - 0.5
    for (left, right), name in zip(axes, AXES, strict=True):
        measured = columns[f"measured_{name}_deg"]
        for key, (label, colour, line, marker) in _LOOKS.items():
            values = columns[f"{key}_{name}_deg"]
            look: dict[str, Any] = {"color": colour, "linestyle": line}
            look |= {"marker": marker, "linewidth": 1.0, "markersize": 3}
            left.plot(x, values, label=label, **look)
            right.plot(x, values - measured, **look)
        left.set_ylabel(f"{name} (°)")
        right.set_ylabel("error (°)")
    for each in axes.flat:
        for edge in edges:
            each.axvline(edge, color="#BBBBBB", linewidth=0.8, zorder=0)
        each.grid(False, axis="x")
        each.margins(x=0.01)
    axes[0, 0].set_title("angle", fontsize=9)
    axes[0, 1].set_title("predicted less measured", fontsize=9)
    for each in axes[-1]:
        each.set_xlabel("posture (grey lines: next session)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    place = "outside lower center"
    figure.legend(handles, labels, loc=place, ncols=4, fontsize=8, frameon=False)
    return figure
