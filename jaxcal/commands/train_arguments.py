"""The flags of ``train``, made from the fields of configurations, and its help."""

from __future__ import annotations

import argparse
import dataclasses
import textwrap
from typing import Annotated, Any, Literal

from jaxcal.adaptive.policy.config import PPO, PolicyConfig
from jaxcal.adaptive.tasks import registry
from jaxcal.arguments import Parser, number_type
from jaxcal.learning.config import PPOConfig, StreamsConfig
from jaxcal.learning.runtime import processes
from jaxcal.learning.settings import Setting, settings_of
from jaxcal.learning.training import presets
from jaxcal.learning.training.config import TrainConfig

__all__ = ["TASK_PARTS", "flag_of", "parser", "values_of"]

_EPILOG = """\
presets, of postures:
{presets}

tasks, of sequential measurement:
{tasks}
  FILE.py   your own: a file that defines ENTRY (docs/adaptive.md)

what to try first:
  {program}                        the compact policy, a few minutes on a laptop
  {program} --episodes 20000       the same in half a minute, 0.993 of the optimum
  {program} --num-selected 6       another number of postures
  {program} --candidates mine.csv  your own machine's postures
  then --imitation 0.5 --initial-trust 4 --initial-actor 0.05 --close-up, which adds
  most where more than n + 1 postures are chosen. Other numbers rarely need a change.

more examples:
  {program} --task knee            the next measurement from what the last answered
  {program} --task knee --with cells=16 sigma=0.05
  {program} --seeds 8              eight runs side by side: mean, spread and the best
  {program} --resume --out runs/compact      go on where a run stopped
  {program} --preset general --export checkpoints/default.npz   what ships
  {program} --trainer brax --episodes 50000  the same task, brax's own PPO
  srun {program}                             all tasks of a SLURM job step
  {program} --coordinator host0:4711 --num-processes 2 --process-id 0   and 1

A run folder holds metrics.csv, TensorBoard events and checkpoint/; measure it with
  python evaluate.py --checkpoint runs/compact
Ctrl-C saves and stops; --resume then continues bit for bit (on the same CPU).
All devices of all processes share each update: docs/scaling.md."""

TASK_PARTS: dict[str, type] = {"ppo": StreamsConfig, "policy": PolicyConfig}
_FIRST = ("num_episodes", "num_updates", "seed", "num_seeds")
_NAMES = {"num_episodes": "episodes", "num_updates": "updates", "num_seeds": "seeds"}


@dataclasses.dataclass
class Options:
    """What is trained and where it is kept."""

    preset: Annotated[str, "of postures, see below", "NAME"] = "compact"
    task: Annotated[str | None, "of sequential measurement, see below", "NAME"] = None
    with_: Annotated[tuple[str, ...], "options of the task", "OPTION=VALUE"] = ()
    out: Annotated[str | None, "run folder [runs/PRESET or runs/TASK]", "DIR"] = None
    resume: Annotated[bool, "go on from the run folder's checkpoint"] = False
    candidates: Annotated[
        str | None,
        "train on your own postures, .csv or .npz: one table is a pool that every "
        "episode draws --num-candidates from; several episodes are candidate sets",
        "FILE",
    ] = None
    trainer: Annotated[
        Literal["jaxcal", "brax"], "jaxcal's own PPO, or brax's on the same environment"
    ] = "jaxcal"
    export: Annotated[
        str | None, "write the finished policy alone to one file, NAME.npz", "FILE"
    ] = None
    no_validation: Annotated[
        bool, "do not measure the gap to the proven optimum while training"
    ] = False
    devices: Annotated[int | None, "devices of each process [all]"] = None


def flag_of(name: str) -> str:
    """The flag that sets a field."""
    return "--" + _NAMES.get(name, name).replace("_", "-")


