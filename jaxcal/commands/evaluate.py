"""``python evaluate.py`` and ``jaxcal evaluate``: parse, evaluate, print, write.

Methods that select postures, or with ``--task`` deciders of sequential measurement.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import signal
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

from jaxcal.arguments import (
    Parser,
    exit_code,
    several,
    told,
    typed_line,
    values_of,
)
from jaxcal.extras import needs
from jaxcal.files import require_kept, require_writable_folder, write_text

if TYPE_CHECKING:
    from jaxcal.evaluation.dataset import Dataset
    from jaxcal.evaluation.report import Evaluation, Summary
    from jaxcal.progress import Progress


_POOLED = 1000  # episodes drawn of one table

_DESCRIPTION = """\
Every method chooses K postures in every episode of a dataset. The table compares the
determinant of their information matrix S with that of the best choice (S*).

columns:
  mean, median det S  larger is better; in the unit of the dataset's commands
  det S/det S*        mean over the episodes; 1 is optimal
  hit rate            share of episodes in which the optimum was found
  D-eff.              mean of (det S/det S*)^(1/p), p parameters (12 for 3 x 3)
  x random            mean det S divided by that of random selection (paper)
  time each           seconds per selection, mean of the batch, no compilation
"""

_EPILOG = """\
methods:
  policy              trained network; takes the most likely posture at every step
  policy:samples      the best of --num random selections of the network
  policy:first        the best after each of the --num most likely first postures
  policy:exchange     policy, then Fedorov exchange from its selection
  policy:all          all four, a row each
  random              --draws selections per episode, all counted
  greedy              adds the posture of the largest gain, K times
  exchange            Fedorov exchange with random restarts
  exact               the proven optimum
  auto                default of `select`: the cheapest way to a proven D-efficiency
                      of 0.999; runs only when named

datasets:
  dataset1 to 5       the paper's, drawn with --seed (200,000, 1,000, 100, 100 and 1
                      episodes); 4 and 5 from --recordings or the shipped ones
  FILE.npz            candidates (episodes, M, n); optional measured, available
  FILE.csv            episode,candidate,u_x,u_y,u_z[,y_x,y_y,y_z]

examples:
  {program}
      the shipped policy and every baseline on 1,000 unseen sets of 50 postures
  {program} --checkpoint runs/a runs/b --methods policy,exact --json out.json
      two trainings side by side, numbers as JSON
  {program} --dataset dataset3 mine.npz --report report
      figures and report/index.html; dataset3 has outputs: parameters are fitted too
  {program} --methods random,greedy,exact --k 8 --episodes 100
      eight of fifty postures; loads no JAX
  {program} --task knee
      deciders of sequential measurement; {program} --task knee --help
  {program} --stream runs/ten_million --episodes 10000000
      any number of episodes in constant memory; the same command resumes, and the
      same command on another machine shares the work
"""


_DECIDERS = "random,gain,rate,shares,ahead,policy"
_TUNED = "priced,state"  # where the task brings their constants

_TASK_DESCRIPTION = """\
Deciders measure in the same sessions of a task. The table shows the information gained
in nats, the paired difference to the best rule, and the time per choice.
"""

_TASK_EPILOG = """\
methods:
{methods}

tasks:
{tasks}
  FILE.py    your own: a file that defines ENTRY (docs/own_task.md)

examples:
  {program} --task knee
  {program} --task knee --methods state,ahead,policy --episodes 512
  {program} --task knee --with sigma=0.05 cells=16 --retune --json out.json
