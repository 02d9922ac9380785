"""``python -m jaxcal.paper.reproduce``: the paper's figures, tables and claims."""

from __future__ import annotations

import argparse
import pathlib
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from jaxcal.paper.exhibits.exhibit import Claim, Exhibit, Settings
    from jaxcal.progress import Progress

_DESCRIPTION = """\
Make every figure and table of the paper from our own runs, each beside what the paper
states, and judge its claims one by one. Writes into --out:

  index.html            the report: one file, opens offline, prints
  reproduction.json     every number in it
  figures/*.png, *.svg  each figure; robot.png and robot.gif, the robot moving
  data/*.csv            what each figure is drawn from

The policy is the one that ships (checkpoints/default). Training curves are read from
--studies, where python -m jaxcal.paper.training_runs puts them; without them the report
says so. The same seed gives the same numbers on the same machine.
"""
_EPILOG = """\
examples:
  make reproduce
      the whole report, in report/index.html
  python -m jaxcal.paper.reproduce --quick
      fewer episodes and draws, to see whether everything works
  python -m jaxcal.paper.reproduce --data recordings
      Datasets 4 and 5 from a rig: dataset4.csv and dataset5.csv in that folder, each
      the pairs.csv that python -m rig collect writes (docs/datasets.md)
  python -m jaxcal.paper.reproduce --seed 1 --out report_1
      other candidate sets, draws and devices: how much of it is luck?
"""


