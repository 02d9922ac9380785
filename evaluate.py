"""How close each way of choosing postures comes to the proven optimum."""

from __future__ import annotations

import argparse
import contextlib
import pathlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

if TYPE_CHECKING:
    from jaxcal.evaluation.dataset import Dataset
    from jaxcal.progress import Progress
    from jaxcal.evaluation.results import Evaluation

EXIT_OK = 0
EXIT_ERROR = 2
EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143

_DESCRIPTION = """\
Let every method choose K postures in every episode of a dataset, and compare the
determinant of the information matrix S with that of the best choice there is (S*).

columns:
  mean, median det S  larger is better; in the unit of the dataset's commands
  det S/det S*        mean over the episodes; 1 is optimal
  hit rate            share of episodes in which the optimum itself was found
  D-eff.              mean of (det S/det S*)^(1/p), p parameters (12 for 3 x 3)
  x random            mean det S over that of random selection, the paper's measure
  time each           seconds a selection, averaged over the batch, compilation left out
"""

_EPILOG = """\
methods:
  policy              the trained network, likeliest posture at every step
  policy:samples      the best of --num sampled passes
  policy:first        each of the --num likeliest first postures, completed; the best
  policy:exchange     policy, then Fedorov exchange from what it chose
  policy:all          all four
  random              --draws selections an episode, all counted
  greedy              the posture that adds most, K times
  exchange            Fedorov exchange with random restarts
  exact               the proven optimum
  auto                the policy where it proves a D-efficiency of 0.999, else exact;
                      not among the methods run by default

datasets:
  dataset0 to 5       the paper's, made from --seed (200, 200,000, 1,000, 100, 100 and
                      1 episodes); 4 and 5 from --recordings, or those that ship
  FILE.npz            candidates (episodes, M, n); optional measured, available
  FILE.csv            episode,candidate,u_x,u_y,u_z[,y_x,y_y,y_z]

examples:
  python evaluate.py
      the shipped policy and every baseline on 1,000 unseen sets of 50 postures
  python evaluate.py --checkpoint runs/a runs/b --methods policy,exact --json out.json
      two trainings side by side, the numbers for a script
  python evaluate.py --dataset dataset3 mine.npz --report report
      figures and report/index.html; dataset3 holds outputs, so parameters too
  python evaluate.py --methods random,greedy,exact --k 8 --episodes 100
      eight of fifty postures; loads no JAX
  python evaluate.py --stream runs/ten_million --episodes 10000000
      any number of episodes in constant memory; the same command goes on where it
      stopped; under srun, or with --coordinator, many processes share the work
"""


class _Parser(argparse.ArgumentParser):
    """One clear line instead of the usage and a line."""

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: error: {message}; see --help", file=sys.stderr)
        sys.exit(EXIT_ERROR)


def main(arguments: list[str] | None = None) -> int:
    """Evaluate, print, write; the exit code."""
    from jaxcal.learning.runtime import processes

    advice = "finished parts stay: start every process again"
    return processes.run_job(
        "evaluate.py", arguments, lambda: _alone(arguments), advice
    )


def _alone(arguments: list[str] | None) -> int:
    """The command in this process, which may be one of several."""
    from jaxcal.learning.runtime import cache
    from jaxcal.progress import Progress

    options = _parse(arguments)
    cache.keep_compiled_programs()
    progress = Progress(quiet=options.quiet)
    try:
        with _stopped_by_sigterm():
            return _evaluate(options, progress)
    except KeyboardInterrupt as stop:
        progress.clear()
        terminated = isinstance(stop, _Terminated)
        kept = "nothing was written"
        if options.stream is not None:
            kept = "finished parts are kept; the same command goes on"
        how = "terminated" if terminated else "interrupted"
        print(f"evaluate.py: {how}, {kept}", file=sys.stderr)
        return EXIT_TERMINATED if terminated else EXIT_INTERRUPTED
    except (ValueError, OSError) as error:
        progress.clear()
        print(f"evaluate.py: error: {_one_line(error)}", file=sys.stderr)
        return EXIT_ERROR


class _Terminated(KeyboardInterrupt):
    """SIGTERM, which ends the command as Ctrl-C does."""