"""


@dataclasses.dataclass(kw_only=True)
class Outputs:
    """Files that an evaluation writes, and whether it shows its progress."""

    json: Annotated[Path | None, "write every number"] = None
    report: Annotated[Path | None, "write figures and index.html", "DIR"] = None
    quiet: Annotated[bool, "no progress"] = False
    command: list[str] = dataclasses.field(init=False)

    def require_writable(self) -> None:
        """Refuse what cannot be written, before anything is computed."""
        if self.json is not None:
            if self.json.is_dir():
                raise ValueError(f"--json takes a file; {self.json} is a folder")
            require_writable_folder(self.json.parent)
        if self.report is not None:
            with needs("plots", "--report"):
                importlib.import_module("jinja2")
                importlib.import_module("matplotlib")
            require_writable_folder(self.report)


@dataclasses.dataclass(kw_only=True)
class TaskOptions(Outputs):
    """Options of ``--task``: what is played, and by which deciders."""

    task: Annotated[str, "see below"]
    with_: Annotated[tuple[str, ...], "options of the task", "OPTION=VALUE"] = ()
    methods: Annotated[
        list[str] | None,
        f"comma separated: {_DECIDERS}, {_TUNED} if the task has their constants, or "
        "the task's own",
        "LIST",
        several(str, "names"),
    ] = None
    checkpoint: Annotated[str | None, "policy; default the shipped", "DIR"] = None
    episodes: Annotated[
        int | None, "sessions; default 4096, fewer for a slow task", (2,)
    ] = None
    seed: Annotated[int, "of the sessions", "S", (0,)] = 0
    retune: Annotated[bool, "tune the rules on this task first"] = False


@dataclasses.dataclass(kw_only=True)
class EvaluateOptions(Outputs):
    """Options of an evaluation of postures: methods, policies and datasets."""

    checkpoint: Annotated[
        tuple[str, ...], "trained policies; default the shipped one", "DIR"
    ] = ()
    dataset: Annotated[tuple[str, ...], "datasets; dataset2", "NAME|FILE"] = ()
    recordings: Annotated[Path | None, "dataset4.csv, dataset5.csv", "DIR"] = None
    methods: Annotated[
        list[str] | None, "default: all but auto", "A,B", several(str, "names")
    ] = None
    k: Annotated[int, "postures to choose", "K", (1,)] = 4
    episodes: Annotated[int | None, "at most the first N of each", (1,)] = None
    seed: Annotated[int, "seed of datasets and draws", "S", (0,)] = 0
    num: Annotated[int, "samples of policy:samples and :first", (1,)] = 16
    draws: Annotated[int, "random selections per episode", (1,)] = 100
    time_limit: Annotated[
        float | None,
        "time limit of the exact solver per dataset; unproven optima are bounded",
        "SECONDS",
        (1e-3,),
    ] = None
    indices: Annotated[bool, "add the chosen postures to the JSON"] = False
    run: Annotated[
        tuple[Path, ...],
        "training runs to draw learning curves of, besides those of --checkpoint",
        "DIR",
    ] = ()
    stream: Annotated[
        Path | None,
        "evaluate in parts kept in DIR, which can be resumed: any number of --episodes",
        "DIR",
    ] = None

    @property
    def checkpoints(self) -> list[str | None]:
        """Each once; None is the shipped one."""
        return [*dict.fromkeys(self.checkpoint)] or [None]

    @property
    def datasets(self) -> list[str]:
        """Each once."""
        return [*dict.fromkeys(self.dataset)] or ["dataset2"]


def main(argv: Sequence[str] | None = None, prog: str = "jaxcal evaluate") -> int:
    """Evaluate, print, write.

    Args:
        argv: the command line; that of the process when None.
        prog: what was typed before it, for messages and the record.

    Returns:
        The exit code.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    command = ["python", prog] if prog.endswith(".py") else prog.split()
    flags = {word.partition("=")[0] for word in words}
    kept = "nothing was written"
    if "--stream" in flags and "--task" not in flags:
        kept = "finished parts are kept; run the same command again to resume"

    def run() -> None:
        made = parser(prog, typed_line(prog), "--task" in flags).parse_args(words)
        options = values_of(made)["options"]
        options.command = [*command, *words]
        require_kept(vars(made))
        with told():
            made.function(options)

    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        return exit_code(run, prog, kept)
    finally:
        signal.signal(signal.SIGTERM, before)


