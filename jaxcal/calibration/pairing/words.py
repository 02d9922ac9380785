"""A mispairing as a sentence; rows are counted from 0."""

from __future__ import annotations

from collections.abc import Sequence

from jaxcal.calibration.pairing.fit import FOREIGN, Fitted, Path, Table
from jaxcal.checks import in_words

_WHOLE = {
    "reversed": "the readings are in reverse order",
    "commands sorted": "the commands are sorted and the readings are not",
    "readings sorted": "the readings are sorted and the commands are not",
}


def sentence(
    table: Table,
    fit: Fitted,
    near: dict[int, list[int]],
    outputs: Sequence[str],
    unit: str,
) -> str:
    noise = f"{in_words(fit.noise * table.scale)} {unit}".strip()
    joined = fit.hypothesis.extra is not None
    without = "with each apart" if joined else "without that"
    text = what_is_wrong(table, fit, near, outputs, unit)
    return f"{text}; {without} the noise is {noise}"


def what_is_wrong(
    table: Table,
    fit: Fitted,
    near: dict[int, list[int]],
    outputs: Sequence[str],
    unit: str,
) -> str:
    """The mispairing as a sentence; rows are counted from 0."""
    hypothesis, count = fit.hypothesis, len(table.commands)
    kind, starts = hypothesis.kind, hypothesis.starts
    if hypothesis.change is not None:
        return hypothesis.change.words
    if kind == "shift":
        return f"all readings are {_rows_late(starts[0][1])}"
    if kind in _WHOLE:
        return _WHOLE[kind]
    if kind == "halves":
        return (
            "the halves of the readings are exchanged: the readings from row "
            f"{-starts[0][1] % count} on belong to the first commands"
        )
    if kind == "rotation":
        last, far = "first" if starts[0][1] > 0 else "last", abs(starts[0][1])
        these = f"{last} {far} are" if far > 1 else f"{last} is"
        return (
            f"all readings are {_rows_late(starts[0][1])}; the {these} at the other end"
        )
    if kind in ("offset", "parameters"):
        another = "slope or offset"
        if kind == "offset":
            steps = (
                fit.solution[-1] if table.shared else fit.solution[-table.outputs :, 0]
            )
            size = f"{in_words(steps * table.scale)} {unit}".strip()
            another = f"offset, by {size}"
        return (
            f"the table seems to join two sessions: from row {starts[1][0]} on the "
            f"readings have another {another}"
        )
    return _path_words(starts, near, count)


def _rows_late(by: int) -> str:
    rows = "one row" if abs(by) == 1 else f"{abs(by)} rows"
    late, where = ("early", "below") if by > 0 else ("late", "above")
    return f"{rows} {late} (each belongs to the command {rows} {where})"


def _path_words(path: Path, near: dict[int, list[int]], count: int) -> str:
    parts = []
    for i, (start, by) in enumerate(path):
        if by == 0:
            continue
        end = path[i + 1][0] if i + 1 < len(path) else count
        where = (
            f"from row {start} on" if end == count else f"from row {start} to {end - 1}"
        )
        if start == 0:
            where = f"up to row {end - 1}"
        rows = near.get(i, [])
        if len(rows) > 1:
            where += f" (or any from {rows[0]} to {rows[-1]})"
        if by == FOREIGN:
            parts.append(f"{where}, readings do not belong to these commands")
        else:
            parts.append(f"{where}, readings are {_rows_late(by)}")
    return "; ".join(parts)
