"""``python -m jaxcal.paper.datasets.datasets``: write the paper's datasets with data cards."""

from __future__ import annotations

import argparse
import dataclasses
import json
import pathlib
import sys
from collections.abc import Iterator

import numpy as np

from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.dataset_files import save_csv_parts, save_npz
from jaxcal.progress import Progress
from jaxcal.files import require_writable_folder, write_text
from jaxcal.paper.datasets.data_card import card_of, digest_of, page_of
from jaxcal.paper.datasets.datasets import EPISODES, NAMES, chunks

__all__ = ["main", "write_datasets"]

_DESCRIPTION = """\
Write the paper's Datasets 0 to 5 to a folder: NAME.npz, NAME.csv and the data card
NAME.json of each, and README.md, the cards as a page. dataset0 is simulated in MuJoCo
(some seconds), dataset1 takes 240 MB as .npz and 670 MB as .csv, dataset4 and dataset5
are made from recordings.
"""


def write_datasets(
    folder: pathlib.Path,
    names: list[str],
    seed: int = 0,
    *,
    episodes: int | None = None,
    formats: tuple[str, ...] = ("npz", "csv"),
    recordings: pathlib.Path | None = None,
    progress: Progress | None = None,
) -> list[pathlib.Path]:
    """Write datasets, one whole file after the other.

    Args:
        folder: made when missing.
        names: of ``NAMES``.
        seed: of all of them.
        episodes: at most the first so many of each.
        formats: npz, csv or both.
        recordings: folder of dataset4.csv and dataset5.csv; the shipped one when None.
        progress: told how far each is.

    Returns:
        The files.

    Raises:
        OSError: the folder cannot be written, or a recording not be read.
        ValueError: of an argument or a recording.
    """
    progress = progress or Progress(quiet=True)
    folder.mkdir(parents=True, exist_ok=True)
    written, cards = [], []
    for name in names:
        total = EPISODES[name] if episodes is None else min(episodes, EPISODES[name])
        parts = _counted(
            chunks(name, seed, total, recordings=recordings, progress=progress),
            f"draw {name}",
            total,
            progress,
        )
        whole = _joined(list(parts))
        digests = {}
        for kind in formats:
            path = folder / f"{name}.{kind}"
            if kind == "npz":
                save_npz(whole, path)
            else:
                pieces = [
                    whole.part(begin, begin + 1000)
                    for begin in range(0, whole.num_episodes, 1000)
                ]
                task = f"write {path.name}"
                save_csv_parts(_counted(iter(pieces), task, total, progress), path)
            written.append(path)
            digests[path.name] = digest_of(path)
        cards.append(card_of(whole, digests, recordings=recordings))
        path = folder / f"{name}.json"
        write_text(path, json.dumps(cards[-1], indent=2) + "\n")
        written.append(path)
    progress.clear()
    write_text(folder / "README.md", page_of(cards))
    return [*written, folder / "README.md"]


def _counted(
    parts: Iterator[Dataset], task: str, total: int, progress: Progress
) -> Iterator[Dataset]:
    done = 0
    progress(task, 0, total)
    for part in parts:
        yield part
        done += part.num_episodes
        progress(task, done, total)


def _joined(parts: list[Dataset]) -> Dataset:
    measured = [part.measured for part in parts if part.measured is not None]
    return dataclasses.replace(
        parts[0],
        candidates=np.concatenate([part.candidates for part in parts]),
        measured=np.concatenate(measured) if measured else None,
    )


def main(arguments: list[str] | None = None) -> int:
    """Write; the exit code."""
    options = _parse(arguments)
    progress = Progress(quiet=options.quiet)
    try:
        require_writable_folder(options.out)
        files = write_datasets(
            options.out,
            list(dict.fromkeys(options.names)) or list(NAMES),
            options.seed,
            episodes=options.episodes,
            formats=tuple(dict.fromkeys(options.formats.split(","))),
            recordings=options.recordings,
            progress=progress,
        )
    except KeyboardInterrupt:
        progress.clear()
        print("datasets: interrupted; files already named are whole", file=sys.stderr)
        return 130
    except (ValueError, OSError) as error:
        progress.clear()
        print(f"datasets: error: {_one_line(error)}", file=sys.stderr)
        return 2
    for file in files:
        print(f"saved: {file}")
    return 0


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m jaxcal.paper.datasets.datasets",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; all")
    add("--out", type=pathlib.Path, required=True, metavar="DIR")
    add("--seed", type=int, default=0, metavar="S", help="of every dataset; 0")
    add("--episodes", type=int, metavar="N", help="at most the first N of each")
    add("--formats", default="npz,csv", metavar="LIST", help="npz,csv")
    add(
        "--recordings",
        type=pathlib.Path,
        metavar="DIR",
        help="folder of dataset4.csv and dataset5.csv, your own; the shipped ones",
    )
    add("--quiet", action="store_true", help="no progress")
    options = parser.parse_args(arguments)
    for name in options.names:
        if name not in NAMES:
            parser.error(f"NAME must be one of {', '.join(NAMES)}, got {name!r}")
    for kind in options.formats.split(","):
        if kind not in ("npz", "csv"):
            parser.error(f"--formats must be npz, csv or both, got {kind!r}")
    if options.episodes is not None and options.episodes < 1:
        parser.error(f"--episodes must be at least 1, got {options.episodes}")
    return options