def parser(prog: str) -> Parser:
    """All flags; ``prog`` is what was typed, "train.py" or "jaxcal train"."""
    program = f"python {prog}" if prog.endswith(".py") else prog
    known = {name: presets.load(name) for name in presets.names()}
    out = Parser(
        prog=prog,
        usage="%(prog)s [--preset NAME | --task NAME] [--out DIR] [flags below]",
        description="Train a policy, and save it with all it needs: one that selects "
        "postures, or with --task one that picks the next measurement.",
        epilog=_EPILOG.format(program=program, presets=_abouts(known), tasks=_tasks()),
    ).of(Options)
    processes.add_arguments(out)
    common = {field.name for field in settings_of(PPOConfig)} | {"width"}
    parts = presets.PARTS

    def of(*kinds: type, shared: bool = False) -> list[Setting]:
        found = [field for kind in kinds for field in settings_of(kind)]
        return [
            f for f in found if (f.name in common) == shared and f.name not in _FIRST
        ]

    first = {f.name: f for part in (*parts.values(), *TASK_PARTS.values())
             for f in settings_of(part)}  # fmt: skip
    groups = (
        ("budget", "--episodes of postures, --updates of a task",
         [first[name] for name in _FIRST]),
        ("optimisation and size",
         "in brackets the value of compact, and of others that differ",
         of(PPOConfig, parts["network"], shared=True)),
        ("postures",
         "what an episode is, in presets of one task; --kind paper reads --width "
         "alone of the network",
         of(*(parts[part] for part in ("ppo", "run", "environment", "network")))),
        ("tasks", "with --task", of(*TASK_PARTS.values())),
    )  # fmt: skip
    for title, description, fields in groups:
        group = out.add_argument_group(title, description)
        for field in fields:
            line = (field.help + _held(field.name, known)).replace("%", "%%")
            flag = flag_of(field.name)
            if field.kind is bool:
                yes_no = argparse.BooleanOptionalAction
                group.add_argument(flag, action=yes_no, help=line)
            else:
                metavar = {int: "N", float: "X", str: "NAME"}[field.kind]
                kind = field.kind if field.kind is str else number_type(field.kind)
                group.add_argument(
                    flag, type=kind, metavar=metavar, help=line, dest=field.name
                )
    return out


def values_of(arguments: argparse.Namespace, task: bool) -> dict[str, Any]:
    """The fields of a configuration that were given: name to value.

    Raises:
        ValueError: a flag is given that a task, or a preset, does not read.
    """
    own = {f.name for part in TASK_PARTS.values() for f in settings_of(part)}
    other = presets.field_names()
    read = own if task else other
    given = {
        name: value
        for name in own | other
        if (value := getattr(arguments, name)) is not None
    }
    unread = {flag_of(name) for name in set(given) - read}
    if task:
        unread |= {"--candidates"} if arguments.candidates else set()
        unread |= {"--trainer"} if arguments.trainer != "jaxcal" else set()
        unread |= {"--no-validation"} if arguments.no_validation else set()
    elif arguments.with_:
        unread.add("--with")
    if unread:
        who = f"--task {arguments.task}" if task else f"preset {arguments.preset}"
        raise ValueError(f"{who} does not read {', '.join(sorted(unread))}: leave out")
    return given


def _abouts(known: dict[str, TrainConfig]) -> str:
    lines = []
    for name, config in known.items():
        about = f"  {name:9} {config.about}"
        lines += textwrap.wrap(about, 86, subsequent_indent=" " * 12)
    return "\n".join(lines)


def _tasks() -> str:
    return "\n".join(
        f"  {name:9} {registry.load(name).about}" for name in registry.names()
    )


def _held(name: str, known: dict[str, TrainConfig]) -> str:
    """The value of compact, and of what differs: ``" [2; paper 10; tasks 4]"``."""
    values: dict[str, str] = {}
    for preset, config in known.items():
        for part in (config, config.ppo, config.network, config.tasks[0].environment):
            if name in part.__dataclass_fields__:
                values[preset] = _shown(getattr(part, name))
    sizes = {f.name: f.default for f in PolicyConfig.__dataclass_fields__.values()}
    if name in PPO.__dataclass_fields__:
        values["tasks"] = _shown(getattr(PPO, name))
    elif name in ("width", "per_group"):
        values["tasks"] = _shown(sizes[name])
    first = values.pop("compact", None) or values.pop("tasks")
    others = [f"{p} {v}" for p, v in values.items() if v != first]
    return " [" + "; ".join([first, *others]) + "]"


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:,}" if isinstance(value, int) else str(value)