def parser(prog: str, typed: str, of_task: bool = False) -> Parser:
    """The parser: ``prog`` begins a message, ``typed`` an example of the help."""
    if not of_task:
        more = _EPILOG.format(program=typed)
        return Parser(prog=prog, description=_DESCRIPTION, epilog=more).of(_run)
    with needs("policy", "--task"):
        from jaxcal.learning.runtime import cache

        cache.keep_compiled_programs()  # before JAX is loaded
        from jaxcal.adaptive.evaluation import METHODS
        from jaxcal.adaptive.tasks import registry

    tasks = {name: registry.load(name).about for name in registry.names()}
    more = _TASK_EPILOG.format(
        methods=_listed(METHODS), tasks=_listed(tasks), program=typed
    )
    return Parser(prog=prog, description=_TASK_DESCRIPTION, epilog=more).of(_run_task)


def _listed(abouts: Mapping[str, str]) -> str:
    return "\n".join(f"  {name:10} {about}" for name, about in abouts.items())


def _terminate(number: int, frame: object) -> NoReturn:
    """SIGTERM ends the command as Ctrl-C does."""
    raise KeyboardInterrupt("terminated")


def _run(options: EvaluateOptions) -> None:
    from jaxcal.evaluation.methods import DEFAULT_METHODS, POLICIES, check_methods
    from jaxcal.progress import Progress

    asked = DEFAULT_METHODS if options.methods is None else options.methods
    methods = check_methods(asked)
    if options.checkpoint:
        if not set(methods) & set(POLICIES):
            raise ValueError(
                "--checkpoint is given, but no policy is among --methods "
                f"{','.join(methods)}"
            )
        with needs("policy", "--checkpoint"):  # it may need JAX
            from jaxcal.learning.runtime import cache
        cache.keep_compiled_programs()
    _check_outputs(options)
    evaluated = _whole if options.stream is None else _streamed
    progress = Progress(quiet=options.quiet)
    runs = _run_folders(options.run, options.checkpoints)
    whole = evaluated(options, methods, progress)
    _show(
        options, whole, "jaxcal.evaluation.figures:evaluation_figures", progress, runs
    )


def _show(
    options: Outputs,
    evaluated: Iterator[tuple[Summary, Evaluation | None]],
    figures: str,
    progress: Progress,
    runs: Sequence[Path] = (),
) -> None:
    from jaxcal.evaluation.report import json_document, text_table, write_report

    summaries: list[Summary] = []
    whole: list[Evaluation] = []
    try:
        for summary, evaluation in evaluated:
            progress.clear()
            if summaries:
                print()
            print(text_table(summary), flush=True)
            summaries.append(summary)
            whole += [] if evaluation is None else [evaluation]
    finally:
        progress.clear()
    if options.report is not None:
        module, _, name = figures.partition(":")
        draw = getattr(importlib.import_module(module), name)
        count = write_report(options.report, whole, draw, runs, command=options.command)
        drawn = "1 figure" if count == 1 else f"{count} figures"
        print(f"saved: {options.report}/index.html and {drawn}")
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        write_text(options.json, json_document(summaries, command=options.command))
        print(f"saved: {options.json}")


def _whole(
    options: EvaluateOptions, methods: Sequence[str], progress: Progress
) -> Iterator[tuple[Summary, Evaluation]]:
    """Every dataset, read or made before the first is evaluated."""
    from jaxcal.evaluation.methods import evaluate

    for dataset in [_dataset(name, options) for name in options.datasets]:
        evaluation = evaluate(
            dataset,
            options.k,
            methods,
            options.checkpoints,
            num=options.num,
            random_draws=options.draws,
            seed=options.seed,
            time_limit=options.time_limit,
            progress=progress,
        )
        yield evaluation.summarise(indices=options.indices), evaluation


