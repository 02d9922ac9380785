"""report.html of a run of any kind, also of one that is not finished.

Made from the journal and, where there is one, the summary; loaded after the last move.
Figures need matplotlib; without it the page says so.
"""

from __future__ import annotations

import datetime
import json
import pathlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxcal.extras import install
from jaxcal.reports.page import Code, Figure, Page, Section, Table, Text, write_page
from rig.journal.run_folder import JOURNAL, Record, is_written, measured_postures
from rig.outputs.messages import choice_text, numbers
from rig.outputs.run_state import PostureState, RunState
from rig_workbench.outputs.view import headline, trouble, verdict

FOOTER = (
    "Research software, not a medical device. Calibrate with no patient attached; a "
    "hardware emergency stop is required."
)
MOST_ROWS = 60  # of the table of postures; more are in pairs.csv


def write_report(folder: pathlib.Path, records: list[Record]) -> pathlib.Path:
    """Write ``report.html`` of a run, from the records of its journal."""
    start, summary, state = records[0], {}, RunState()
    for record in records:
        state.apply(record)
    if (folder / "summary.json").is_file():
        text = (folder / "summary.json").read_text(encoding="utf-8")
        summary = json.loads(text)
    made = f"{start['started']} on {start['host']}, jaxcal {start['jaxcal']}"
    running = is_written(folder / JOURNAL)
    told = ["made on a simulated device"] if start.get("simulated") else []
    told += trouble(state, running, str(folder))
    intro = [Text(f"{made}."), Text(f"{headline(state, running)[1]}.")]
    intro += [Text(f"{text}.", "warning") for text in told]
    sections = [*_result(state, summary), _measured(state, records)]
    time_of = datetime.datetime.fromtimestamp
    rows = [[f"{time_of(when):%H:%M:%S}", line] for when, line in state.log]
    table = Table(["", ""], rows, numeric=False)
    sections.append(Section("What happened", [table]))
    kind = "calibration" if start["mode"] == "calibrate" else str(start["mode"])
    title, path = f"{kind.capitalize()} {folder.name}", folder / "report.html"
    write_page(path, Page(title, sections, intro=intro, footer=(FOOTER,)))
    return path


def _result(state: RunState, summary: Record) -> list[Section]:
    """What console and page say, errors at held-out targets, and what a refit did."""
    lines = verdict(state, summary)
    if choice := summary.get("choice"):
        lines.append(f"chosen by {choice_text(choice)}. {choice['note']}")
    warned = ("WARNING", "RECALIBRATE")
    outputs, parts = summary.get("outputs", state.names[1]), list[Any]()
    if "A" in summary:  # the lines of the matrix are a table here
        begin = next(i for i, line in enumerate(lines) if line.startswith("y = A u"))
        title, lines = lines[begin], lines[:begin] + lines[begin + 1 + len(outputs) :]
        parts.append(_matrix(summary, outputs, title.rstrip(":")))
    parts += [
        Text(Code(line), "warning" if line.startswith(warned) else "") for line in lines
    ]
    if "before" in summary:
        shown = {"raw": "before", "compensated": "after"}
        if state.start["config"].get("model"):
            shown = {"as designed": "before", "calibrated": "prediction"}
        errors = {t: summary[key]["each"] for t, key in shown.items() if key in summary}
        alt = f"held-out errors in {state.unit}, {' and '.join(errors)}"
        parts.append(drawn(draw_errors, (errors, outputs, state.unit), (9, 3.4), alt))
    sections = [Section("Result", parts)] if parts else []
    if changes := summary.get("changed"):
        rows = [[key, str(old), str(new)] for key, (old, new) in changes.items()]
        head = ["key of rig.toml", "as recorded", "here"]
        title = f"Identified anew from {summary['refit_of']}"
        sections.append(Section(title, [Table(head, rows, numeric=False)]))
    return sections


def _matrix(summary: Record, outputs: Sequence[str], title: str) -> Table:
    """A and b, each with its half-width."""
    values, wide = np.column_stack([summary["A"], summary["b"]]), summary["ci95"]
    rows = [
        [name, *(f"{a:.5f} ± {w:.5f}" for a, w in zip(*row, strict=True))]
        for name, *row in zip(outputs, values, wide, strict=True)
    ]
    return Table(["", *(f"u {name}" for name in summary["axes"]), "b"], rows, title)


def _measured(state: RunState, records: list[Record]) -> Section:
    """Every posture measured so far."""
    postures = list(measured_postures(records).values())
    if not postures:
        planned = any(r["event"] in ("plan", "collection") for r in records)
        what = "measured" if planned else "planned or measured"
        return Section("Postures", [f"Nothing was {what}."])
    rows = [
        [
            PostureState(r["name"]).title, numbers(r["commanded_deg"], 0, 3),
            numbers(r["measured_deg"], 0, 3), numbers(r["std_deg"], 0, 4),
        ]
        for r in postures[:MOST_ROWS]
    ]  # fmt: skip
    told = f"[{state.unit}]"
    head = ["posture", "commanded", f"measured {told}", f"scatter {told}"]
    head[1] += f" [{state.axis_unit}]"
    more = f", the first {MOST_ROWS} of them" if len(postures) > MOST_ROWS else ""
    table = Table(head, rows, f"{len(postures)} measured{more}")
    data = postures, state.names[0], state.axis_unit
    picture = drawn(draw_postures, data, (6, 5), "commanded postures")
    return Section("Postures", [picture, table])


def drawn(
    draw: Callable[..., None], data: Sequence[Any], size: tuple[float, float], alt: str
) -> Any:
    """A block of a page: the figure, or words where matplotlib is not installed."""
    try:
        import matplotlib.figure

        from jaxcal.reports.plots import as_bytes
    except ModuleNotFoundError:
        missing = f"no figure: matplotlib is not installed ({install('plots')})"
        return Text(f"{alt}: {missing}", "note")
    figure = matplotlib.figure.Figure(figsize=size, layout="constrained")
    draw(figure, *data)
    return Figure(as_bytes(figure, "svg"), alt)


def draw_errors(
    figure: Any, each: dict[str, Any], names: Sequence[str], unit: str
) -> None:
    """Errors at held-out targets, raw beside compensated, each on its scale."""
    from jaxcal.reports import plots

    axes = figure.subplots(1, len(each), squeeze=False)[0]
    for axis, (title, values) in zip(axes, each.items(), strict=True):
        plots.before_after(axis, {title: values}, names, unit)


def draw_postures(
    figure: Any, records: list[Record], names: Sequence[str], unit: str
) -> None:
    """Commands of all visits, and of those the calibration is identified from; of more
    than three axes the first three."""
    from jaxcal.reports import plots

    commands = np.array([r["commanded_deg"] for r in records])[:, :3]
    chosen = [i for i, r in enumerate(records) if r.get("role") == "select"]
    names = [f"{name} [{unit}]" for name in names[:3]]
    if len(names) == 1:  # against nothing
        commands, names = np.column_stack([commands, 0 * commands]), [*names, ""]
    axes = figure.add_subplot(projection="3d" if len(names) == 3 else None)
    shown = chosen or range(len(commands))
    plots.selection(axes, commands, list(shown), names, label="measured")
