"""The table, the JSON and the figures of a run of ``python -m benchmarks``."""

from __future__ import annotations

import dataclasses
import json
import pathlib
from typing import Any

from benchmarks.harness import Row
from jaxcal.files import atomic_write, write_text


def as_json(row: Row) -> dict[str, Any]:
    """A row as plain JSON values."""
    out = dataclasses.asdict(row)
    for verdict, kept in zip(row.verdicts, out["verdicts"], strict=True):
        kept["met"] = verdict.met
    return out


def number(value: float | None) -> str:
    """Three figures, thousands separated."""
    if value is None:
        return "never"
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def text(row: dict[str, Any]) -> str:
    """A row for the terminal."""
    out = []
    for line in row["lines"]:
        note = f"  ({line['note']})" if line["note"] else ""
        out.append(
            f"  {line['case']:<28} {line['who']:<34} "
            f"{number(line['value']):>12} {line['unit']}{note}"
        )
    for verdict in row["verdicts"]:
        out.append("  " + judged(verdict, row["quick"]))
    out += [f"  note: {note}" for note in row["notes"]]
    return "\n".join(out)


def judged(verdict: dict[str, Any], quick: bool) -> str:
    """What was wanted and what came out; a quick run is too small to be judged."""
    sign = "at least" if verdict["larger"] else "at most"
    met = "met" if verdict["met"] else "MISSED"
    if quick:
        met = "not judged (--quick)"
    note = f", {verdict['note']}" if verdict["note"] else ""
    return (
        f"{verdict['case']}: {number(verdict['value'])} {verdict['unit']}, wanted "
        f"{sign} {number(verdict['target'])} {verdict['unit']}: {met}{note}"
    )


def table(results: dict[str, dict[str, Any]]) -> str:
    """Markdown: the least favourable figure of each row, then every figure."""
    out = ["# Benchmarks", "", "Written by `python -m benchmarks`.", ""]
    out += ["| row | least favourable figure | promises kept |", "|---|---|---|"]
    for row in results.values():
        verdicts = row["verdicts"]
        if verdicts:
            least = judged(min(verdicts, key=margin), row["quick"])
            kept = sum(verdict["met"] for verdict in verdicts)
            title = f"[{row['title']}](#{row['name']})"
            out.append(f"| {title} | {least} | {kept} of {len(verdicts)} |")
    for row in results.values():
        where = row["machine"]
        quick = ", QUICK: sizes too small to quote" if row["quick"] else ""
        out += [
            "",
            f"## {row['title']} {{#{row['name']}}}",
            "",
            f"`python -m benchmarks --only {row['name']}`, {row['date'][:10]}, "
            f"{where['cores']} cores ({where['processor']}), load average before "
            f"{where['load_before']}, JAX {where['versions']['jax']}, NumPy "
            f"{where['versions']['numpy']}, {row['seconds']:.0f} s{quick}.",
            "",
            "| case | who | figure | |",
            "|---|---|---|---|",
        ]
        for line in row["lines"]:
            figure = f"{number(line['value'])} {line['unit']}"
            out.append(
                f"| {line['case']} | {line['who']} | {figure} | {line['note']} |"
            )
        if any(not verdict["met"] for verdict in row["verdicts"]) or row["notes"]:
            out.append("")
        out += [
            f"- {judged(verdict, row['quick'])}"
            for verdict in row["verdicts"]
            if not verdict["met"]
        ]
        out += [f"- {note}" for note in row["notes"]]
    return "\n".join(out) + "\n"


def margin(verdict: dict[str, Any]) -> float:
    """What was achieved over what was wanted: below 1 where a promise is missed."""
    value, target = verdict["value"], verdict["target"]
    if value is None or value <= 0.0:
        return 0.0
    return float(value / target if verdict["larger"] else target / value)


def write(folder: pathlib.Path, results: dict[str, dict[str, Any]]) -> None:
    """Everything, each file whole or not at all."""
    write_text(folder / "results.json", json.dumps(results, indent=1) + "\n")
    write_text(folder / "table.md", table(results))
    figures = {"benchmark.png": overview(results)}
    if "scaling" in results:
        figures["scaling.png"] = scaling(results["scaling"]["series"])
    for name, figure in figures.items():
        with atomic_write(folder / name) as file:
            figure.savefig(file, format="png", dpi=130)


def overview(results: dict[str, dict[str, Any]]) -> Any:
    """How far every promise is kept: a mark each, achieved over wanted."""
    from jaxcal.reports.plots import COLOURS, panels

    rows = [row for row in results.values() if row["verdicts"] and not row["quick"]]
    figure, axes = panels((6.4, 0.9 + 0.34 * len(rows)))
    for place, row in enumerate(reversed(rows)):
        shares = [share for share in map(margin, row["verdicts"]) if share]
        for kept, mark in ((True, "o"), (False, "X")):
            drawn = [share for share in shares if (share >= 1.0) == kept]
            look = {"color": COLOURS[0 if kept else 1], "marker": mark, "alpha": 0.7}
            axes.plot(drawn, [place] * len(drawn), linestyle="none", **look)
    axes.set_yticks(range(len(rows)), [row["name"] for row in reversed(rows)])
    axes.axvline(1.0, color="black", linewidth=1)
    axes.set_xscale("log")
    axes.set_xlabel("achieved / wanted; left of the line: missed")
    return figure


def scaling(series: dict[str, Any]) -> Any:
    """Seconds against size, one panel a size, the exponent in the legend."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 6.5), layout="constrained")
    markers = "osD^"
    for place, (axis, curves) in enumerate(series.items()):
        axes = figure.add_subplot(2, 2, place + 1)
        for who, marker in zip(curves, markers, strict=False):
            curve = curves[who]
            label = f"{who}: {curve['exponent']:.2f}"
            axes.loglog(curve["size"], curve["seconds"], marker=marker, label=label)
        sizes = sorted({size for curve in curves.values() for size in curve["size"]})
        axes.set_xticks(sizes, [f"{size:,}" for size in sizes])
        axes.set_xticks([], minor=True)
        axes.set_xlabel(axis)
        axes.set_ylabel("seconds a call")
        axes.legend(fontsize=8, title="exponent, upper half")
        axes.grid(alpha=0.3)
    return figure
