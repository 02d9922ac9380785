"""Figure 10 on the rig recordings: X_0 from dataset5, X_* from dataset4."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.evaluation.parameters import least_squares, predict
from jaxcal.paper.constants import AXES
from studies.paper.exhibits.devices import pick, rms
from studies.paper.exhibits.exhibit import Exhibit, judge
from studies.paper.exhibits.intervals import median_interval, paired, share_interval
from studies.paper.exhibits.material import Material
from studies.paper.exhibits.traces import POINTS, TRACED, trace_columns, traces

__all__ = ["exhibits"]

Array = NDArray[np.float64]


def exhibits(material: Material) -> list[Exhibit]:
    """Each calibration predicts eight postures of every other episode."""
    from jaxcal.selection.policy import select_batch

    settings = material.settings
    rng = settings.rng(22)
    (u0,), (y0,) = material.measured("dataset5")
    u1, y1 = material.measured("dataset4")
    repeats = settings.size("random_draws")
    picks = np.argsort(rng.random((repeats, len(u0))), axis=1)[:, :4]
    best = int(np.argmax(material.evaluation("dataset4").reference))
    policy = np.asarray(select_batch(material.dataset("dataset5").candidates, 4))[0]
    others = np.delete(np.arange(len(u1)), best)
    # Postures that X_* was identified from are not predicted.
    own = u1[best][material.result("dataset4", "exact").indices[best, 0]]
    order = rng.random(u1.shape[:2])
    order[(u1[:, :, None] == own).all(-1).any(-1)] = 2.0
    points = np.argsort(order, axis=1)[others, :POINTS]
    tested, seen = pick(u1[others], points), pick(y1[others], points)
    random = least_squares(u0[picks], y0[picks])
    found = {
        "x0_policy": least_squares(u0[policy], y0[policy]),
        "x_star": material.parameters("dataset4", "exact")[best, 0],
    }
    off = {name: predict(p, tested) - seen for name, p in found.items()}
    error = {name: rms(errors) for name, errors in off.items()}
    each = rms(predict(random[:, None], tested[None]) - seen[None])
    error["x0_random"] = np.median(each, axis=0)
    every = material.parameters("dataset4", "policy")[others]
    peers = predict(every, tested[None]) - seen[None]
    peer_error = np.sqrt((peers**2).mean(axis=(-3, -2, -1)))
    ahead = share_interval(peer_error > np.sqrt((error["x_star"] ** 2).mean()))
    lean = {name: errors.mean(axis=(0, 1)) for name, errors in off.items()}
    shown = {"x0_random": random[0]} | found
    first = slice(TRACED)
    trace = trace_columns(others[first] + 1, tested[first], seen[first], shown)
    ratio = {
        name: paired(
            error["x_star"],
            error[name],
            settings.rng(23, i),
            settings.size("resamples"),
        ).ratio_of_medians
        for i, name in enumerate(("x0_policy", "x0_random"))
    }
    caution = " The largest determinant alone does not single one out."
    title = "recordings, dataset4's episodes"
    return [
        Exhibit.from_texts(
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
            figures={"figure_10c_recordings": traces(trace, title)},
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
    ]


def _in_words(mean_error_deg: Array) -> str:
    pairs = zip(mean_error_deg, AXES, strict=True)
    return ", ".join(f"{value:+.2f}° ({axis})" for value, axis in pairs)
