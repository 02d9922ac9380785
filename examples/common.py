"""What the examples share: flags, a table in .csv, and a picture drawn from it.

An example NAME.py has ``study(full)``, which returns what it found; ``rows(found)``,
the rows of NAME.csv; and ``draw(axes, rows)``. The site draws its pictures from
NAME.csv.
"""

from __future__ import annotations

import argparse
import csv
import importlib
import pathlib
import sys
import warnings
from collections.abc import Iterable
from types import ModuleType
from typing import Any

import numpy as np

import jaxcal
from jaxcal.models import SerialChain

HERE = pathlib.Path(__file__).parent
NAMES = (
    *("ankle", "ur5", "contacts", "hand_eye", "drift", "force_sensor", "triad"),
    *("camera", "tcp", "own_function", "backlash", "magnetometry", "own_policy"),
    *("cartpole", "slot", "fr3", "positioner", "real_camera", "trajectories"),
    *("wrench", "scenarios"),
)
Rows = list[dict[str, str]]


def main(example: ModuleType, arguments: list[str] | None = None) -> Any:
    """Run an example: print its table and write NAME.csv and NAME.png."""
    name = pathlib.Path(str(example.__file__)).stem
    parser = argparse.ArgumentParser(description=str(example.__doc__).split("\n")[0])
    parser.add_argument("--full", action="store_true", help="as many as in the table")
    parser.add_argument("--out", type=pathlib.Path, help="write NAME.csv and .png here")
    options = parser.parse_args(arguments)
    # Of fits of too few readings, on purpose, and of readings far from them.
    warnings.simplefilter("ignore", jaxcal.CalibrationWarning)
    found = example.study(options.full)
    rows: Rows = example.rows(found)
    print(markdown(rows))
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        with (options.out / f"{name}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0], lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        _figure(example, rows).savefig(options.out / f"{name}.png", dpi=150)
    return found


def tolerances(model: SerialChain) -> jaxcal.Prior:
    """What the tables of ur5 and tcp take as known: 0.25 % of length, 0.5 deg."""
    std = np.array(model.default_prior().std, dtype=np.float64)
    rows = std[: model.table.size].reshape(model.table.shape)
    rows[:] = 0.5
    rows[:, [0, 2]] = 2.5e-3 * model.length
    return jaxcal.Prior(std)


def picture(name: str) -> Any:
    """The picture of an example, from the table that is kept."""
    if str(HERE) not in sys.path:
        sys.path.insert(0, str(HERE))
    with (HERE / f"{name}.csv").open(newline="") as file:
        return _figure(importlib.import_module(name), list(csv.DictReader(file)))


def _figure(example: ModuleType, rows: Rows) -> Any:
    from jaxcal.reports.plots import panels

    count = getattr(example, "PANELS", 1)
    figure, axes = panels((7.4 if count > 1 else 6.4, 3.8), shape=(1, count))
    example.draw(axes, rows)
    return figure


def markdown(rows: Rows) -> str:
    """The rows as a table."""
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(row.values() for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def rms(values: Any) -> Any:
    """Root mean square down the columns."""
    return np.sqrt((np.asarray(values) ** 2).mean(axis=0))


def row(cells: dict[str, object], names: Iterable[str], values: Any, form: str) -> dict:
    """A row: cells as they are, and numbers in one format under their names."""
    numbers = zip(names, values, strict=True)
    return {k: str(v) for k, v in cells.items()} | {
        k: f"{v:{form}}" for k, v in numbers
    }


def bars(axes: Any, rows: Rows, name: str, value: str, label: str) -> None:
    """One bar a row."""
    from jaxcal.reports.plots import COLOURS

    axes.bar([r[name] for r in rows], [float(r[value]) for r in rows], color=COLOURS[0])
    axes.tick_params(axis="x", rotation=20)
    axes.set_ylabel(label)


def curves(axes: Any, rows: Rows, name: str, k: str, value: str, label: str) -> None:
    """One curve a name, against the number of measurements."""
    from jaxcal.reports.plots import numbered

    for i, each in enumerate(dict.fromkeys(r[name] for r in rows)):
        points = [(int(r[k]), float(r[value])) for r in rows if r[name] == each]
        axes.plot(*zip(*points, strict=True), label=each, **numbered(i))
    axes.set(xlabel="measurements, K", ylabel=label, yscale="log")
    axes.legend(frameon=False)
