"""Figures 1 and 6, Table 1 and the Euler orders: what the linear calibration does."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.calibration.identify import identify
from jaxcal.evaluation.parameters import least_squares, parameter_names, predict
from jaxcal.paper.datasets import AXES, BIAS_DEG, NOISE_STD_DEG, RANGES, SCALE
from jaxcal.paper.exhibits.columns import by_axis
from jaxcal.paper.exhibits.exhibit import Exhibit, Verdict
from jaxcal.paper.exhibits.figures.calibration import error_boxes, order_bars
from jaxcal.paper.exhibits.intervals import mean_interval, share_interval
from jaxcal.paper.exhibits.material import Material
from jaxcal.paper.twin.robot import ORDERS, RobotConfig, read_out

__all__ = ["exhibits", "held_out_errors"]

Array = NDArray[np.float64]


def exhibits(material: Material) -> list[Exhibit]:
    """Table 1, Figures 1 and 6, and the residual under the six Euler orders."""
    recorded = material.settings.recorded
    return [
        _table_1(material),
        _errors(material, "dataset0", "figure_1", "Figure 1", "simulation"),
        _errors(material, "dataset4", "figure_6", "Figure 6", recorded),
        _orders(material),
    ]


def held_out_errors(commands: Array, measured: Array) -> tuple[Array, Array]:
    """Input-output errors before calibration, and after it on postures not used for it.

    Each group is corrected by the parameters that the group before it identified (the
    first by the last).

    Args:
        commands: (G, N, 3) degrees.
        measured: (G, N, 3) degrees.

    Returns:
        ``measured - commands`` and ``measured - (A commands + b)``, (G, N, 3) degrees.
    """
    found = np.roll(least_squares(commands, measured), 1, axis=0)
    return measured - commands, measured - predict(found, commands)


def _errors(material: Material, name: str, key: str, title: str, where: str) -> Exhibit:
    commands, measured = material.measured(name)
    groups, per_group, _ = commands.shape
    before, after = held_out_errors(commands, measured)
    errors = {"before": before, "after": after}
    numbers: dict[str, Any] = {
        f"{label}_{when}": _box(values[..., axis])
        for axis, label in enumerate(AXES)
        for when, values in errors.items()
    }
    spread = {
        when: [numbers[f"{a}_{when}"]["interquartile_range_deg"] for a in AXES]
        for when in errors
    }
    shrink = dict(
        zip(AXES, np.divide(spread["before"], spread["after"]).tolist(), strict=True)
    )
    numbers["interquartile_range_shrinks_by"] = shrink
    centre = max(abs(numbers[f"{a}_after"]["median_deg"]) for a in AXES)
    widest = AXES[int(np.argmax(spread["before"]))]
    furthest = max(AXES, key=lambda a: abs(numbers[f"{a}_before"]["median_deg"]))
    verdict: Verdict = "agrees" if widest == "yaw" else "agrees in part"
    if min(shrink.values()) <= 1.0:
        verdict = "disagrees"
    return Exhibit.from_texts(
        "errors",
        {
            **{"title": title, "where": where, "name": name, "groups": groups},
            **{"per_group": per_group, "overlap": material.about_overlap(name)},
            **{"centre": centre, "furthest": furthest, "widest": widest},
            "shrink": ", ".join(f"{s:.3g} ({a})" for a, s in shrink.items()),
        },
        key=key,
        verdict=verdict,
        figures={f"{key}_errors": error_boxes(before, after, f"{name}, {where}")},
        data={
            "errors": {
                "group": np.repeat(np.arange(1, groups + 1), per_group),
                **by_axis(errors, "{1}_{0}_deg"),
            }
        },
        numbers=numbers,
    )


def _box(errors: Array) -> dict[str, Any]:
    """Quartiles of (G, N) errors, and the mean of their size, in degrees."""
    low, median, high = np.quantile(errors, [0.25, 0.5, 0.75])
    return {
        "median_deg": median,
        "interquartile_range_deg": high - low,
        "mean_absolute_deg": mean_interval(np.abs(errors).mean(axis=1)),
    }


def _table_1(material: Material) -> Exhibit:
    commands, measured = material.measured("dataset0")
    pooled = identify(commands.reshape(-1, 3), measured.reshape(-1, 3))
    truth = np.concatenate([np.diag(SCALE).ravel(), BIAS_DEG])
    names = parameter_names(3, 3)
    low, high = pooled.confidence_intervals(1.0 - 0.05 / 12).T  # all twelve at once
    covered = np.zeros((len(commands), 12), bool)
    for group, pairs in enumerate(zip(commands, measured, strict=True)):
        one, other = identify(*pairs).confidence_intervals().T
        covered[group] = (one <= truth) & (truth <= other)
    rows: list[tuple[str, ...]] = [("", *AXES)]
    for label, numbers in (("scaling factor", (0, 4, 8)), ("bias (°)", (9, 10, 11))):
        rows.append((f"paper: {label}", *(f"{truth[i]:g}" for i in numbers)))
        found = (
            f"{pooled.parameters[i]:.5f} [{low[i]:.5f}, {high[i]:.5f}]" for i in numbers
        )
        rows.append((f"identified: {label}", *found))
    share = share_interval(covered.ravel())
    inside = int(((low <= truth) & (truth <= high)).sum())
    agrees = inside == 12 and share.low <= 0.95 <= share.high
    return Exhibit.from_texts(
        "table_1",
        {"groups": commands.shape[0], "per_group": commands.shape[1]},
        verdict="agrees" if agrees else "disagrees",
        data={
            "table_1": {
                "parameter": list(names),
                "set": truth,
                "identified": pooled.parameters,
                "low": low,
                "high": high,
                "share_of_groups_covered": covered.mean(axis=0),
            }
        },
        numbers={
            "inside": inside,
            "coverage": share,
            "identified": dict(zip(names, pooled.parameters.tolist(), strict=True)),
        },
        rows=rows,
    )


def _orders(material: Material) -> Exhibit:
    unit = material.settings.rng(6).random(
        (2_000 if material.settings.quick else 10_000, 3)
    )
    commands = RANGES.denormalise(unit)
    left = []
    for order in ORDERS:
        read = np.asarray(read_out(RobotConfig(read_out_order=order), commands))
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
            **{"count": len(commands), "noise": NOISE_STD_DEG},
            **{"best": ORDERS[best], "least": overall[best]},
            **{"worst": ORDERS[worst], "most": overall[worst]},
            "largest": largest.max(),
        },
        figures={"euler_orders": order_bars(columns, NOISE_STD_DEG)},
        data={"euler_orders": columns},
        numbers={"rms_deg": dict(zip(ORDERS, overall.tolist(), strict=True))},
    )
