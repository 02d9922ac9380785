"""``train.py --task NAME``: a policy of sequential measurement."""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from jaxcal.arguments import Parser, at_least, refused
from jaxcal.commands.runs import clock, stop_on_signals
from jaxcal.extras import MissingExtraError, needs
from jaxcal.files import require_writable_folder

if TYPE_CHECKING:
    from jaxcal.adaptive.policy.config import PolicyConfig
    from jaxcal.adaptive.rules import StateRule
    from jaxcal.adaptive.tasks.registry import Entry
    from jaxcal.learning.training.loop import Report

__all__ = ["main"]

_EPILOG = """\
tasks:
{tasks}
  FILE.py   your own: a file that defines ENTRY (docs/adaptive.md)

examples:
  {program} --task knee                   about three minutes on one core
  {program} --task knee --resume          go on where a run stopped
  {program} --task knee --with cells=16 sigma=0.05
  {program} --task knee --export checkpoints/knee       what ships

The run folder holds metrics.csv, TensorBoard events and checkpoint/; measure it with
  python evaluate.py --task knee --checkpoint runs/knee
Ctrl-C saves and stops; --resume then continues bit for bit (on the same CPU)."""

_OPTIMISATION = (
    *("num_epochs", "num_minibatches", "learning_rate", "final_learning_rate"),
    *("warmup_updates", "clip_range", "value_coefficient", "entropy_start"),
    *("entropy_end", "discount", "gae_lambda", "max_grad_norm", "average_decay"),
)  # the fields of PPOConfig that this training reads, beside those above the groups


def main(argv: Sequence[str], prog: str) -> int:
    """Train and save; the exit code."""
    try:
        with needs("policy", prog):
            return _run(_parser(prog).parse_args(argv))
    except (ValueError, OSError, MissingExtraError) as error:
        return refused(prog, error)


def _parser(prog: str) -> Parser:
    from jaxcal.adaptive.policy.config import PPO, PolicyConfig
    from jaxcal.adaptive.tasks import registry
    from jaxcal.learning.settings import settings_of
    from jaxcal.learning.training.config import PPOConfig

    program = f"python {prog}" if prog.endswith(".py") else prog
    tasks = "\n".join(
        f"  {name:9} {registry.load(name).about}" for name in registry.names()
    )
    out = Parser(
        prog=prog,
        usage="%(prog)s --task NAME [--updates N] [--out DIR] [flags below]",
        description="Train a policy that picks the next measurement from what the last "
        "ones answered.",
        epilog=_EPILOG.format(program=program, tasks=tasks),
    )
    add = out.add_argument
    add("--task", required=True, metavar="NAME", help="see below")
    add("--with", dest="options", nargs="+", default=[], metavar="OPTION=VALUE",
        help="options of the task")  # fmt: skip
    updates = f"of {PPO.episodes_per_update:,} choices each [{PPO.num_updates}]"
    add("--updates", type=at_least(1), metavar="N", help=updates)
    add(
        "--seed",
        type=at_least(0),
        default=0,
        metavar="S",
        help="of everything random [0]",
    )
    add("--out", metavar="DIR", help="run folder [runs/TASK]")
    add("--resume", action="store_true", help="go on from the run folder's checkpoint")
    add("--export", metavar="DIR", help="write the finished policy alone to DIR")
    groups = (
        ("network", PolicyConfig, None),
        ("optimisation", PPOConfig, _OPTIMISATION),
    )
    for title, config, names in groups:
        group = out.add_argument_group(title)
        for field in settings_of(config):
            if names is None or field.name in names:
                held = getattr(PPO, field.name, getattr(PolicyConfig, field.name, None))
                group.add_argument(
                    "--" + field.name.replace("_", "-"),
                    type=field.kind,
                    metavar="N" if field.kind is int else "X",
                    help=f"{field.help} [{held}]".replace("%", "%%"),
                )
    return out


def _run(arguments: argparse.Namespace) -> int:
    from jaxcal.adaptive.policy import run
    from jaxcal.learning.runtime import cache
    from jaxcal.learning.training import checkpoint

    cache.keep_compiled_programs()
    stem = pathlib.Path(arguments.task).stem
    out = pathlib.Path(arguments.out or f"runs/{stem}")
    config = _configuration(arguments, out)
    require_writable_folder(out)
    print(f"task {config.task}, run folder {out}\nconfiguration: {config.as_meta()}")
    print(
        "compiling the training step ...\n"
        "   update    choices     /s   elapsed      left     nats   less the rule's",
        flush=True,
    )

    def show(report: Report) -> None:
        metrics = report.metrics
        print(
            f"{report.update:9,d} {report.episodes:10,d} "
            f"{report.episodes_per_second:6,.0f} "
            f"{clock(report.seconds):>9} {clock(report.eta):>9} "
            f"{metrics['nats']:8.3f} {metrics['nats_over_base']:+17.3f}",
            flush=True,
        )

    stop = stop_on_signals()
    state = run.train(
        config, out, resume=arguments.resume, report=show, should_stop=stop
    )
    done = int(state.num_updates)
    if done < config.ppo.num_updates:
        print(
            f"stopped at update {done} of {config.ppo.num_updates} and saved; go on: "
            f"python train.py --task {arguments.task} --resume --out {out}"
        )
        return 0
    print(
        f"saved {out}/checkpoint; measure it: python evaluate.py --task "
        f"{arguments.task} --checkpoint {out}"
    )
    if arguments.export:
        checkpoint.export(out, arguments.export, run.load)
        print(f"exported the policy alone to {arguments.export}")
    return 0


def _configuration(arguments: argparse.Namespace, out: pathlib.Path) -> PolicyConfig:
    """What to train, from the flags or from the run to go on with."""
    from jaxcal.adaptive.policy import run
    from jaxcal.adaptive.policy.config import PPO, PolicyConfig
    from jaxcal.adaptive.tasks import registry

    entry = registry.load(arguments.task)
    values = {
        name: getattr(arguments, name)
        for name in _OPTIMISATION
        if getattr(arguments, name) is not None
    }
    sizes = {
        name: getattr(arguments, name)
        for name in ("per_group", "width")
        if getattr(arguments, name) is not None
    }
    if arguments.resume:
        given = [*values, *sizes, *(["updates"] if arguments.updates else [])]
        if given or arguments.options:
            raise ValueError(
                f"--resume takes its configuration from {out}; leave out "
                + ", ".join("--" + n.replace("_", "-") for n in given or ["with"])
            )
        config = run.load(out).config
        if config.task != arguments.task:
            raise ValueError(f"--task must be {config.task}, that of {out}")
        return config
    steps = out / "checkpoint"
    if steps.is_dir() and any(steps.iterdir()):
        raise ValueError(
            f"--out {out} already holds a run: go on with --resume, or name another"
        )
    if arguments.updates:
        values["num_episodes"] = arguments.updates * PPO.episodes_per_update
    options = entry.train_on
    if arguments.options:
        options = (registry.options_from(entry, arguments.options),)
    base = entry.rules.get("state") or _tuned(entry, options[0])
    return PolicyConfig(
        task=arguments.task,
        base=base,
        options=options,
        ppo=dataclasses.replace(PPO, seed=arguments.seed, **values),
        **sizes,
    )


def _tuned(entry: Entry, options: Mapping[str, Any]) -> StateRule:
    """The base rule of a task that ships none: tuned before the training."""
    from jaxcal.adaptive.rules import StateRule
    from jaxcal.adaptive.tuning import tune

    print("tuning the rule that the policy begins as ...", flush=True)
    return tune(entry.make(**options), StateRule(), episodes=1024, seed=1)
