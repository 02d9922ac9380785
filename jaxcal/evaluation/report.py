"""An evaluation as a table in the terminal, as JSON and as one HTML file."""

from __future__ import annotations

import base64
import html
import json
import pathlib
import platform
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Any

from jaxcal.evaluation.parameters import parameter_names
from jaxcal.evaluation.results import (
    Evaluation,
    MethodResult,
    StreamedEvaluation,
    StreamedResult,
)
from jaxcal.evaluation.tally import BINS_PER_UNIT

__all__ = ["html_page", "json_document", "notes", "text_table", "versions"]

AnyEvaluation = Evaluation | StreamedEvaluation

FORMAT = "jaxcal-evaluation"
VERSION = 1

_COLUMNS = (
    "method",
    "mean det S",
    "median det S",
    "det S/det S*",
    "hit rate",
    "D-eff.",
    "x random",
    "time each",
)
_PACKAGES = ("jaxcal", "numpy", "scipy", "numba", "jax", "flax")

_STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;max-width:62em;margin:2em auto;"
    "padding:0 1em;color:#222}table{border-collapse:collapse;margin:1em 0}"
    "th,td{padding:.25em .7em;border-bottom:1px solid #ddd;text-align:right}"
    "th:first-child,td:first-child{text-align:left}th{background:#f4f4f4}"
    "img{width:100%;height:auto;margin:.6em 0}.note{color:#555;font-size:90%}"
)


