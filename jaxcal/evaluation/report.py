"""An evaluation as a table in the terminal, as JSON and as one HTML page."""

from __future__ import annotations

import json
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from jaxcal.checks import aligned
from jaxcal.evaluation.results import Evaluation, Summary
from jaxcal.extras import versions
from jaxcal.files import atomic_write
from jaxcal.pages import Block, Code, Figure, Page, Section, Table, Text, render

__all__ = [
    "document",
    "file_prefixes",
    "json_document",
    "notes",
    "text_table",
    "write_folder",
    "write_report",
]

_COLUMNS = (
    *("method", "mean det S", "median det S", "det S/det S*", "hit rate"),
    *("D-eff.", "x random", "time each"),
)
_BY_OTHERS = ("method", "efficiency", "least", "hit rate", "time each")
_ABOUT = (
    "det S is quoted in the unit of the dataset's commands; S is the information "
    "matrix AᵀA of the chosen postures and S* that of the best choice there is. Hit "
    "rate: share of selections whose determinant equals the optimum's to a billionth. "
    "D-eff.: mean of (det S / det S*)^(1/p), p parameters. x random: mean det S over "
    "that of random selection. Time: a selection, averaged over the batch."
)


def text_table(shown: Summary, *, many: bool = False) -> str:
    """One dataset as a table; where there are ``many``, a policy's checkpoint too."""
    columns = _COLUMNS if shown.criterion == "D" else _BY_OTHERS
    lines = aligned([columns, *_rows(shown, many)], "<>", ruled=True)
    return "\n  ".join([_heading(shown), *lines, *notes(shown)])


def notes(shown: Summary) -> list[str]:
    """What a reader must know beside the numbers."""
    texts = []
    episodes = shown.dataset["episodes"]
    unproven = episodes - shown.num_proven
    if unproven:
        texts.append(
            f"{unproven} of {episodes} optima are not proven: there an upper bound "
            "stands for det S*, so ratios and efficiencies are at least what is shown "
            "and no selection counts as a hit"
        )
    if shown.k == shown.dataset["num_inputs"] + 1:
        texts.append(
            f"k = {shown.k} fits {shown.num_parameters} parameters with as many "
            "equations: no residual, so no estimate of the noise; a larger k leaves one"
        )
    return texts


def json_document(summaries: Sequence[Summary], *, command: Sequence[str]) -> str:
    """The numbers of several datasets; the layout is in docs/evaluation.md."""
    return document(
        [entry for shown in summaries for entry in _entries(shown)], command
    )


def write_report(
    folder: pathlib.Path,
    evaluations: Sequence[Evaluation],
    runs: Sequence[pathlib.Path] = (),
    *,
    command: Sequence[str],
    many: bool = False,
) -> int:
    """Draw everything, then write each figure as SVG and PNG, and ``index.html`` last.

    Args:
        folder: made where it is missing.
        evaluations: one a dataset.
        runs: folders of training runs to draw curves of.
        command: what was typed, for the record.
        many: name the checkpoint of each policy.

    Returns:
        How many figures there are.
    """
    from jaxcal.evaluation.figures import evaluation_figures
    from jaxcal.evaluation.training_figure import (
        training_curves,
        training_diagnostics,
    )

    sections: dict[str, Part] = {}
    prefixes = file_prefixes([found.dataset.name for found in evaluations])
    for evaluation, prefix in zip(evaluations, prefixes, strict=True):
        shown = evaluation.summarise()
        blocks: list[Block] = [Table(_COLUMNS, _rows(shown, many))]
        blocks += [Text(note, "note") for note in notes(shown)]
        drawn = evaluation_figures(evaluation).items()
        figures = {f"{prefix}_{name}": figure for name, figure in drawn}
        sections[_heading(shown)] = blocks, figures
    if runs:
        folders = {run.name: run for run in runs}
        curves = {"training_curves": training_curves(folders)}
        if (diagnostics := training_diagnostics(folders)) is not None:
            curves["training_diagnostics"] = diagnostics
        sections["Training"] = (), curves
    title = "Posture selection against the proven optimum"
    return write_folder(folder, title, sections, command, _ABOUT)


Part = tuple[Sequence[Block], Mapping[str, Any]]  # of a page: blocks, then figures


