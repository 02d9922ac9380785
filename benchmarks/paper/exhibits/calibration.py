"""The robot, Table 1, Figures 1 and 6, Euler orders: what a linear calibration does."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.paper.datasets import dataset0_robot
from benchmarks.paper.exhibits.exhibit import Exhibit, by_axis, judge
from benchmarks.paper.exhibits.intervals import mean_interval, share_interval
from benchmarks.paper.exhibits.study import Study, commands_deg, predict
from benchmarks.paper.twin import ORDERS, RobotConfig, read_out, simulate
from jaxcal.calibration.identify import identify
from jaxcal.evaluation.methods import least_squares
from jaxcal.models import Affine
from jaxcal.paper.datasets import AXES, BIAS_DEG, NOISE_STD_DEG, RANGES, SCALE
from jaxcal.reports.plots import BLACK, COLOURS, boxes, legend_right, panels

Array = NDArray[np.float64]


def exhibits(study: Study) -> list[Exhibit]:
    """The robot, Table 1, Figures 1 and 6, the residual under the six Euler orders."""
    recorded = study.settings.recorded
    return [
        _robot(study),
        _table_1(study),
        _errors(study, "dataset0", "figure_1", "Figure 1", "simulation"),
        _errors(study, "dataset4", "figure_6", "Figure 6", recorded),
        _orders(study),
    ]


def _robot(study: Study) -> Exhibit:
    """Whether MuJoCo, which drives dataset0, and the closed form read the same."""
    robot = dataset0_robot()
    commands = commands_deg(study.dataset("dataset3"))[0]
    apart = np.abs(simulate(robot, commands) - read_out(robot, commands))
    numbers = {"postures": len(commands), "largest_difference_deg": apart.max()}
    return Exhibit.from_texts("robot", {}, numbers=numbers)


def _errors(study: Study, name: str, key: str, title: str, where: str) -> Exhibit:
    """Input-output errors before calibration, and after it on held-out postures."""
    commands, measured = study.measured(name)
    groups, per_group, _ = commands.shape
    # Each group is corrected by the parameters that the group before it identified.
    found = np.roll(least_squares(commands, measured), 1, axis=0)
    before, after = measured - commands, measured - predict(found, commands)
    errors = {"before": before, "after": after}
    boxed = {
        when: {a: _box(values[..., i]) for i, a in enumerate(AXES)}
        for when, values in errors.items()
    }
    spread, middle = (
        {when: {a: box[a][what] for a in AXES} for when, box in boxed.items()}
        for what in ("interquartile_range_deg", "median_deg")
    )
    shrink = {a: spread["before"][a] / spread["after"][a] for a in AXES}
    widest = max(AXES, key=lambda a: spread["before"][a])
    smaller = min(shrink.values()) > 1.0
    return Exhibit.from_texts(
        "errors",
        {
            **{"title": title, "where": where, "name": name, "groups": groups},
            **{"per_group": per_group, "overlap": study.about_overlap(name)},
            "centre": max(map(abs, middle["after"].values())),
            "furthest": max(AXES, key=lambda a: abs(middle["before"][a])),
            "widest": widest,
            "shrink": ", ".join(f"{s:.3g} ({a})" for a, s in shrink.items()),
        },
        key=key,
        verdict=judge(smaller and widest == "yaw", smaller),
        figures={f"{key}_errors": _error_boxes(before, after, f"{name}, {where}")},
        data={
            "errors": {
                "group": np.repeat(np.arange(1, groups + 1), per_group),
                **by_axis(errors, "{1}_{0}_deg"),
            }
        },
        numbers={
            **{f"{a}_{when}": boxed[when][a] for a in AXES for when in errors},
            "interquartile_range_shrinks_by": shrink,
        },
    )


def _box(errors: Array) -> dict[str, Any]:
    """Quartiles of (G, N) errors, and the mean of their size, in degrees."""
    low, median, high = np.quantile(errors, [0.25, 0.5, 0.75]).tolist()
    return {
        "median_deg": median,
        "interquartile_range_deg": high - low,
        "mean_absolute_deg": mean_interval(np.abs(errors).mean(axis=1)),
    }


def _error_boxes(before: Array, after: Array, title: str) -> Figure:
    """Box plots by axis; what is left after calibration again on its own scale."""
    title = f"Input-output error by axis: {title}"
    figure, (left, right) = panels((8.0, 3.8), title, (1, 2), width_ratios=(2, 1))
    first, second = before.reshape(-1, 3), after.reshape(-1, 3)
    places = np.arange(3.0)
    for axes, errors, positions, colour in (
        (left, first, places, COLOURS[1]),
        (left, second, places + 3.5, COLOURS[0]),
        (right, second, places, COLOURS[0]),
    ):
        boxes(axes, errors, [colour] * 3, (1, 99), positions=positions)
    labels = [f"{axis}\n{when}" for when in ("before", "after") for axis in AXES]
    left.set_xticks([*places, *(places + 3.5)], labels, fontsize=8)
    right.set_xticks(places, labels[3:], fontsize=8)
    for axes, name in ((left, "before and after"), (right, "after, enlarged")):
        axes.set_title(name, fontsize=9)
        axes.axhline(0.0, color=BLACK, linewidth=0.6)
        axes.set_ylabel("input-output error (°)")
    left.set_xlabel("box: quartiles and median, whiskers: 1 to 99 % of the postures")
    return figure


def _table_1(study: Study) -> Exhibit:
    commands, measured = study.measured("dataset0")
    pooled = identify(commands.reshape(-1, 3), measured.reshape(-1, 3))
    truth = np.concatenate([np.diag(SCALE).ravel(), BIAS_DEG])
    names = Affine(3, 3).names
    low, high = pooled.confidence_intervals(1.0 - 0.05 / 12).T  # all twelve at once
    ends = [
        identify(*pairs).confidence_intervals()
        for pairs in zip(commands, measured, strict=True)
    ]
    covered = np.array([(e[:, 0] <= truth) & (truth <= e[:, 1]) for e in ends])
    rows: list[tuple[str, ...]] = [("", *AXES)]
    for label, numbers in (("scaling factor", (0, 4, 8)), ("bias (°)", (9, 10, 11))):
        rows.append((f"paper: {label}", *(f"{truth[i]:g}" for i in numbers)))
        found = (
            f"{pooled.parameters[i]:.5f} [{low[i]:.5f}, {high[i]:.5f}]" for i in numbers
        )
        rows.append((f"identified: {label}", *found))
    share = share_interval(covered.ravel())
    inside = int(((low <= truth) & (truth <= high)).sum())
    columns = {"parameter": list(names), "set": truth, "identified": pooled.parameters}
    columns |= {
        "low": low,
        "high": high,
        "share_of_groups_covered": covered.mean(axis=0),
    }
    return Exhibit.from_texts(
        "table_1",
        {"groups": commands.shape[0], "per_group": commands.shape[1]},
        verdict=judge(inside == 12 and share.low <= 0.95 <= share.high),
        data={"table_1": columns},
        numbers={
            "inside": inside,
            "coverage": share,
            "identified": dict(zip(names, pooled.parameters, strict=True)),
        },
        rows=rows,
    )


def _orders(study: Study) -> Exhibit:
    count = 2_000 if study.settings.quick else 10_000
    commands = RANGES.denormalise(study.settings.rng(6).random((count, 3)))
    left = []
    for order in ORDERS:
        read = read_out(RobotConfig(read_out_order=order), commands)
        left.append(read - predict(least_squares(commands, read), commands))
    rms, largest = (np.square(left).mean(axis=1) ** 0.5, np.abs(left).max(axis=1))
    columns: dict[str, Any] = {"read_out_order": list(ORDERS)}
    for axis, label in enumerate(AXES):
        columns[f"rms_{label}_deg"] = rms[:, axis]
        columns[f"largest_{label}_deg"] = largest[:, axis]
    overall = np.sqrt((rms**2).mean(axis=1))
    best, worst = int(overall.argmin()), int(overall.argmax())
    return Exhibit.from_texts(
        "euler_orders",
        {
            **{"count": count, "noise": NOISE_STD_DEG, "largest": largest.max()},
            **{"best": ORDERS[best], "least": overall[best]},
            **{"worst": ORDERS[worst], "most": overall[worst]},
        },
        figures={"euler_orders": _order_bars(rms)},
        data={"euler_orders": columns},
        numbers={"rms_deg": dict(zip(ORDERS, overall, strict=True))},
    )


def _order_bars(rms: Array) -> Figure:
    """Root mean square (6, 3) left by the linear model, by read-out order and axis."""
    title = "What the linear model leaves under each Euler order"
    figure, axes = panels((8.0, 3.4), title)
    places = np.arange(len(ORDERS))
    for i, (label, hatch) in enumerate(zip(AXES, ("", "//", ".."), strict=True)):
        look: dict[str, Any] = {"color": COLOURS[i], "hatch": hatch, "width": 0.25}
        x = places + 0.27 * (i - 1)
        axes.bar(x, rms[:, i], label=label, edgecolor="white", **look)
    line = f"noise of one\nreading, {NOISE_STD_DEG}°"
    axes.axhline(NOISE_STD_DEG, color=BLACK, linestyle="--", linewidth=0.9, label=line)
    near = {"xytext": (0, 4), "textcoords": "offset points", "ha": "center"}
    for place in places[rms.sum(axis=1) < 1e-9]:
        axes.annotate("exact", (place, NOISE_STD_DEG), fontsize=8, **near)
    axes.set_xticks(places, ORDERS)
    axes.set_xlabel("order in which the angles are read (mechanism: XYZ)")
    axes.set_ylabel("residual of y = A u + b (° rms)")
    legend_right(axes)
    return figure