@contextlib.contextmanager
def _stopped_by_sigterm() -> Iterator[None]:
    def stop(number: int, frame: object) -> NoReturn:
        raise _Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _evaluate(options: argparse.Namespace, progress: Progress) -> int:
    from jaxcal.evaluation.methods import POLICIES, check_methods, evaluate
    from jaxcal.evaluation.report import text_table

    methods = check_methods([name for name in options.methods.split(",") if name])
    if options.checkpoint and not any(
        method in (*POLICIES, "auto") for method in methods
    ):
        raise ValueError(
            "--checkpoint is given, but no policy is among --methods "
            f"{','.join(methods)}"
        )
    _check_outputs(options)
    if options.stream is not None:
        return _evaluate_stream(options, methods, progress)
    if _process()[1] > 1:
        raise ValueError("several processes can share an evaluation with --stream only")
    checkpoints: list[str | None] = list(dict.fromkeys(options.checkpoint)) or [None]
    datasets = [
        _dataset(name, options, progress) for name in dict.fromkeys(options.dataset)
    ]
    evaluations = []
    for dataset in datasets:
        evaluations.append(
            evaluate(
                dataset,
                options.k,
                methods,
                checkpoints,
                num=options.num,
                random_draws=options.draws,
                seed=options.seed,
                time_limit=options.time_limit,
                progress=progress,
            )
        )
        progress.clear()
        if len(evaluations) > 1:
            print()
        print(text_table(evaluations[-1], many=len(checkpoints) > 1), flush=True)
    if options.report is not None:
        command = ["python", "evaluate.py", *(options.arguments or [])]
        _write_report(options, evaluations, checkpoints, command)
    _write_json(options, evaluations)
    return EXIT_OK


def _write_json(options: argparse.Namespace, evaluations: Sequence[Any]) -> None:
    from jaxcal.evaluation.report import json_document
    from jaxcal.files import write_text

    if options.json is None:
        return
    command = ["python", "evaluate.py", *(options.arguments or [])]
    text = json_document(evaluations, command=command, indices=options.indices)
    options.json.parent.mkdir(parents=True, exist_ok=True)
    write_text(options.json, text)
    print(f"saved: {options.json}")


def _evaluate_stream(
    options: argparse.Namespace, methods: tuple[str, ...], progress: Progress
) -> int:
    """Any number of episodes, in parts; of several processes the first prints."""
    from jaxcal.evaluation.report import text_table
    from jaxcal.evaluation.streaming import Plan, evaluate_stream, open_folder

    refused = {
        "--report": options.report is not None,
        "--indices": options.indices,
        "--time-limit": options.time_limit is not None,
    }
    for flag in [flag for flag, given in refused.items() if given]:
        raise ValueError(f"{flag} needs every episode at once and --stream keeps none")
    names = list(dict.fromkeys(options.dataset))
    if len(names) > 1:
        raise ValueError(f"--stream takes one dataset, got {', '.join(names)}")
    if options.episodes is None:
        raise ValueError("--stream needs --episodes")
    checkpoints: list[str | None] = list(dict.fromkeys(options.checkpoint)) or [None]
    plan = Plan(
        dataset=names[0],
        seed=options.seed,
        k=options.k,
        methods=methods,
        checkpoints=tuple(checkpoints),
        num=options.num,
        draws=options.draws,
    )
    process = _process()
    _on_first(lambda: open_folder(plan, options.stream))
    if not (options.stream / "stream.json").exists():
        raise ValueError(
            f"--stream {options.stream} must be a folder that all processes see; "
            f"process {process[0]} does not"
        )
    found = evaluate_stream(
        plan,
        options.episodes,
        options.stream,
        workers=options.workers,
        process=process,
        progress=progress,
    )
    progress.clear()
    if process[0] == 0:
        print(text_table(found, many=len(checkpoints) > 1), flush=True)
        _write_json(options, [found])
    return EXIT_OK


def _process() -> tuple[int, int]:
    """Which process this is, and of how many; one that holds no JAX is alone."""
    if "jax" not in sys.modules:
        return 0, 1
    import jax

    if not jax.distributed.is_initialized():
        return 0, 1
    return jax.process_index(), jax.process_count()


def _on_first(function: Callable[[], None]) -> None:
    if _process()[1] == 1:
        function()
        return
    from jaxcal.learning.runtime import devices

    devices.on_first(function)


def _dataset(name: str, options: argparse.Namespace, progress: Progress) -> Dataset:
    from jaxcal.evaluation.dataset_files import load_dataset
    from jaxcal.paper.datasets import datasets

    if name in datasets.NAMES:
        limit = datasets.EPISODES[name]
        episodes = limit if options.episodes is None else min(options.episodes, limit)
        dataset = datasets.make_dataset(
            name,
            options.seed,
            episodes,
            recordings=options.recordings,
            progress=progress,
        )
        progress.clear()
        return dataset
    if pathlib.Path(name).suffix.lower() not in (".npz", ".csv"):
        raise ValueError(
            f"--dataset must be one of {', '.join(datasets.NAMES)} or a .npz or .csv "
            f"file, got {name!r}"
        )
    dataset = load_dataset(name)
    if options.episodes is None:
        return dataset
    return dataset.first(min(options.episodes, dataset.num_episodes))


def _check_outputs(options: argparse.Namespace) -> None:
    """Refuse outputs that cannot be written before anything is computed."""
    from jaxcal.files import require_writable_folder

    if options.json is not None:
        if options.json.is_dir():
            raise ValueError(f"--json must be a file, {options.json} is a folder")
        require_writable_folder(options.json.parent)
    if options.report is not None:
        require_writable_folder(options.report)
    if options.stream is not None:
        require_writable_folder(options.stream)
    elif options.workers is not None:
        raise ValueError("--workers needs --stream")
    for folder in options.run:
        if not (folder / "metrics.csv").is_file():
            raise ValueError(f"--run {folder} holds no metrics.csv")
        if options.report is None:
            raise ValueError("--run draws training curves and needs --report")