def write_folder(
    folder: pathlib.Path,
    title: str,
    sections: Mapping[str, Part],
    command: Sequence[str],
    about: str,
) -> int:
    """Write each figure as SVG and PNG, and ``index.html`` last; how many figures."""
    from jaxcal.plots.style import as_files

    files: dict[str, bytes] = {}
    parts = []
    for heading, (blocks, figures) in sections.items():
        whole = list(blocks)
        for name, figure in figures.items():
            svg, files[f"{name}.png"] = as_files(figure, "svg", "png")
            files[f"{name}.svg"] = svg
            whole.append(Figure(svg, name.replace("_", " ")))
        parts.append(Section(heading, whole))
    count = len(files) // 2
    made_with = ", ".join(f"{name} {v}" for name, v in versions().items())
    page = Page(
        title,
        parts,
        intro=[Text(Code(" ".join(command)), "note"), Text(made_with, "note")],
        footer=[Text(about, "note")],
    )
    files["index.html"] = render(page).encode()
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        with atomic_write(folder / name) as file:
            file.write(data)
    return count


def document(results: Sequence[dict[str, Any]], command: Sequence[str]) -> str:
    """What every evaluation's JSON holds beside its results."""
    whole = {
        "format": "jaxcal-evaluation",
        "version": 1,
        "command": list(command),
        "versions": versions(),
        "results": list(results),
    }
    return json.dumps(whole, indent=1, allow_nan=False) + "\n"


def file_prefixes(names: Sequence[str]) -> list[str]:
    """What the figure files of each dataset are called first; no two alike."""

    def plain(name: str) -> str:
        stem = pathlib.PurePath(name).stem or name
        return "".join(c if c.isalnum() or c in "-." else "-" for c in stem)

    prefixes = [plain(name) for name in names]
    return [
        name if prefixes.count(name) == 1 else f"{name}-{number}"
        for number, name in enumerate(prefixes, start=1)
    ]


def _heading(shown: Summary) -> str:
    data = shown.dataset
    seed = "" if data["seed"] is None else f", seed {data['seed']}"
    return (
        f"{data['name']}{seed}: {data['episodes']:,} episodes, "
        f"{shown.k} of {data['num_candidates']} postures, "
        f"{data['num_inputs']} inputs, {data['num_outputs']} outputs"
        + ("" if shown.criterion == "D" else f", criterion {shown.criterion}")
    )


def _rows(shown: Summary, many: bool) -> list[tuple[str, ...]]:
    """The rows of the table, a cell for each column of the criterion."""
    rows = []
    for row in shown.rows:
        numbers = row.numbers
        name = numbers["label"]
        if many and row.is_policy:
            name += f" ({row.checkpoint or 'default'})"
        if shown.criterion != "D":
            shares = [numbers["efficiency"]["mean"], numbers["least_efficiency"]]
            shares = [_share(share) for share in (*shares, numbers["hit_rate"])]
            rows.append((name, *shares, _time(numbers["seconds_per_selection"])))
            continue
        times = numbers["ratio_to_random"]
        middle = (numbers["det_s"][moment] for moment in ("mean", "median"))
        ratios = ("ratio_to_exact", "hit_rate", "d_efficiency")
        rows.append(
            (
                name,
                *("-" if value is None else f"{value:.4g}" for value in middle),
                *(_share(numbers[ratio]) for ratio in ratios),
                "-" if times is None else f"{times:,.0f}",
                _time(numbers["seconds_per_selection"]),
            )
        )
    return rows


def _entries(shown: Summary) -> list[dict[str, Any]]:
    """One entry a checkpoint, each with every baseline; one without where no policy."""
    policies = [row for row in shown.rows if row.is_policy]
    checkpoints = list(dict.fromkeys(row.checkpoint for row in policies)) or [None]
    names = shown.parameter_names
    return [
        {
            "dataset": shown.dataset,
            "k": shown.k,
            "seed": shown.seed,
            "criterion": shown.criterion,
            "checkpoint": (checkpoint or "default") if policies else None,
            "proven": shown.num_proven / shown.dataset["episodes"],
            "notes": notes(shown),
            "methods": {
                row.method: row.numbers
                for row in shown.rows
                if not row.is_policy or row.checkpoint == checkpoint
            },
        }
        | ({} if names is None else {"parameter_names": list(names)})
        for checkpoint in checkpoints
    ]


def _share(value: float) -> str:
    """Four decimals, and never 1.0000 for what is below it."""
    text = f"{value:.4f}"
    return "0.9999+" if text == "1.0000" and value < 1.0 - 1e-12 else text


def _time(seconds: float) -> str:
    units = {"s": 1.0, "ms": 1e-3, "µs": 1e-6}
    unit = next((unit for unit, size in units.items() if seconds >= size), "µs")
    return f"{seconds / units[unit]:.3g} {unit}"
