"""``python evaluate.py`` and ``jaxcal evaluate``: parse, evaluate, print, write.

Methods that select postures, or with ``--task`` deciders of sequential measurement.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

from jaxcal.arguments import Parser, exit_code, several, told, typed_line, values_of
from jaxcal.extras import needs
from jaxcal.files import require_kept, require_writable_folder, write_text

if TYPE_CHECKING:
    from jaxcal.evaluation.dataset import Dataset
    from jaxcal.evaluation.report import Evaluation, Summary
    from jaxcal.progress import Progress


_POOLED = 1000  # episodes drawn of one table

_DESCRIPTION = """\
Every method chooses K postures in every episode of a dataset. The table compares the
determinant of their information matrix S with that of the best choice (S*), as means
over the episodes: det S/det S*, the share of optima found (hit rate), (det S/det
S*)^(1/p) of p parameters (D-eff.), det S over that of random selection (x random).
"""

_EPILOG = """\
methods:
  policy              trained network; takes the most likely posture at every step
  policy:samples      the best of 16 random selections of the network
  policy:first        the best after each of the 16 most likely first postures
  policy:exchange     policy, then Fedorov exchange from its selection
  random              --draws selections per episode, all counted
  greedy              adds the posture of the largest gain, K times
  exchange            Fedorov exchange with random restarts
  exact               the proven optimum

datasets:
  dataset1 to 3       the paper's, drawn with --seed (200,000, 1,000 and 100 episodes)
  FILE.npz            candidates (episodes, M, n); optional measured, available
  FILE.csv            episode,candidate,u_x,u_y,u_z[,y_x,y_y,y_z]

examples:
  {program}
      the shipped policy and every baseline on 1,000 unseen sets of 50 postures
  {program} --checkpoint runs/a runs/b --methods policy,exact --json out.json
      two trainings side by side, numbers as JSON
  {program} --dataset dataset3 mine.npz --k 8 --report report
      eight of fifty postures of two datasets; figures and report/index.html
  {program} --task knee
      deciders of sequential measurement; {program} --task knee --help
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
    methods: Annotated[
        list[str] | None, "default: all", "A,B", several(str, "names")
    ] = None
    k: Annotated[int, "postures to choose", "K", (1,)] = 4
    episodes: Annotated[int | None, "at most the first N of each", (1,)] = None
    seed: Annotated[int, "seed of datasets and draws", "S", (0,)] = 0
    draws: Annotated[int, "random selections per episode", (1,)] = 100
    time_limit: Annotated[
        float | None,
        "time limit of the exact solver per dataset; unproven optima are bounded",
        "SECONDS",
        (1e-3,),
    ] = None
    indices: Annotated[bool, "add the chosen postures to the JSON"] = False

    @property
    def checkpoints(self) -> list[str | None]:
        """Each once; None is the shipped one."""
        return [*dict.fromkeys(self.checkpoint)] or [None]


def main(argv: Sequence[str] | None = None, prog: str = "jaxcal evaluate") -> int:
    """Evaluate, print, write; the exit code. ``prog`` is what was typed."""
    words = list(sys.argv[1:] if argv is None else argv)
    command = ["python", prog] if prog.endswith(".py") else prog.split()
    flags = {word.partition("=")[0] for word in words}

    def run() -> None:
        made = parser(prog, typed_line(prog), "--task" in flags).parse_args(words)
        options = values_of(made)["options"]
        options.command = [*command, *words]
        require_kept(vars(made))
        with told():
            made.function(options)

    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        return exit_code(run, prog, "nothing was written")
    finally:
        signal.signal(signal.SIGTERM, before)


