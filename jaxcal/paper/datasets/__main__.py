"""``python -m jaxcal.paper.datasets``: write the paper's datasets with data cards."""

from __future__ import annotations

import argparse
import json
import pathlib
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from jaxcal.arguments import Parser
from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.dataset_files import save_csv_parts, save_npz
from jaxcal.files import require_writable_folder, write_text
from jaxcal.paper import command
from jaxcal.paper.constants import BLOCK, EPISODES, NAMES
from jaxcal.paper.datasets.data_card import card_of, digest_of, page_of
from jaxcal.paper.datasets.datasets import make_dataset
from jaxcal.progress import Progress

__all__ = ["main", "write_datasets"]

_DESCRIPTION = """\
Write the paper's Datasets 0 to 5 to a folder: NAME.npz, NAME.csv and the data card
NAME.json of each, and README.md, the cards as a page. dataset0 is simulated in MuJoCo
(some seconds), dataset1 takes 240 MB as .npz and 670 MB as .csv, dataset4 and dataset5
are made from recordings.
"""


def write_datasets(
    folder: pathlib.Path,
    names: Sequence[str],
    seed: int = 0,
    *,
    episodes: int | None = None,
    formats: Sequence[str] = ("npz", "csv"),
    recordings: pathlib.Path | None = None,
    progress: Progress | None = None,
) -> list[pathlib.Path]:
    """Write datasets, one whole file after the other; the files.

    Args:
        folder: made when missing.
        names: of ``NAMES``.
        seed: of all of them.
        episodes: at most the first so many of each.
        formats: npz, csv or both.
        recordings: folder of dataset4.csv and dataset5.csv; the shipped one when None.
        progress: told how far each is.

    Raises:
        OSError: the folder cannot be written, or a recording not be read.
        ValueError: of an argument or a recording.
    """
    report = progress or Progress(quiet=True)
    folder.mkdir(parents=True, exist_ok=True)
    written, cards = [], []
    for name in names:
        total = EPISODES[name] if episodes is None else min(episodes, EPISODES[name])
        data = make_dataset(name, seed, total, recordings=recordings, progress=report)
        files = [folder / f"{name}.{kind}" for kind in formats]
        for path in files:
            if path.suffix == ".npz":
                save_npz(data, path)
            else:
                save_csv_parts(_parts(data, f"write {path.name}", report), path)
        digests = {path.name: digest_of(path) for path in files}
        cards.append(card_of(data, digests, recordings=recordings))
        files.append(folder / f"{name}.json")
        write_text(files[-1], json.dumps(cards[-1], indent=2) + "\n")
        written += files
    report.clear()
    write_text(folder / "README.md", page_of(cards))
    return [*written, folder / "README.md"]


def _parts(data: Dataset, task: str, progress: Progress) -> Iterator[Dataset]:
    for begin in range(0, data.num_episodes, BLOCK):
        progress(task, begin, data.num_episodes)
        yield data.part(begin, begin + BLOCK)


def main(arguments: list[str] | None = None) -> int:
    """Write; the exit code."""
    options = vars(_parser().parse_args(arguments))
    folder, names = options.pop("out"), list(dict.fromkeys(options.pop("names")))
    progress = Progress(quiet=options.pop("quiet"))

    def write() -> None:
        require_writable_folder(folder)
        try:
            files = write_datasets(folder, names or NAMES, progress=progress, **options)
        finally:
            progress.clear()
        for file in files:
            print(f"saved: {file}")

    return command.run(write, "datasets", "each file in the folder is complete")


def _formats(text: str) -> list[str]:
    kinds = list(dict.fromkeys(text.split(",")))
    if set(kinds) - {"npz", "csv"}:
        raise argparse.ArgumentTypeError(f"must be npz, csv or both, got {text!r}")
    return kinds


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="python -m jaxcal.paper.datasets", description=_DESCRIPTION)
    add = parser.add_argument
    folder: dict[str, Any] = {"type": pathlib.Path, "metavar": "DIR"}
    name = command.one_of(NAMES)
    add("names", nargs="*", type=name, metavar="NAME", help=f"{', '.join(NAMES)}; all")
    add("--out", required=True, **folder)
    add("--seed", type=command.seed, default=0, metavar="S", help="of every dataset; 0")
    size: dict[str, Any] = {"type": command.positive, "metavar": "N"}
    add("--episodes", help="at most the first N of each", **size)
    kinds: dict[str, Any] = {"type": _formats, "default": "npz,csv"}
    add("--formats", metavar="LIST", help="npz,csv", **kinds)
    about = "folder of dataset4.csv and dataset5.csv, your own; the shipped ones"
    add("--recordings", help=about, **folder)
    add("--quiet", action="store_true", help="no progress")
    return parser


if __name__ == "__main__":
    sys.exit(main())