def versions() -> dict[str, str]:
    """What computed the numbers: Python and the packages that matter."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def text_table(evaluation: AnyEvaluation, *, many: bool = False) -> str:
    """One dataset as a table for the terminal.

    Args:
        evaluation: what to show.
        many: name the checkpoint of each policy.
    """
    rows = [_COLUMNS, *_rows(evaluation, many)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_COLUMNS))]
    lines = [_heading(evaluation)]
    for number, row in enumerate(rows):
        cells = [row[0].ljust(widths[0])]
        cells += [
            cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)
        ]
        lines.append("  " + "  ".join(cells))
        if number == 0:
            lines.append("  " + "  ".join("-" * width for width in widths))
    return "\n".join([*lines, *(f"  {note}" for note in notes(evaluation))])


def notes(evaluation: AnyEvaluation) -> list[str]:
    """What a reader must know beside the numbers."""
    found = []
    dataset = evaluation.dataset
    unproven = dataset.num_episodes - evaluation.num_proven
    if unproven:
        found.append(
            f"{unproven} of {dataset.num_episodes} optima are not proven: there det S* "
            "is an upper bound, so the ratios are at least what is shown and no "
            "selection counts as a hit"
        )
    if evaluation.k == dataset.num_inputs + 1:
        found.append(
            f"k = {evaluation.k} fits {evaluation.num_parameters} parameters with as "
            "many equations: no residual, so no estimate of the noise; a larger k "
            "leaves one"
        )
    if isinstance(evaluation, StreamedEvaluation):
        found.append(
            "means and hit rates are of exact sums over all episodes; medians are read "
            f"off a histogram of log det S with bins of 1/{BINS_PER_UNIT}"
        )
    return found


def json_document(
    evaluations: Sequence[AnyEvaluation],
    *,
    command: Sequence[str],
    indices: bool = False,
) -> str:
    """The numbers of several evaluations; the layout is in docs/evaluation.md.

    Args:
        evaluations: one a dataset.
        command: what was typed, for the record.
        indices: also what each method chose in every episode (random: its first draw).
    """
    document = {
        "format": FORMAT,
        "version": VERSION,
        "command": list(command),
        "versions": versions(),
        "results": [
            entry
            for evaluation in evaluations
            for entry in _entries(evaluation, indices)
        ],
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def html_page(
    evaluations: Sequence[Evaluation],
    images: Mapping[str, bytes],
    *,
    command: Sequence[str],
    many: bool = False,
) -> str:
    """One self-contained page: tables, notes and figures.

    Args:
        evaluations: one a dataset.
        images: SVG files by name; a name starts with that of its dataset's prefix.
        command: what was typed, for the record.
        many: name the checkpoint of each policy.
    """
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width'>",
        f"<title>jaxcal evaluation</title><style>{_STYLE}</style></head><body>",
        "<h1>Posture selection against the proven optimum</h1>",
        f"<p class='note'><code>{html.escape(' '.join(command))}</code><br>",
        html.escape(", ".join(f"{k} {v}" for k, v in versions().items())),
        "</p>",
    ]
    left = dict(images)
    for number, evaluation in enumerate(evaluations):
        parts.append(f"<h2>{html.escape(_heading(evaluation))}</h2>")
        parts.append(_html_table([_COLUMNS, *_rows(evaluation, many)]))
        parts += [
            f"<p class='note'>{html.escape(note)}</p>" for note in notes(evaluation)
        ]
        prefix = file_prefix(evaluations, number)
        for name in [name for name in left if name.startswith(prefix + "_")]:
            parts.append(_image(name, left.pop(name)))
    if left:
        parts.append("<h2>Training</h2>")
        parts += [_image(name, data) for name, data in left.items()]
    parts.append(
        "<p class='note'>det S is quoted in the unit of the dataset's commands; S is "
        "the information matrix A<sup>T</sup>A of the chosen postures and S* that of "
        "the best choice there is. Hit rate: share of selections whose determinant "
        "equals the optimum's to a billionth. D-eff.: mean of (det S / det S*)<sup>"
        "1/p</sup>, p parameters. x random: mean det S over that of random selection. "
        "Time: a selection, averaged over the batch.</p></body></html>"
    )
    return "\n".join(parts) + "\n"


def file_prefix(evaluations: Sequence[Evaluation], number: int) -> str:
    """What the figure files of one evaluation are called first; unique among them."""

    def plain(name: str) -> str:
        stem = pathlib.PurePath(name).stem or name
        return "".join(c if c.isalnum() or c in "-." else "-" for c in stem)

    names = [plain(evaluation.dataset.name) for evaluation in evaluations]
    name = names[number]
    return name if names.count(name) == 1 else f"{name}-{number + 1}"


def _heading(evaluation: AnyEvaluation) -> str:
    dataset = evaluation.dataset
    seed = "" if dataset.seed is None else f", seed {dataset.seed}"
    return (
        f"{dataset.name}{seed}: {dataset.num_episodes:,} episodes, "
        f"{evaluation.k} of {dataset.num_candidates} postures, "
        f"{dataset.num_inputs} inputs, {dataset.num_outputs} outputs"
    )


def _rows(evaluation: AnyEvaluation, many: bool) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    summary: Any = evaluation.summary
    for result in evaluation.results:
        row = summary(result)
        name = result.label
        if many and result.is_policy:
            name += f" ({_where(result)})"
        rows.append(
            (
                name,
                _number(row["det_s"]["mean"]),
                _number(row["det_s"]["median"]),
                _share(row["ratio_to_exact"]),
                _share(row["hit_rate"]),
                _share(row["d_efficiency"]),
                "-"
                if row["ratio_to_random"] is None
                else f"{row['ratio_to_random']:,.0f}",
                _time(row["seconds_per_selection"]),
            )
        )
    return rows


def _entries(evaluation: AnyEvaluation, indices: bool) -> list[dict[str, Any]]:
    """One entry a checkpoint, each with every baseline; one without where no policy."""
    dataset = evaluation.dataset
    policies = [result for result in evaluation.results if result.is_policy]
    checkpoints = list(dict.fromkeys(result.checkpoint for result in policies))
    entries = []
    summary: Any = evaluation.summary
    for checkpoint in checkpoints or [None]:
        methods = {}
        for result in evaluation.results:
            if result.is_policy and result.checkpoint != checkpoint:
                continue
            methods[result.method] = summary(result)
            if indices and isinstance(result, MethodResult):
                methods[result.method]["indices"] = result.indices[:, 0].tolist()
        entry: dict[str, Any] = {
            "dataset": {
                "name": dataset.name,
                "episodes": dataset.num_episodes,
                "num_candidates": dataset.num_candidates,
                "num_inputs": dataset.num_inputs,
                "num_outputs": dataset.num_outputs,
                "seed": dataset.seed,
                "sha256": dataset.sha256,
            },
            "k": evaluation.k,
            "seed": evaluation.seed,
            "checkpoint": (checkpoint or "default") if policies else None,
            "proven": evaluation.num_proven / dataset.num_episodes,
            "notes": notes(evaluation),
            "methods": methods,
        }
        if dataset.measured is not None:
            entry["parameter_names"] = list(
                parameter_names(dataset.num_inputs, dataset.num_outputs)
            )
        entries.append(entry)
    return entries


def _where(result: MethodResult | StreamedResult) -> str:
    return "default" if result.checkpoint is None else result.checkpoint


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _share(value: float) -> str:
    """Four decimals, and never 1.0000 for what is below it."""
    text = f"{value:.4f}"
    return "0.9999+" if text == "1.0000" and value < 1.0 - 1e-12 else text


def _time(seconds: float) -> str:
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-6:.3g} µs"


def _html_table(rows: Sequence[Sequence[str]]) -> str:
    lines = ["<table>"]
    for number, row in enumerate(rows):
        tag = "th" if number == 0 else "td"
        cells = "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in row)
        lines.append(f"<tr>{cells}</tr>")
    return "\n".join([*lines, "</table>"])


def _image(name: str, data: bytes) -> str:
    encoded = base64.b64encode(data).decode("ascii")
    return (
        f"<img alt='{html.escape(name.replace('_', ' '))}' "
        f"src='data:image/svg+xml;base64,{encoded}'>"
    )
