"""The flags of ``train``, made from the fields of configurations, and its help."""

from __future__ import annotations

import argparse
import textwrap
from typing import Any

from jaxcal.adaptive.policy.config import PPO, PolicyConfig
from jaxcal.adaptive.tasks import registry
from jaxcal.arguments import Parser, at_least, flag
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
_ABOVE = ("num_episodes", "num_updates", "seed", "num_seeds")  # flags above the groups
_NAMES = {"num_episodes": "episodes", "num_updates": "updates", "num_seeds": "seeds"}


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
    )
    out.with_flags(
        (
            flag("--preset", "of postures, see below [compact]", default="compact",
                 choices=sorted(known)),
            flag("--task", "of sequential measurement, see below", "NAME"),
            flag("--with", "options of the task", "OPTION=VALUE", dest="options",
                 nargs="+", default=[]),
            flag("--episodes", "training budget" + _held("num_episodes", known), "N",
                 int, dest="num_episodes"),
            flag("--updates", "training budget of a task: updates of "
                 f"{PPO.decisions_per_update:,} decisions each [{PPO.num_updates}]",
                 "N", at_least(1), dest="num_updates"),
            flag("--seed", "of everything random [0]", "S", int),
            flag("--seeds", "runs side by side in one program: seeds S, S + 1, ... [1]",
                 "N", at_least(1), dest="num_seeds"),
            flag("--out", "run folder [runs/PRESET or runs/TASK]", "DIR"),
            flag("--resume", "go on from the run folder's checkpoint", on=True),
            flag("--candidates", "train on your own postures, .csv or .npz: one table "
                 "is a pool that every episode draws --num-candidates from; several "
                 "episodes are candidate sets"),
            flag("--trainer", "jaxcal's own PPO, or brax's on the same environment "
                 "[jaxcal]", default="jaxcal", choices=("jaxcal", "brax")),
            flag("--export", "write the finished policy alone to one file, NAME.npz"),
            flag("--no-validation", "do not measure the gap to the proven optimum "
                 "while training", on=True),
            flag("--devices", "devices of each process [all]", "N", int),
        )
    )  # fmt: skip
    processes.add_arguments(out)
    common = {field.name for field in settings_of(PPOConfig)} | {"width"}
    parts = presets.PARTS
    groups: tuple[tuple[str, str, list[Setting]], ...] = (
        (
            "optimisation and size",
            "in brackets the value of compact, and of others that differ",
            [f for kind in (PPOConfig, parts["network"]) for f in settings_of(kind)
             if f.name in common],
        ),
        (
            "postures",
            "what an episode is, in presets of one task; --kind paper reads --width "
            "alone of the network",
            [f for part in ("ppo", "run", "environment", "network")
             for f in settings_of(parts[part]) if f.name not in common],
        ),
        (
            "tasks",
            "with --task",
            [f for part in TASK_PARTS.values() for f in settings_of(part)
             if f.name not in common],
        ),
    )  # fmt: skip
    for title, description, fields in groups:
        group = out.add_argument_group(title, description)
        for field in fields:
            if field.name in _ABOVE:
                continue
            line = (field.help + _held(field.name, known)).replace("%", "%%")
            if field.kind is bool:
                yes_no = argparse.BooleanOptionalAction
                group.add_argument(flag_of(field.name), action=yes_no, help=line)
            else:
                metavar = {int: "N", float: "X", str: "NAME"}[field.kind]
                group.add_argument(
                    flag_of(field.name), type=field.kind, metavar=metavar, help=line
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
    elif arguments.options:
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
            if hasattr(part, name):
                values[preset] = _shown(getattr(part, name))
    sizes = {f.name: f.default for f in PolicyConfig.__dataclass_fields__.values()}
    if hasattr(PPO, name):
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
