"""``evaluate.py --task NAME``: deciders of sequential measurement, compared."""

from __future__ import annotations

import dataclasses
import importlib
from pathlib import Path
from typing import Annotated, Any

from jaxcal.arguments import Parser, several
from jaxcal.extras import needs
from jaxcal.files import require_writable_folder, write_text

__all__ = ["parser", "require_outputs", "run"]

_METHODS = "random,gain,rate,shares,ahead,two_step,policy"
_TUNED = "priced,state"  # where the task brings their constants

_EPILOG = """\
methods:
{methods}

tasks:
{tasks}
  FILE.py    your own: a file that defines ENTRY (docs/adaptive.md)

examples:
  {program} --task knee
  {program} --task knee --methods state,rollouts,policy --episodes 512
  {program} --task knee --with sigma=0.05 cells=16 --retune --json out.json
"""


@dataclasses.dataclass
class Options:
    """What is played, and where it is written."""

    task: Annotated[str, "see below"]
    with_: Annotated[tuple[str, ...], "options of the task", "OPTION=VALUE"] = ()
    methods: Annotated[
        list[str] | None,
        f"comma separated; {_METHODS}, with {_TUNED} where the task has their "
        "constants, or the task's own",
        "LIST",
        several(str, "names"),
    ] = None
    checkpoint: Annotated[str | None, "of the policy; the shipped one", "DIR"] = None
    episodes: Annotated[
        int | None, "sessions; 4096, fewer where a task takes long", (2,)
    ] = None
    seed: Annotated[int, "of the sessions", "S", (0,)] = 0
    rollouts: Annotated[
        int, "simulations of each candidate of the method rollouts", (1,)
    ] = 16
    retune: Annotated[bool, "tune the rules on this task; else as they ship"] = False
    json: Annotated[Path | None, "write every number"] = None
    report: Annotated[Path | None, "write figure and index.html", "DIR"] = None
    quiet: Annotated[bool, "no progress"] = False
    command: list[str] = dataclasses.field(init=False)


def parser(prog: str, typed: str) -> Parser:
    """``prog`` begins a message, ``typed`` an example of the help."""
    from jaxcal.adaptive.tasks import registry
    from jaxcal.evaluation.sequential import METHODS

    methods = "\n".join(f"  {name:10} {about}" for name, about in METHODS.items())
    tasks = "\n".join(
        f"  {name:10} {registry.load(name).about}" for name in registry.names()
    )
    out = Parser(
        prog=prog,
        description="Let deciders play the same sessions of a task: what they learn in "
        "nats, each less the best rule in pairs, and the time of a choice.",
        epilog=_EPILOG.format(methods=methods, tasks=tasks, program=typed),
    )
    return out.of(run)


def require_outputs(options: Any) -> None:
    """Refuse --json and --report that cannot be written, before computing anything."""
    if options.json is not None:
        if options.json.is_dir():
            raise ValueError(f"--json must be a file, {options.json} is a folder")
        require_writable_folder(options.json.parent)
    if options.report is not None:
        with needs("study", "--report"):
            importlib.import_module("jinja2")
            importlib.import_module("matplotlib")
        require_writable_folder(options.report)


def run(options: Options) -> None:
    """Evaluate, print, write."""
    from jaxcal.adaptive.tasks import registry
    from jaxcal.evaluation import sequential, sequential_report
    from jaxcal.learning.runtime import cache
    from jaxcal.progress import Progress

    require_outputs(options)
    entry = registry.load(options.task)
    methods = options.methods or list(entry.methods)
    if not methods:
        known = [m for m in _TUNED.split(",") if m in entry.rules or options.retune]
        methods = _METHODS.split(",")
        methods[5:5] = known
    if options.checkpoint is not None and "policy" not in methods:
        if options.methods:
            raise ValueError("--checkpoint is given, but policy is not among --methods")
        methods.append("policy")
    chosen = registry.options_from(entry, options.with_)
    cache.keep_compiled_programs()
    progress = Progress(quiet=options.quiet)
    try:
        result = sequential.evaluate(
            options.task,
            entry,
            chosen,
            methods,
            checkpoint=options.checkpoint,
            episodes=options.episodes or entry.episodes,
            seed=options.seed,
            rollouts=options.rollouts,
            retune=options.retune,
            progress=progress,
        )
    finally:
        progress.clear()
    print(sequential_report.text_table(result))
    if options.report is not None:
        sequential_report.write_report(options.report, result, command=options.command)
        print(f"saved: {options.report}/index.html and 1 figure")
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        document = sequential_report.json_document(result, command=options.command)
        write_text(options.json, document)
        print(f"saved: {options.json}")
