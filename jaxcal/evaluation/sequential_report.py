"""An evaluation of deciders as a table, as JSON, as a figure and as a page."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import aligned
from jaxcal.evaluation.report import document, write_folder
from jaxcal.evaluation.sequential import METHODS, Result
from jaxcal.pages import Table

__all__ = ["figure", "json_document", "text_table", "write_report"]

_ABOUT = (
    "All methods play the same sessions: the truth, the budget and the noise of every "
    "measurement are equal. Nats: the sum of the expected information gains of the "
    "measurements made, with its standard error (95 % intervals in the figure). Time: "
    "of one core, a choice, averaged over a batch."
)


def text_table(result: Result) -> str:
    """The table in the terminal."""
    return "\n  ".join([_heading(result), *aligned(_rows(result), "<>", ruled=True)])


def _rows(result: Result) -> list[tuple[str, ...]]:
    """The table's head and rows."""
    rival = result.reference
    head = ("method", "nats", "less " + rival + ", paired", "choices", "time each")
    rows: list[tuple[str, ...]] = [head]
    for row, name in enumerate(result.comparison.names):
        mean, error = result.comparison.mean(name)
        over, spread = result.comparison.paired(name, rival)
        rows.append(
            (
                name,
                f"{mean:.3f} ± {error:.3f}",
                "" if name == rival else f"{over:+.3f} ± {spread:.3f}",
                f"{result.comparison.choices[row].mean():.1f}",
                f"{1e3 * result.seconds[row]:.3g} ms",
            )
        )
    return rows


def _heading(result: Result) -> str:
    shown = ", ".join(f"{name} = {value}" for name, value in result.options.items())
    beyond = "; ".join(result.outside)
    return (
        f"{result.task}{f' ({shown})' if shown else ''}, seed {result.seed}: "
        f"{result.comparison.gain.shape[1]:,} sessions, information gained in nats"
        f"{f'; ahead is used beyond its tests: {beyond}' if beyond else ''}"
    )


def json_document(result: Result, *, command: Sequence[str]) -> str:
    """The numbers; the envelope is that of an evaluation of postures."""
    comparison = result.comparison
    methods = {}
    for row, name in enumerate(comparison.names):
        drop, ratio = comparison.entropy_drop[row], comparison.log_ratio[row]
        methods[name] = {
            "label": METHODS[name],
            "nats": _moments(comparison.gain[row]),
            "entropy_drop": _moments(drop),
            "log_ratio_at_truth": _moments(ratio),
            "choices": float(comparison.choices[row].mean()),
            "seconds_per_choice": float(result.seconds[row]),
            "paired": {
                other: _moments(comparison.gain[row] - comparison.gain[number])
                for number, other in enumerate(comparison.names)
                if other != name
            },
        }
        if name in result.rules:
            rule: Any = result.rules[name]
            methods[name]["constants"] = {
                field.name: float(getattr(rule, field.name))
                for field in dataclasses.fields(rule)
            }
    entry = {
        "task": result.task,
        "options": dict(result.options),
        "episodes": comparison.gain.shape[1],
        "seed": result.seed,
        "checkpoint": result.checkpoint,
        "methods": methods,
    }
    return document([entry], command)


def write_report(
    folder: pathlib.Path, result: Result, *, command: Sequence[str]
) -> None:
    """Write the figure as SVG and PNG, and ``index.html`` with it and the table."""
    head, *rows = _rows(result)
    title = "Deciders of sequential measurement on equal sessions"
    part = [Table(head, rows)], {"sequential": figure(result)}
    write_folder(folder, title, {_heading(result): part}, command, _ABOUT)


def figure(result: Result) -> Any:
    """Nats with 95 % intervals; the paired difference from the reference."""
    from jaxcal.plots.style import COLOURS, panels

    comparison = result.comparison
    names = comparison.names
    y = np.arange(len(names))[::-1]
    drawn, (gains, differences) = panels((9.0, 0.6 + 0.35 * len(names)), shape=(1, 2))
    pairs = [comparison.paired(name, result.reference) for name in names]
    for axes, values in (
        (gains, [comparison.mean(name) for name in names]),
        (differences, pairs),
    ):
        mean, error = np.array(values).T
        axes.errorbar(mean, y, xerr=1.96 * error, fmt="o", color=COLOURS[0], capsize=3)
        axes.set_yticks(y, names)
        axes.set_ylim(-0.5, len(names) - 0.5)
    gains.set_xlabel("information gained in a session (nats)")
    differences.set_xlabel(f"less that of {result.reference}, in pairs (nats)")
    differences.axvline(0.0, color=COLOURS[1], linestyle="--")
    return drawn


def _moments(values: NDArray[np.float64]) -> dict[str, float | None]:
    """Mean and its standard error; None where it is not defined."""
    mean = float(values.mean())
    error = float(values.std(ddof=1) / np.sqrt(len(values)))
    return {
        "mean": mean if np.isfinite(mean) else None,
        "standard_error": error if np.isfinite(error) else None,
    }