class _Parser(argparse.ArgumentParser):
    """One clear line instead of the usage and a line."""

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: error: {message}; see --help", file=sys.stderr)
        sys.exit(2)


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute, write, say where; the exit code."""
    from jaxcal.progress import Progress

    options = _parse(arguments)
    progress = Progress(quiet=options.quiet)
    try:
        return _run(options, progress)
    except KeyboardInterrupt:
        progress.clear()
        print("reproduce: interrupted, nothing was written", file=sys.stderr)
        return 130
    except (ValueError, OSError) as error:
        progress.clear()
        if isinstance(error, OSError) and error.strerror and error.filename:
            text = f"{error.filename}: {error.strerror}"
        else:
            text = " ".join(str(error).split())
        print(f"reproduce: error: {text}", file=sys.stderr)
        return 2


def _run(options: argparse.Namespace, progress: Progress) -> int:
    from jaxcal.files import require_writable_folder

    if options.data is not None and not options.data.is_dir():
        raise ValueError(f"--data must be a folder, got {options.data}")
    require_writable_folder(options.out)
    begun = time.perf_counter()

    from jaxcal.learning.runtime import cache
    from jaxcal.paper.exhibits.claims import claims
    from jaxcal.paper.exhibits.exhibit import STUDIES, Settings

    cache.keep_compiled_programs()
    settings = Settings(
        seed=options.seed,
        quick=options.quick,
        data=options.data,
        studies=options.studies or STUDIES,
    )
    exhibits = _exhibits(settings, progress)
    judged = claims(exhibits, settings.recorded)
    files = _files(settings, exhibits, judged, progress)
    _write(options.out, files)
    progress.clear()
    for claim in judged:
        print(f"{claim.verdict:>15}  {claim.claim}: {claim.ours}")
    for notice in filter(None, (e.notice for e in exhibits)):
        print(f"note: {notice}")
    print(
        f"saved: {options.out}/index.html, reproduction.json, "
        f"{sum(len(e.figures) for e in exhibits)} figures, "
        f"{sum(len(e.pictures) for e in exhibits)} pictures and "
        f"{sum(len(e.data) for e in exhibits)} tables in "
        f"{time.perf_counter() - begun:.0f} s"
    )
    return 0


def _exhibits(settings: Settings, progress: Progress) -> list[Exhibit]:
    """All of them, in the order of the paper."""
    from jaxcal.paper.exhibits import (
        accuracy,
        calibration,
        pictures,
        recalibration,
        selection,
        tables,
        training,
    )
    from jaxcal.paper.exhibits.material import Material

    material = Material(settings, progress)
    # Small inputs that may be wrong come first: a bad file is refused at once.
    for name in ("dataset5", "dataset4"):
        material.dataset(name)
    parts = (
        *(training, calibration, selection, pictures),
        *(tables, accuracy, recalibration),
    )
    found: dict[str, Exhibit] = {}
    for number, part in enumerate(parts):
        stage = f"part {number + 1} of {len(parts)}"

        def report(task: str, done: int, total: int, stage: str = stage) -> None:
            progress(f"{stage}, {task}", done, total)

        material.progress = report
        found |= {exhibit.key: exhibit for exhibit in part.exhibits(material)}
    first = [key for key in _ORDER if key in found]
    return [found[key] for key in (*first, *(k for k in found if k not in first))]


_ORDER = (
    *("robot", "table_1", "figure_1", "table_2", "table_3", "rank", "reward_range"),
    *("figure_2_paper", "figure_2", "figure_3", "gap_to_optimum", "figure_4"),
    *("figure_5", "ellipsoids", "figure_6", "figure_7", "figure_8", "figure_9"),
    *("four_or_fifty", "number_of_postures", "figure_10", "figure_10_recorded"),
    "euler_orders",
)


def _files(
    settings: Settings,
    exhibits: Sequence[Exhibit],
    judged: Sequence[Claim],
    progress: Progress,
) -> dict[str, bytes]:
    """Everything to write, by path below the folder; the page last."""
    from jaxcal.paper.exhibits.exhibit import as_csv
    from jaxcal.paper.exhibits.material import Material
    from jaxcal.paper.exhibits.page import json_document, page
    from jaxcal.plots import as_bytes

    figures = {name: f for e in exhibits for name, f in e.figures.items()}
    files: dict[str, bytes] = {}
    progress("drawing", 0, len(figures))
    for number, (name, figure) in enumerate(figures.items()):
        files[f"figures/{name}.svg"] = as_bytes(figure, "svg")
        files[f"figures/{name}.png"] = as_bytes(figure, "png")
        progress("drawing", number + 1, len(figures))
    for exhibit in exhibits:
        for name, data in exhibit.pictures.items():
            files[f"figures/{name}"] = data
        for name, columns in exhibit.data.items():
            files[f"data/{exhibit.key}_{name}.csv"] = as_csv(columns).encode()
    values = {
        "seed": settings.seed,
        "quick": settings.quick,
        "data": None if settings.data is None else str(settings.data),
    }
    text = json_document(exhibits, judged, settings=values)
    files["reproduction.json"] = text.encode()
    flags = "".join(
        f" {flag}"
        for flag, used in (
            (f"--seed {settings.seed}", settings.seed != 0),
            ("--quick", settings.quick),
            (f"--data {settings.data}", settings.data is not None),
        )
        if used
    )
    document = page(
        exhibits,
        judged,
        {name: files[f"figures/{name}.svg"] for name in figures},
        command=f"python -m jaxcal.paper.reproduce{flags}",
        seed=settings.seed,
        note=Material(settings).about_recordings(),
    )
    files["index.html"] = document.encode()
    return files


def _write(out: pathlib.Path, files: dict[str, bytes]) -> None:
    """Each atomically; figures and tables of an earlier report that are no more, go."""
    from jaxcal.files import atomic_write

    for folder in ("figures", "data"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        with atomic_write(out / name) as file:
            file.write(data)
    for folder, kinds in (("figures", (".png", ".svg", ".gif")), ("data", (".csv",))):
        for path in (out / folder).iterdir():
            if path.suffix in kinds and f"{folder}/{path.name}" not in files:
                path.unlink()


def _seed(text: str) -> int:
    try:
        number = int(text)
    except ValueError:
        number = -1
    if number < 0:
        raise argparse.ArgumentTypeError(
            f"must be a whole number of at least 0, got {text!r}"
        )
    return number


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = _Parser(
        prog="python -m jaxcal.paper.reproduce",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add = parser.add_argument
    folder: dict[str, Any] = {"type": pathlib.Path, "metavar": "DIR"}
    add("--quick", action="store_true", help="fewer episodes, draws and devices")
    add("--seed", type=_seed, default=0, metavar="S", help="of everything random; 0")
    add("--data", help="real recordings for Datasets 4 and 5", **folder)
    add("--studies", help="kept runs; the repository's studies", **folder)
    add("--out", default=pathlib.Path("report"), help="of the report; report", **folder)
    add("--quiet", action="store_true", help="no progress")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    sys.exit(main())
