"""Figure 10: an old calibration (X_0) and a recent one (X_*) predict later sessions.

The paper compares X_0, from an early session, with X_*, from the det-maximal postures
of a later one. Two things differ: the age and the choice of postures. Here every choice
is tried at every age, on devices whose bias takes a random step between sessions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from jaxcal.candidates import uniform_candidates
from jaxcal.evaluation.parameters import least_squares, predict
from jaxcal.paper.constants import NOISE_STD_DEG, RANGES
from jaxcal.plots.style import COLOURS, GREY, MARKERS, band, legend_right, panels
from jaxcal.selection import exact_batch
from studies.paper.exhibits.devices import Device, pick, rms
from studies.paper.exhibits.exhibit import Exhibit, from_rows, judge
from studies.paper.exhibits.intervals import median_interval, paired
from studies.paper.exhibits.material import Material
from studies.paper.exhibits.traces import POINTS, TRACED, trace_columns, traces

__all__ = ["exhibits"]

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


def exhibits(material: Material) -> list[Exhibit]:
    """Figure 10 on devices that drift."""
    settings = material.settings
    count = min(settings.size("repeats"), 250)
    rng = settings.rng(20)
    unit = uniform_candidates(rng, count * SESSIONS, 50, 3)
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
            material.progress("recalibration", len(parameters), 2 * len(CHOICES))
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
        name: paired(
            after[second],
            after[first],
            settings.rng(21, index),
            settings.size("resamples"),
        ).ratio_of_medians
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
    trace = trace_columns(sessions, tested[0, later], seen[0, later], shown)
    ends = [ratios[f"{x}_x0_against_x_star"].high for x in ("policy", "random")]
    title = "one device that drifts, sessions after X$_*$"
    return [
        Exhibit.from_texts(
            "figure_10",
            {
                **{"count": count, "sessions": SESSIONS, "later": LATER + 1},
                **{"points": POINTS, "drift_deg": DRIFT_DEG, "noise": NOISE_STD_DEG},
            },
            verdict=judge(max(ends) < 1.0, True),
            figures={
                "figure_10a_predictions": traces(trace, title),
                "figure_10b_error_by_session": _by_age(age),
            },
            data={
                "predictions": trace,
                "error_by_session": age,
                "error_by_device": {
                    "device": np.arange(1, count + 1),
                    **{
                        f"{c}_session_{s + 1}_rms_deg": e for (c, s), e in after.items()
                    },
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
    ]


def _choose(choice: str, sets: Array, rng: np.random.Generator) -> NDArray[np.int64]:
    """(E, 4) of (E, M, 3)."""
    if choice == "random":
        return np.argsort(rng.random(sets.shape[:2]), axis=1)[:, :4]
    if choice == "det-maximal":
        return exact_batch(sets, 4).indices
    from jaxcal.selection.policy import select_batch

    return np.asarray(select_batch(sets, 4), dtype=np.int64)


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