def _write_report(
    options: argparse.Namespace,
    evaluations: list[Evaluation],
    checkpoints: list[str | None],
    command: list[str],
) -> None:
    """Draw everything, then write everything, the page last."""
    from jaxcal.evaluation.figures import evaluation_figures
    from jaxcal.evaluation.report import file_prefix, html_page
    from jaxcal.evaluation.training_figure import training_curves
    from jaxcal.files import atomic_write
    from jaxcal.plots import as_bytes

    figures = {}
    for number, evaluation in enumerate(evaluations):
        prefix = file_prefix(evaluations, number)
        for name, figure in evaluation_figures(evaluation).items():
            figures[f"{prefix}_{name}"] = figure
    runs = _run_folders(options.run, checkpoints)
    for number, folder in enumerate(runs):
        suffix = f"_{number + 1}" if len(runs) > 1 else ""
        figures[f"training_curves{suffix}"] = training_curves(folder)
    images = {name: as_bytes(figure, "svg") for name, figure in figures.items()}
    files = {f"{name}.svg": data for name, data in images.items()}
    files |= {
        f"{name}.png": as_bytes(figure, "png") for name, figure in figures.items()
    }
    many = len(checkpoints) > 1
    page = html_page(evaluations, images, command=command, many=many)
    files["index.html"] = page.encode("utf-8")
    options.report.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        with atomic_write(options.report / name) as file:
            file.write(data)
    print(f"saved: {options.report}/index.html and {len(figures)} figures")


def _run_folders(
    given: list[pathlib.Path], checkpoints: list[str | None]
) -> list[pathlib.Path]:
    """Run folders named, and those the checkpoints lie in."""
    found = list(given)
    for checkpoint in checkpoints:
        if checkpoint is None:
            continue
        folder = pathlib.Path(checkpoint)
        near = [folder, *folder.resolve().parents[:2]]
        found += [place for place in near if (place / "metrics.csv").is_file()][:1]
    return list({place.resolve(): place for place in found}.values())


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or type(error).__name__


def _at_least(least: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            number = least - 1
        if number < least:
            raise argparse.ArgumentTypeError(
                f"must be a whole number of at least {least}, got {text!r}"
            )
        return number

    return parse


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be seconds above 0, got {text!r}")
    return value


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    from jaxcal.learning.runtime import processes

    parser = _Parser(
        prog="evaluate.py",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    add = parser.add_argument
    several: dict[str, Any] = {"nargs": "+", "action": "extend", "default": []}
    add(
        "--checkpoint",
        metavar="DIR",
        help="trained policies; the shipped one",
        **several,
    )
    add("--dataset", metavar="NAME|FILE", help="datasets; dataset2", **several)
    add(
        "--recordings",
        type=pathlib.Path,
        metavar="DIR",
        help="folder of dataset4.csv and dataset5.csv, recorded by the rig",
    )
    add("--methods", help="comma separated; all", metavar="LIST")
    add("--k", type=_at_least(1), default=4, help="postures to choose; 4")
    add(
        "--episodes", type=_at_least(1), metavar="N", help="at most the first N of each"
    )
    add(
        "--seed",
        type=_at_least(0),
        default=0,
        metavar="S",
        help="of datasets and draws; 0",
    )
    add(
        "--num",
        type=_at_least(1),
        default=16,
        help="tries of policy:samples and :first",
    )
    add(
        "--draws",
        type=_at_least(1),
        default=100,
        help="random selections an episode; 100",
    )
    add(
        "--time-limit",
        type=_seconds,
        metavar="SECONDS",
        help="of the exact solver, a dataset; what it cannot prove is bounded",
    )
    add("--json", type=pathlib.Path, metavar="FILE", help="write every number")
    add("--indices", action="store_true", help="and the postures chosen, in the JSON")
    add(
        "--report",
        type=pathlib.Path,
        metavar="DIR",
        help="write figures and index.html",
    )
    add(
        "--run",
        type=pathlib.Path,
        metavar="DIR",
        help="training runs to draw curves of; those of --checkpoint are found",
        **several,
    )
    add(
        "--stream",
        type=pathlib.Path,
        metavar="DIR",
        help="evaluate in parts kept in DIR: any number of --episodes, resumable",
    )
    add(
        "--workers",
        type=_at_least(1),
        metavar="N",
        help="processes of --stream for the baselines; one a core",
    )
    add("--quiet", action="store_true", help="no progress")
    processes.add_arguments(parser)
    given = sys.argv[1:] if arguments is None else arguments
    options = parser.parse_args(given)
    options.arguments = given
    options.dataset = options.dataset or ["dataset2"]
    if options.methods is None:
        from jaxcal.evaluation.methods import DEFAULT_METHODS

        options.methods = ",".join(DEFAULT_METHODS)
    return options


if __name__ == "__main__":
    sys.exit(main())
