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
from jaxcal.paper.datasets import NOISE_STD_DEG, RANGES
from jaxcal.paper.exhibits.devices import Device, pick, rms
from jaxcal.paper.exhibits.exhibit import Exhibit, Verdict
from jaxcal.paper.exhibits.figures.recalibration import by_age, traces
from jaxcal.paper.exhibits.intervals import (
    median_interval,
    paired,
    share_interval,
)
from jaxcal.paper.exhibits.material import Material, commands_deg
from jaxcal.selection import exact_batch

__all__ = ["DRIFT_DEG", "exhibits"]

Array = NDArray[np.float64]

DRIFT_DEG = 0.3  # step of the bias from a session to the next
SESSIONS = 20
LATER = 10  # index of the session of X_*; X_0 is of session 0
POINTS = 8  # postures predicted in a session
TRACED = 6  # sessions drawn point by point
CHOICES = ("random", "policy", "det-maximal")


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
    compared = {
        "random_x0_against_x_star": ("random", 0, "det-maximal", LATER),
        "policy_x0_against_x_star": ("policy", 0, "det-maximal", LATER),
        "age_alone_policy": ("policy", 0, "policy", LATER),
        "choice_alone_at_x0": ("random", 0, "det-maximal", 0),
        "choice_alone_at_x_star": ("random", LATER, "det-maximal", LATER),
    }
    ratios = {}
    for index, (name, (a, s, b, t)) in enumerate(compared.items()):
        pair = paired(
            error[b, t][:, after].mean(axis=1),
            error[a, s][:, after].mean(axis=1),
            settings.rng(21, index),
            settings.resamples,
        )
        ratios[name] = pair.ratio_of_medians
    numbers["error_of_second_over_first"] = ratios
    others = numbers["other_sessions"]
    age = _by_age(error)
    trace = _trace(commands, measured, parameters)
    policy_ratio, random_ratio = (
        ratios["policy_x0_against_x_star"],
        ratios["random_x0_against_x_star"],
    )
    pays = policy_ratio.high < 1.0 and random_ratio.high < 1.0
    verdict: Verdict = "agrees" if pays else "agrees in part"
    return Exhibit(
        key="figure_10",
        title="Figure 10: an old and a recent calibration, devices that drift",
        caption=(
            f"{count} simulated devices, {SESSIONS} sessions of 50 postures; the bias "
            f"takes a step of {DRIFT_DEG}° (s.d.) on each axis between sessions, noise "
            f"{NOISE_STD_DEG}°. X_0: session 1. X_*: session {LATER + 1}. Predicted: "
            f"{POINTS} postures, not among those offered, of each session; error "
            "against the measured. Bands and intervals: 95 % of the median over "
            "devices, for random postures leave errors without a finite mean."
        ),
        paper=(
            "X_0 of an early session predicts other sessions with a visible bias, X_* "
            "(det-maximal, of a later session) closely; so recalibrate periodically. "
            "The caption says that X_0 comes from random postures, the text that the "
            "policy chose them."
        ),
        ours=(
            f"In the sessions after X_*, its error is {policy_ratio:.3f} times that of "
            f"X_0 where the policy chose X_0's postures and {random_ratio:.3f} times "
            "where they were random. Age alone (policy both times): "
            f"{ratios['age_alone_policy']:.3f}. Choice alone, in the same session: "
            f"{ratios['choice_alone_at_x0']:.3f} for X_0 and "
            f"{ratios['choice_alone_at_x_star']:.3f} for X_*. Over all other sessions, "
            f"earlier ones too, the median error is {others['policy, X_0'].value:.3f}° "
            f"for X_0 (policy) and {others['det-maximal, X_*'].value:.3f}° for X_*."
        ),
        verdict=verdict,
        figures={
            "figure_10a_predictions": traces(
                trace, "one device that drifts, sessions after X$_*$"
            ),
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


def _by_age(error: dict[tuple[str, int], Array]) -> dict[str, Any]:
    names = ("choice", "calibrated_in", "session", "median_rms_deg", "low", "high")
    rows: dict[str, list[Any]] = {name: [] for name in names}
    for (choice, calibrated), values in error.items():
        for session in range(values.shape[1]):
            middle = median_interval(values[:, session])
            entry = (choice, calibrated + 1, session + 1, middle.value, middle.low)
            for name, value in zip(names, (*entry, middle.high), strict=True):
                rows[name].append(value)
    return {name: np.array(values) for name, values in rows.items()}


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
    return columns | _by_axis(shown)


def _by_axis(shown: dict[str, Array]) -> dict[str, Array]:
    return {
        f"{name}_{axis}_deg": values[:, i]
        for name, values in shown.items()
        for i, axis in enumerate(("pitch", "yaw", "roll"))
    }


# -- recordings ------------------------------------------------------------------------


def _recorded(material: Material) -> Exhibit:
    early, late = material.dataset("dataset5"), material.dataset("dataset4")
    assert early.measured is not None and late.measured is not None
    settings = material.settings
    rng = settings.rng(22)
    u0, u1 = commands_deg(early)[0], commands_deg(late)
    repeats = settings.random_draws
    picks = np.argsort(rng.random((repeats, len(u0))), axis=1)[:, :4]
    best = int(np.argmax(material.evaluation("dataset4").reference))
    exact = material.result("dataset4", "exact")
    every = material.result("dataset4", "policy").parameters
    assert exact.parameters is not None and every is not None
    policy = _choose("policy", early.candidates, rng)[0]
    others = np.delete(np.arange(len(u1)), best)
    # Postures that X_* was identified from are not predicted.
    own = pick(u1, exact.indices[:, 0])[best]
    order = rng.random(u1.shape[:2])
    order[(u1[:, :, None] == own).all(-1).any(-1)] = 2.0
    points = np.argsort(order, axis=1)[others, :POINTS]
    tested, seen = pick(u1[others], points), pick(late.measured[others], points)
    found = {
        "x0_policy": least_squares(u0[policy], early.measured[0, policy]),
        "x_star": exact.parameters[best, 0],
    }
    random = least_squares(u0[picks], early.measured[0][picks])
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
    trace |= _by_axis(shown)
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
    return Exhibit(
        key="figure_10_recorded",
        title="Figure 10 on the recordings: X_0 from dataset5, X_* from dataset4",
        caption=(
            f"X_0: four postures of dataset5, the policy's or random ({repeats} draws; "
            f"the first is drawn). X_*: the four of largest det S in dataset4 (episode "
            f"{best + 1}). Predicted: {POINTS} postures, none of X_*'s own, of each of "
            f"the {len(others)} other episodes; {TRACED} of them are drawn. One X_0 "
            "and one X_* only: the intervals are over the episodes predicted. "
            + material.settings.about_recordings
        ),
        paper="As above, on the paper's recordings.",
        ours=(
            f"The error of X_* is {ratio['x0_policy']:.3f} times that of X_0 from the "
            f"policy's postures and {ratio['x0_random']:.3f} times that from random "
            f"ones (medians). On average they are off by {_in_words(lean['x_star'])} "
            f"and {_in_words(lean['x0_policy'])} (X_0, policy). Among the "
            "policy's calibrations from the other episodes of dataset4 itself, "
            f"{ahead.value:.0%} predict worse than X_*."
            + (
                " The largest determinant alone does not single one out."
                if ahead.low < 0.9
                else ""
            )
        ),
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
    axes = ("pitch", "yaw", "roll")
    pairs = zip(mean_error_deg, axes, strict=True)
    return ", ".join(f"{value:+.2f}° ({axis})" for value, axis in pairs)