def parser(prog: str, typed: str, of_task: bool = False) -> Parser:
    """The parser: ``prog`` begins a message, ``typed`` an example of the help."""
    if not of_task:
        more = _EPILOG.format(program=typed)
        return Parser(prog=prog, description=_DESCRIPTION, epilog=more).of(_run)
    with needs("policy", "--task"):
        from jaxcal.learning.runtime import processes

        processes.keep_compiled_programs()  # before JAX is loaded
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

    asked = DEFAULT_METHODS if options.methods is None else options.methods
    methods = check_methods(asked)
    if options.checkpoint:
        if not set(methods) & set(POLICIES):
            raise ValueError(
                "--checkpoint is given, but no policy is among --methods "
                f"{','.join(methods)}"
            )
        with needs("policy", "--checkpoint"):  # it may need JAX
            from jaxcal.learning.runtime import processes
        processes.keep_compiled_programs()
    options.require_writable()
    evaluated = functools.partial(_evaluations, options, methods)
    figures = "jaxcal.evaluation.figures:evaluation_figures"
    _show(options, evaluated, figures, _run_folders(options.checkpoints))


def _show(
    options: Outputs,
    evaluated: Callable[[Progress], Iterator[tuple[Summary, Evaluation]]],
    figures: str,
    runs: Sequence[Path] = (),
) -> None:
    from jaxcal.evaluation.report import json_document, text_table, write_report
    from jaxcal.progress import Progress

    progress = Progress(quiet=options.quiet)
    summaries: list[Summary] = []
    whole: list[Evaluation] = []
    try:
        for summary, evaluation in evaluated(progress):
            progress.clear()
            if summaries:
                print()
            print(text_table(summary), flush=True)
            summaries.append(summary)
            whole.append(evaluation)
    finally:
        progress.clear()
    if options.report is not None:
        module, _, name = figures.partition(":")
        draw = getattr(importlib.import_module(module), name)
        curves = {}
        if runs:
            from jaxcal.evaluation.figures import training_curves

            curves["training_curves"] = training_curves({run.name: run for run in runs})
        folder, command = options.report, options.command
        count = write_report(folder, whole, draw, curves, command=command)
        drawn = "1 figure" if count == 1 else f"{count} figures"
        print(f"saved: {options.report}/index.html and {drawn}")
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        write_text(options.json, json_document(summaries, command=options.command))
        print(f"saved: {options.json}")


def _evaluations(
    options: EvaluateOptions, methods: Sequence[str], progress: Progress
) -> Iterator[tuple[Summary, Evaluation]]:
    """Every dataset, read or made before the first is evaluated."""
    from jaxcal.evaluation.methods import evaluate

    names = [*dict.fromkeys(options.dataset)] or ["dataset2"]
    for dataset in [_dataset(name, options) for name in names]:
        evaluation = evaluate(
            dataset,
            options.k,
            methods,
            options.checkpoints,
            random_draws=options.draws,
            seed=options.seed,
            time_limit=options.time_limit,
            progress=progress,
        )
        yield evaluation.summarise(indices=options.indices), evaluation


def _dataset(name: str, options: EvaluateOptions) -> Dataset:
    from jaxcal.commands.tables import draw_sets, holds_sets
    from jaxcal.evaluation.dataset import Dataset, load_dataset
    from jaxcal.paper.datasets import EPISODES, MADE

    if name in EPISODES:
        from jaxcal.paper.datasets import make_dataset

        count = min(options.episodes or EPISODES[name], EPISODES[name])
        return make_dataset(name, options.seed, count)
    if Path(name).suffix.lower() not in (".npz", ".csv"):
        drawn = ", ".join(known for known in EPISODES if known not in MADE)
        raise ValueError(
            f"--dataset takes {drawn}, or a .npz or .csv file, got {name!r}"
        )
    if not holds_sets(name):
        sets = draw_sets(name, options.episodes or _POOLED, options.seed)
        return Dataset(name=Path(name).name, candidates=sets, seed=options.seed)
    dataset = load_dataset(name)
    return dataset if options.episodes is None else dataset.part(0, options.episodes)


def _run_folders(checkpoints: Sequence[str | None]) -> list[Path]:
    """Folders of the training runs that checkpoints are of."""
    places: list[Path] = []
    for folder in map(Path, filter(None, checkpoints)):
        near = [folder, *folder.resolve().parents[:2]]
        places += [place for place in near if (place / "metrics.csv").is_file()][:1]
    return list({place.resolve(): place for place in places}.values())


def _run_task(options: TaskOptions) -> None:
    figures = "jaxcal.adaptive.evaluation:decider_figures"
    options.require_writable()
    _show(options, functools.partial(_sessions, options), figures)


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
