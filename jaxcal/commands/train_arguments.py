"""The flags of ``train``, made from the fields of a configuration, and its help."""

from __future__ import annotations

import argparse
import textwrap
from typing import Any

from jaxcal.arguments import Parser
from jaxcal.learning.runtime import processes
from jaxcal.learning.settings import settings_of
from jaxcal.learning.training import presets
from jaxcal.learning.training.config import TrainConfig

__all__ = ["parser", "values_of"]

_EPILOG = """\
presets:
{presets}

what to try first:
  {program}                        the compact policy, a few minutes on a laptop
  {program} --episodes 20000       the same in half a minute, 0.993 of the optimum
  {program} --num-selected 6       another number of postures
  {program} --candidates mine.csv  your own machine's postures
  then --imitation 0.5 --initial-trust 4 --initial-actor 0.05 --close-up, which adds
  most where more than n + 1 postures are chosen. Other numbers rarely need a change.

more examples:
  {program} --task knee            another kind: the next measurement from the last;
                                   {program} --task knee --help
  {program} --resume --out runs/compact      go on where a run stopped
  {program} --preset general --export checkpoints/default   what ships
  {program} --trainer brax --episodes 50000  the same task, brax's own PPO
  srun {program}                             all tasks of a SLURM job step
  {program} --coordinator host0:4711 --num-processes 2 --process-id 0   and 1

A run folder holds metrics.csv, TensorBoard events and checkpoint/; measure it with
  python evaluate.py --checkpoint runs/compact
Ctrl-C saves and stops; --resume then continues bit for bit (on the same CPU).
All devices of all processes share each update: docs/scaling.md."""

_ABOVE = ("num_episodes", "seed")  # flags above the groups

_TITLES = {
    "ppo": ("optimisation", "in brackets the value of compact, and of others"),
    "network": ("network", "--kind paper reads --width alone"),
    "environment": ("environment", "what an episode is; of presets of one task"),
}


def parser(prog: str) -> Parser:
    """All flags; ``prog`` is what was typed, "train.py" or "jaxcal train"."""
    program = f"python {prog}" if prog.endswith(".py") else prog
    known = {name: presets.load(name) for name in presets.names()}
    out = Parser(
        prog=prog,
        usage="%(prog)s [--preset NAME] [--episodes N] [--out DIR] [flags below]",
        description="Train a policy that selects postures, and save it with all it "
        "needs.",
        epilog=_EPILOG.format(program=program, presets=_abouts(known)),
    )
    add = out.add_argument
    preset = "see below [compact]"
    add("--preset", choices=sorted(known), default="compact", help=preset)
    budget = "training budget" + _held("num_episodes", known)
    add("--episodes", type=int, metavar="N", dest="num_episodes", help=budget)
    add("--seed", type=int, metavar="S", help="of everything random [0]")
    add("--out", metavar="DIR", help="run folder [runs/PRESET]")
    add("--resume", action="store_true", help="go on from the run folder's checkpoint")
    own = (
        "train on your own postures, .csv or .npz: one table is a pool that every "
        "episode draws --num-candidates from; several episodes are candidate sets"
    )
    add("--candidates", metavar="FILE", help=own)
    trainer = "jaxcal's own PPO, or brax's on the same environment [jaxcal]"
    add("--trainer", choices=("jaxcal", "brax"), default="jaxcal", help=trainer)
    add("--export", metavar="DIR", help="write the finished policy alone to DIR")
    gap = "do not measure the gap to the proven optimum while training"
    add("--no-validation", action="store_true", help=gap)
    add("--devices", type=int, metavar="N", help="devices of each process [all]")
    processes.add_arguments(out)
    for part, (title, description) in _TITLES.items():
        group = out.add_argument_group(title, description)
        for field in settings_of(presets.PARTS[part]):
            if field.name in _ABOVE:
                continue
            flag = "--" + field.name.replace("_", "-")
            line = (field.help + _held(field.name, known)).replace("%", "%%")
            if field.kind is bool:
                yes_no = argparse.BooleanOptionalAction
                group.add_argument(flag, action=yes_no, help=line)
            else:
                metavar = {int: "N", float: "X", str: "NAME"}[field.kind]
                group.add_argument(flag, type=field.kind, metavar=metavar, help=line)
    return out


def values_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """The fields of a configuration that were given: name to value."""
    given = {name: getattr(arguments, name) for name in presets.field_names()}
    return {name: value for name, value in given.items() if value is not None}


def _abouts(known: dict[str, TrainConfig]) -> str:
    lines = []
    for name, config in known.items():
        about = f"  {name:9} {config.about}"
        lines += textwrap.wrap(about, 86, subsequent_indent=" " * 12)
    return "\n".join(lines)


def _held(name: str, known: dict[str, TrainConfig]) -> str:
    """The value of compact, and of presets that differ: ``" [2; paper 10]"``."""
    values = {}
    for preset, config in known.items():
        for part in (config.ppo, config.network, config.tasks[0].environment):
            if hasattr(part, name):
                values[preset] = _shown(getattr(part, name))
    others = [f"{p} {v}" for p, v in values.items() if v != values["compact"]]
    return " [" + "; ".join([values["compact"], *others]) + "]"


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:,}" if isinstance(value, int) else str(value)