def _dataset(name: str, options: EvaluateOptions) -> Dataset:
    from jaxcal.commands.tables import draw_sets, holds_sets
    from jaxcal.evaluation.dataset import Dataset, load_dataset
    from jaxcal.paper.datasets import EPISODES

    if name in EPISODES:
        from jaxcal.paper.datasets import make_dataset

        count = min(options.episodes or EPISODES[name], EPISODES[name])
        return make_dataset(name, options.seed, count, recordings=options.recordings)
    if Path(name).suffix.lower() not in (".npz", ".csv"):
        raise ValueError(
            f"--dataset takes {', '.join(EPISODES)}, or a .npz or .csv file, got "
            f"{name!r}"
        )
    if not holds_sets(name):
        sets = draw_sets(name, options.episodes or _POOLED, options.seed)
        return Dataset(name=Path(name).name, candidates=sets, seed=options.seed)
    dataset = load_dataset(name)
    return dataset if options.episodes is None else dataset.part(0, options.episodes)


def _streamed(
    options: EvaluateOptions, methods: Sequence[str], progress: Progress
) -> Iterator[tuple[Summary, None]]:
    assert options.stream is not None  # it was given
    from jaxcal.evaluation.methods import evaluate_stream
    from jaxcal.paper.datasets import drawn

    whole = {
        "--report": options.report is not None,
        "--indices": options.indices,
        "--time-limit": options.time_limit is not None,
    }
    for flag in (flag for flag, value in whole.items() if value):
        raise ValueError(f"{flag} needs all episodes in memory: not with --stream")
    if len(options.datasets) > 1:
        raise ValueError(
            f"--stream takes one dataset, got {', '.join(options.datasets)}"
        )
    if options.episodes is None:
        raise ValueError("--stream needs --episodes")
    (name,) = options.datasets
    plan = {
        "dataset": name,
        "seed": options.seed,
        "k": options.k,
        "methods": methods,
        "checkpoints": options.checkpoints,
        "num": options.num,
        "random_draws": options.draws,
    }
    draw = functools.partial(drawn, name, options.seed)
    yield evaluate_stream(draw, options.episodes, options.stream, plan, progress), None


def _check_outputs(options: EvaluateOptions) -> None:
    options.require_writable()
    if options.stream is not None:
        require_writable_folder(options.stream)
    for folder in options.run:
        if not (folder / "metrics.csv").is_file():
            raise ValueError(f"--run {folder} holds no metrics.csv")
        if options.report is None:
            raise ValueError("--run draws training curves and needs --report")


def _run_folders(given: Sequence[Path], checkpoints: list[str | None]) -> list[Path]:
    found = list(given)
    for checkpoint in filter(None, checkpoints):
        folder = Path(checkpoint)
        near = [folder, *folder.resolve().parents[:2]]
        found += [place for place in near if (place / "metrics.csv").is_file()][:1]
    return list({place.resolve(): place for place in found}.values())


def _run_task(options: TaskOptions) -> None:
    from jaxcal.progress import Progress

    options.require_writable()
    progress, figures = Progress(quiet=options.quiet), "jaxcal.adaptive.evaluation"
    _show(options, _sessions(options, progress), f"{figures}:decider_figures", progress)


def _sessions(
    options: TaskOptions, progress: Progress
) -> Iterator[tuple[Summary, Evaluation]]:
    """The methods on the sessions of the task."""
    from jaxcal.adaptive import evaluation as sequential
    from jaxcal.adaptive.tasks import registry

    entry = registry.load(options.task)
    methods = options.methods or list(entry.methods)
    if not methods:
        tuned = [m for m in _TUNED.split(",") if m in entry.rules or options.retune]
        methods = _DECIDERS.split(",")
        methods[5:5] = tuned
    if options.checkpoint is not None and "policy" not in methods:
        if options.methods:
            raise ValueError("--checkpoint is given, but policy is not among --methods")
        methods.append("policy")
    evaluation = sequential.evaluate(
        options.task,
        entry,
        registry.options_from(entry, options.with_),
        methods,
        checkpoint=options.checkpoint,
        episodes=options.episodes or entry.episodes,
        seed=options.seed,
        retune=options.retune,
        progress=progress,
    )
    yield evaluation.summarise(), evaluation
