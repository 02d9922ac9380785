"""``python evaluate.py`` and ``jaxcal evaluate``: parse, evaluate, print, write."""

from __future__ import annotations

import argparse
import functools
import pathlib
import signal
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NoReturn

from jaxcal.arguments import Parser, refused
from jaxcal.commands import evaluate_task
from jaxcal.extras import MissingExtraError, needs
from jaxcal.files import require_writable_folder

if TYPE_CHECKING:
    from jaxcal.evaluation.dataset import Dataset
    from jaxcal.evaluation.results import Evaluation, Summary
    from jaxcal.progress import Progress

__all__ = ["main"]

EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143


def main(argv: Sequence[str] | None = None, prog: str = "jaxcal evaluate") -> int:
    """Evaluate, print, write.

    Args:
        argv: the command line; that of the process when None.
        prog: what was typed before it, for messages and the record.

    Returns:
        The exit code.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    command = ["python", prog] if prog.endswith(".py") else prog.split()
    of_task = any(word.partition("=")[0] == "--task" for word in given)
    kept, before = "nothing was written", signal.signal(signal.SIGTERM, _terminate)
    try:
        options = _parser(of_task, prog, " ".join(command)).parse_args(given)
        options.command = [*command, *given]
        if not of_task and options.stream is not None:
            kept = "finished parts are kept; the same command goes on"
        (evaluate_task.run if of_task else _run)(options)
    except KeyboardInterrupt as stop:
        terminated = isinstance(stop, _Terminated)
        how = "terminated" if terminated else "interrupted"
        print(f"{prog}: {how}, {kept}", file=sys.stderr)
        return EXIT_TERMINATED if terminated else EXIT_INTERRUPTED
    except (ValueError, OSError, MissingExtraError) as error:
        return refused(prog, error)
    finally:
        signal.signal(signal.SIGTERM, before)
    return 0


def _parser(of_task: bool, prog: str, typed: str) -> Parser:
    if of_task:
        with needs("policy", prog):
            return evaluate_task.parser(prog, typed)
    from jaxcal.commands.evaluate_arguments import parser

    return parser(prog, typed)


class _Terminated(KeyboardInterrupt):
    """SIGTERM, which ends the command as Ctrl-C does."""


def _terminate(number: int, frame: object) -> NoReturn:
    raise _Terminated


def _run(options: argparse.Namespace) -> None:
    with needs("study", "evaluate"):
        from jaxcal.progress import Progress
    from jaxcal.evaluation.methods import POLICIES, check_methods
    from jaxcal.evaluation.report import json_document, text_table, write_report
    from jaxcal.files import write_text

    options.methods = check_methods(options.methods)
    if options.checkpoint:
        if not set(options.methods) & set(POLICIES):
            raise ValueError(
                "--checkpoint is given, but no policy is among --methods "
                f"{','.join(options.methods)}"
            )
        with needs("policy", "--checkpoint"):  # it may need JAX
            from jaxcal.learning.runtime import cache
        cache.keep_compiled_programs()
    _check_outputs(options)
    options.checkpoint = list(dict.fromkeys(options.checkpoint)) or [None]
    options.dataset = list(dict.fromkeys(options.dataset)) or ["dataset2"]
    many = len(options.checkpoint) > 1
    summaries: list[Summary] = []
    whole: list[Evaluation] = []
    evaluated = _whole if options.stream is None else _streamed
    progress = Progress(quiet=options.quiet)
    try:
        for summary, evaluation in evaluated(options, progress):
            progress.clear()
            if summaries:
                print()
            print(text_table(summary, many=many), flush=True)
            summaries.append(summary)
            whole += [] if evaluation is None else [evaluation]
    finally:
        progress.clear()
    if options.report is not None:
        runs = _run_folders(options.run, options.checkpoint)
        number = write_report(
            options.report, whole, runs, command=options.command, many=many
        )
        print(f"saved: {options.report}/index.html and {number} figures")
    if options.json is not None and summaries:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        write_text(options.json, json_document(summaries, command=options.command))
        print(f"saved: {options.json}")


def _whole(
    options: argparse.Namespace, progress: Progress
) -> Iterator[tuple[Summary, Evaluation]]:
    """Every dataset, read or made before the first is evaluated."""
    from jaxcal.evaluation.methods import evaluate

    for dataset in [_dataset(name, options, progress) for name in options.dataset]:
        found = evaluate(
            dataset,
            options.k,
            options.methods,
            options.checkpoint,
            num=options.num,
            random_draws=options.draws,
            seed=options.seed,
            time_limit=options.time_limit,
            progress=progress,
        )
        yield found.summarise(indices=options.indices), found


def _dataset(name: str, options: argparse.Namespace, progress: Progress) -> Dataset:
    """The first episodes of one of the paper's datasets, or of a file."""
    from jaxcal.evaluation.dataset_files import load_dataset
    from jaxcal.paper.constants import EPISODES

    if name in EPISODES:
        with needs("study", f"--dataset {name}"):
            from jaxcal.paper.datasets import make_dataset

            count = min(options.episodes or EPISODES[name], EPISODES[name])
            known = {"recordings": options.recordings, "progress": progress}
            return make_dataset(name, options.seed, count, **known)
    if pathlib.Path(name).suffix.lower() not in (".npz", ".csv"):
        raise ValueError(
            f"--dataset must be one of {', '.join(EPISODES)} or a .npz or .csv file, "
            f"got {name!r}"
        )
    dataset = load_dataset(name)
    return dataset if options.episodes is None else dataset.part(0, options.episodes)


def _streamed(
    options: argparse.Namespace, progress: Progress
) -> Iterator[tuple[Summary, None]]:
    """One dataset in parts."""
    from jaxcal.evaluation.stream import evaluate_stream
    from jaxcal.paper.datasets.datasets import drawn

    whole = {
        "--report": options.report is not None,
        "--indices": options.indices,
        "--time-limit": options.time_limit is not None,
    }
    for flag in (flag for flag, given in whole.items() if given):
        raise ValueError(f"{flag} needs every episode at once and --stream keeps none")
    if len(options.dataset) > 1:
        raise ValueError(
            f"--stream takes one dataset, got {', '.join(options.dataset)}"
        )
    if options.episodes is None:
        raise ValueError("--stream needs --episodes")
    (name,) = options.dataset
    plan = {
        "dataset": name,
        "seed": options.seed,
        "k": options.k,
        "methods": options.methods,
        "checkpoints": options.checkpoint,
        "num": options.num,
        "random_draws": options.draws,
    }
    draw = functools.partial(drawn, name, options.seed)
    yield evaluate_stream(draw, options.episodes, options.stream, plan, progress), None


def _check_outputs(options: argparse.Namespace) -> None:
    """Refuse outputs that cannot be written before anything is computed."""
    evaluate_task.require_outputs(options)
    if options.stream is not None:
        require_writable_folder(options.stream)
    for folder in options.run:
        if not (folder / "metrics.csv").is_file():
            raise ValueError(f"--run {folder} holds no metrics.csv")
        if options.report is None:
            raise ValueError("--run draws training curves and needs --report")


def _run_folders(
    given: list[pathlib.Path], checkpoints: list[str | None]
) -> list[pathlib.Path]:
    """Run folders named, and those the checkpoints lie in."""
    found = list(given)
    for checkpoint in filter(None, checkpoints):
        folder = pathlib.Path(checkpoint)
        near = [folder, *folder.resolve().parents[:2]]
        found += [place for place in near if (place / "metrics.csv").is_file()][:1]
    return list({place.resolve(): place for place in found}.values())
