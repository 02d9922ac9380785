"""The report on the paper: compute every exhibit, judge the claims, write the files."""

from __future__ import annotations

import importlib
import pathlib
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

from jaxcal.arguments import Parser, exit_code, values_of
from jaxcal.files import atomic_write, require_writable_folder
from jaxcal.progress import Progress

if TYPE_CHECKING:
    from benchmarks.paper.exhibits.exhibit import Claim, Exhibit
    from benchmarks.paper.exhibits.study import Settings

_DESCRIPTION = """\
Make every figure and table of the paper from our own runs, each beside what the paper
states, and judge its claims one by one. Writes into --out:

  index.html            the report: one file, opens offline, prints
  reproduction.json     every number in it
  figures/*.png, *.svg  each figure
  data/*.csv            what each figure is drawn from

The policy is the agent that PPO trained on the paper's 210 numbers
(checkpoints/paper.npz); beside it, named so, the default that ships, trained by
imitation. Every exhibit says which it shows. Training curves are read from --studies,
where python -m benchmarks.paper.training_runs puts them; without them it says so.
The same seed gives the same numbers on the same machine.
"""
_EPILOG = """\
examples:
  make reproduce
      the whole report, in report/index.html
  python -m benchmarks.paper --quick
      fewer episodes and draws, to see whether everything works
  python -m benchmarks.paper --data recordings
      Datasets 4 and 5 from a rig: dataset4.csv and dataset5.csv in that folder, each
      the pairs.csv that jaxcal-rig collect writes (docs/datasets.md)
  python -m benchmarks.paper --seed 1 --out report_1
      other candidate sets, draws and devices: how much of it is luck?
"""
_PARTS = (  # modules of exhibits, in the order in which they are computed
    *("training", "calibration", "selection", "variance", "tables"),
    *("accuracy", "recalibration"),
)
_ORDER = (  # of the exhibits, that of the paper
    *("robot", "table_1", "figure_1", "table_2", "table_3", "rank", "reward_range"),
    *("figure_2_paper", "figure_2", "figure_3", "gap_to_optimum", "figure_4"),
    *("figure_5", "figure_6", "figure_7", "figure_8", "figure_9"),
    *("four_or_fifty", "number_of_postures", "figure_10", "figure_10_recorded"),
    "euler_orders",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute, write, say where; the exit code."""
    parser = Parser(
        prog="python -m benchmarks.paper", description=_DESCRIPTION, epilog=_EPILOG
    )
    given = parser.of(_make).parse_args(arguments)
    return exit_code(
        lambda: _make(**values_of(given)), "reproduce", "nothing was written"
    )


def _make(
    *,
    quick: Annotated[bool, "fewer episodes, draws and devices"] = False,
    seed: Annotated[int, "of everything random", "S", (0,)] = 0,
    data: Annotated[
        pathlib.Path | None, "real recordings for Datasets 4 and 5", "DIR"
    ] = None,
    studies: Annotated[
        pathlib.Path | None, "kept runs; the repository's studies", "DIR"
    ] = None,
    out: Annotated[pathlib.Path, "of the report", "DIR"] = pathlib.Path("report"),
    quiet: Annotated[bool, "no progress"] = False,
) -> None:
    if data is not None and not data.is_dir():
        raise ValueError(f"--data must be a folder, got {data}")
    require_writable_folder(out)
    begun, progress = time.perf_counter(), Progress(quiet=quiet)

    from benchmarks.paper.exhibits.claims import claims
    from benchmarks.paper.exhibits.study import STUDIES, Settings
    from jaxcal.learning.runtime import processes

    processes.keep_compiled_programs()
    settings = Settings(seed, quick, data, studies or STUDIES)
    try:
        exhibits = _exhibits(settings, progress)
        judged = claims(exhibits, settings.recorded)
        _write(out, _files(settings, exhibits, judged, progress))
    finally:
        progress.clear()
    for claim in judged:
        print(f"{claim.verdict:>15}  {claim.claim}: {claim.ours}")
    print(
        f"saved: {out}/index.html, reproduction.json, "
        f"{sum(len(e.figures) for e in exhibits)} figures and "
        f"{sum(len(e.data) for e in exhibits)} tables in "
        f"{time.perf_counter() - begun:.0f} s"
    )


def _exhibits(settings: Settings, progress: Progress) -> list[Exhibit]:
    """All of them, in the order of the paper."""
    from benchmarks.paper.exhibits.study import Study

    study = Study(settings, progress)
    # Small inputs that may be wrong come first: a bad file is refused at once.
    for name in ("dataset5", "dataset4"):
        study.dataset(name)
    found: list[Exhibit] = []
    for number, name in enumerate(_PARTS):
        study.stage = f"part {number + 1} of {len(_PARTS)}, "
        part = importlib.import_module(f"benchmarks.paper.exhibits.{name}")
        found += part.exhibits(study)
    return sorted(found, key=lambda exhibit: _ORDER.index(exhibit.key))


def _files(
    settings: Settings,
    exhibits: Sequence[Exhibit],
    judged: Sequence[Claim],
    progress: Progress,
) -> dict[str, bytes]:
    """Everything to write, by path below the folder; the page last."""
    from benchmarks.paper.csv_text import csv_text
    from benchmarks.paper.exhibits.page import json_document, page
    from jaxcal.reports.plots import as_files

    figures = {name: f for e in exhibits for name, f in e.figures.items()}
    files: dict[str, bytes] = {}
    for number, (name, figure) in enumerate(figures.items()):
        progress("drawing", number, len(figures))
        svg, png = as_files(figure, "svg", "png")
        files |= {f"figures/{name}.svg": svg, f"figures/{name}.png": png}
    for exhibit in exhibits:
        for name, columns in exhibit.tables.items():
            files[f"data/{name}"] = csv_text(columns).encode()
    images = {name: files[f"figures/{name}.svg"] for name in figures}
    files["reproduction.json"] = json_document(exhibits, judged, settings).encode()
    files["index.html"] = page(exhibits, judged, images, settings).encode()
    return files


def _write(out: pathlib.Path, files: dict[str, bytes]) -> None:
    """Each atomically; figures and tables left from an earlier report are removed."""
    for name, data in files.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(out / name) as file:
            file.write(data)
    for folder, kinds in (("figures", (".png", ".svg")), ("data", (".csv",))):
        for path in (out / folder).iterdir():
            if path.suffix in kinds and f"{folder}/{path.name}" not in files:
                path.unlink()
