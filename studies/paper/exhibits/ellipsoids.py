"""Error ellipsoids of the parameters identified from one candidate set of dataset3."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats

from jaxcal.evaluation.parameters import least_squares
from jaxcal.information.regression import regressors
from jaxcal.models import Affine
from jaxcal.paper.constants import BIAS_DEG, NOISE_STD_DEG, SCALE
from jaxcal.reports.plots import ellipsoid
from jaxcal.reports.plots.style import BLACK, COLOURS, GREY, legend_below, panels
from studies.paper.exhibits.devices import Device
from studies.paper.exhibits.exhibit import Exhibit, from_rows
from studies.paper.exhibits.intervals import share_interval
from studies.paper.exhibits.study import Study, commands_deg

Array = NDArray[np.float64]

PITCH_ROW = ("a11", "a12", "a13", "bx")  # all three rows have this covariance
LOOKS = {
    "random, median draw": (GREY, ":"),
    "policy": (COLOURS[0], "-"),
    "all 50": (COLOURS[2], "--"),
}


def exhibits(study: Study) -> list[Exhibit]:
    """Ellipses of pairs of parameters, and how many calibrations lie within."""
    settings = study.settings
    evaluation = study.evaluation("dataset3")
    commands = commands_deg(evaluation.dataset)[0]
    draws = evaluation.random_log_det[0]
    middle = int(np.argsort(draws)[len(draws) // 2])
    random, policy = (study.result("dataset3", m) for m in ("random", "policy"))
    four = policy.indices[0, 0]
    sets = (random.indices[0, middle], four, np.arange(len(commands)))
    covariance: dict[str, Any] = {}
    rows: list[tuple[Any, ...]] = []
    for label, indices in zip(LOOKS, sets, strict=True):
        z = regressors(commands[indices])
        covariance[label] = NOISE_STD_DEG**2 * np.linalg.inv(z.T @ z)
        named = zip(PITCH_ROW, covariance[label], strict=True)
        rows += [(label, name, *values) for name, values in named]
    repeats = 2_000 if settings.quick else 10_000
    used = np.broadcast_to(commands[four], (repeats, 4, 3))
    found = least_squares(used, Device().record(used, settings.rng(11))[0])
    truth = np.concatenate([np.diag(SCALE).ravel(), BIAS_DEG])
    by_row = np.array([[0, 1, 2, 9], [3, 4, 5, 10], [6, 7, 8, 11]])
    off = (found - truth)[:, by_row]
    inverse = np.linalg.inv(covariance["policy"])
    square = np.einsum("eri,ij,erj->e", off, inverse, off)
    deviation = {name: np.sqrt(np.diag(c)) for name, c in covariance.items()}
    wider = deviation["random, median draw"] / deviation["policy"]
    shown, pitch = found[:200], by_row[0]
    heads = ("choice", "row", *(f"covariance_{name}" for name in PITCH_ROW))
    return [
        Exhibit.from_texts(
            "ellipsoids",
            {
                **{"noise": NOISE_STD_DEG, "least": wider.min(), "most": wider.max()},
                "count": repeats,
            },
            figures={
                "ellipsoids": _ellipses(covariance, truth[pitch], shown[:, pitch])
            },
            data={
                "covariance": from_rows(heads, rows),
                "calibrations": dict(zip(Affine(3, 3).names, shown.T, strict=True)),
            },
            numbers={
                "share_inside_95": share_interval(square <= stats.chi2.ppf(0.95, 12)),
                "standard_deviations": deviation,
            },
        )
    ]


def _ellipses(
    covariance: Mapping[str, Array], centre: Array, estimates: Array
) -> Figure:
    """95 % ellipses of pairs of a11, a12, a13, bx.

    From their (4, 4) covariance by choice of postures, around the (4,) true values,
    with the (R, 4) simulated estimates of the policy.
    """
    names = (*PITCH_ROW[:3], "bx (°)")
    title = "95 % error ellipses of the pitch row of A and b (+: set values)"
    figure, axes = panels((10.0, 3.6), title, (1, 3))
    scale = np.sqrt(stats.chi2.ppf(0.95, 2))
    dots = {"linestyle": "none", "marker": ".", "markersize": 2.5, "color": COLOURS[5]}
    for each, pair in zip(axes, ([0, 1], [1, 2], [0, 3]), strict=True):
        each.plot(*estimates[:, pair].T, label="simulated, policy", **dots)
        for label, matrix in covariance.items():
            colour, line = LOOKS[label]
            look = {"color": colour, "linestyle": line, "label": label}
            ellipsoid(each, centre[pair], matrix[np.ix_(pair, pair)], scale, **look)
        each.plot(*centre[pair], marker="+", color=BLACK, markersize=8)
        each.set(xlabel=names[pair[0]], ylabel=names[pair[1]])
        each.locator_params(nbins=5)
    legend_below(figure, axes[0])
    return figure
