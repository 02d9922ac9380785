"""Train a posture-selection policy: ``python train.py``; ``--help`` lists the rest."""

from __future__ import annotations

import argparse
import dataclasses
import pathlib
import signal
import sys
from typing import Any, NoReturn

EXAMPLES = """\
examples:
  python train.py                                  the compact policy, a few minutes
  python train.py --preset paper                   the paper's network and schedule
  python train.py --resume --out runs/compact      go on where a run stopped
  python train.py --episodes 20000 --seed 1 --out runs/short
  python train.py --preset general --export checkpoints/default   what ships
  python train.py --trainer brax --episodes 50000  the same task, brax's own PPO
  srun python train.py                             all tasks of a SLURM job step
  python train.py --coordinator host0:4711 --num-processes 2 --process-id 0   and 1

A run folder holds metrics.csv, TensorBoard events and checkpoint/; measure it with
  python evaluate.py --checkpoint runs/compact
Ctrl-C saves and stops; --resume then continues bit for bit (on the same CPU).
All devices of all processes share each update: docs/scaling.md."""


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"train.py: {message}; see --help\n")


def parser() -> argparse.ArgumentParser:
    """Flags; those of a configuration are made from its fields."""
    from jaxcal.learning.runtime import processes
    from jaxcal.learning.training import presets

    out = Parser(
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    out.add_argument("--preset", choices=sorted(presets.PRESETS), default="compact")
    out.add_argument("--episodes", type=int, metavar="N", help="training budget")
    out.add_argument("--seed", type=int, metavar="S", help="of everything random")
    out.add_argument("--out", metavar="DIR", help="run folder (runs/PRESET)")
    out.add_argument(
        "--resume", action="store_true", help="go on from the run folder's checkpoint"
    )
    out.add_argument(
        "--trainer",
        choices=("jaxcal", "brax"),
        default="jaxcal",
        help="jaxcal's own PPO, or brax's on the same environment",
    )
    out.add_argument(
        "--export",
        metavar="DIR",
        help="write the finished policy alone, without its training state, to DIR",
    )
    out.add_argument(
        "--no-validation",
        action="store_true",
        help="do not measure the gap to the proven optimum while training",
    )
    out.add_argument(
        "--devices", type=int, metavar="N", help="use so many a process; all"
    )
    processes.add_arguments(out)
    for title, field, skip in (
        ("optimisation", "ppo", {"num_episodes", "seed"}),
        ("network", "network", set()),
        ("environment", "environment", set()),
    ):
        group = out.add_argument_group(title, "the preset's value when not given")
        for name, kind in presets.fields(field, skip):
            flag = "--" + name.replace("_", "-")
            if kind is bool:
                group.add_argument(flag, action=argparse.BooleanOptionalAction)
            else:
                group.add_argument(flag, type=kind, metavar=kind.__name__.upper())
    return out


def main(argv: list[str] | None = None) -> int:
    """Run; 0 when trained or stopped on request, 2 when something given was wrong.

    3 where another process of the job was lost.
    """
    from jaxcal.learning.runtime import processes

    advice = "what is saved stays: start every process again with --resume"
    return processes.run_job("train.py", argv, lambda: alone(argv), advice)


def alone(argv: list[str] | None) -> int:
    """The command in this process, which may be one of several."""
    arguments = parser().parse_args(argv)
    try:
        return run(arguments)
    except (ValueError, OSError) as error:
        print(f"train.py: {error}", file=sys.stderr)
        return 2


def configuration(arguments: argparse.Namespace, out: pathlib.Path) -> Any:
    """What to train, from the flags or from the run to go on with."""
    from jaxcal.files import require_writable_folder
    from jaxcal.learning.training import checkpoint, presets
    from jaxcal.learning.training import run as training

    given = {
        name: value
        for name, value in vars(arguments).items()
        if value is not None and name in presets.field_names()
    }
    if arguments.episodes is not None:
        given["num_episodes"] = arguments.episodes
    held = (out / "checkpoint").is_dir() and any((out / "checkpoint").iterdir())
    if arguments.resume:
        if given:
            raise ValueError(
                f"--resume takes its configuration from {out}; leave out "
                + ", ".join("--" + name.replace("_", "-") for name in sorted(given))
            )
        config = training.TrainConfig.from_meta(checkpoint.load(out).meta)
    else:
        if held:
            raise ValueError(
                f"--out {out} already holds a run: go on with --resume, or name another"
            )
        config = presets.with_values(presets.PRESETS[arguments.preset], given)
    require_writable_folder(out)
    return config


def run(arguments: argparse.Namespace) -> int:
    """Train, say how it went; of several processes the first speaks for all."""
    import jax

    from jaxcal.learning.policies import networks
    from jaxcal.learning.runtime import cache, devices
    from jaxcal.learning.training import checkpoint, ppo
    from jaxcal.learning.training import run as training
    from jaxcal.selection.teacher import fixed_validation, teacher

    cache.keep_compiled_programs()
    if arguments.trainer == "brax":
        if arguments.resume:
            raise ValueError("--resume works with --trainer jaxcal only")
        if jax.process_count() > 1:
            raise ValueError("--trainer brax works in a single process only")
    out = pathlib.Path(arguments.out or f"runs/{arguments.preset}")
    config = devices.on_first(lambda: configuration(arguments, out))
    mesh = devices.make_mesh(arguments.devices)
    devices.require_divisible(config.ppo.sets_per_minibatch, mesh)
    if not devices.is_first():
        training.train(
            config,
            out,
            resume=arguments.resume,
            should_stop=Stop().requested,
            num_devices=arguments.devices,
            teacher=teacher,
        )
        return 0
    stop = Stop()
    if arguments.trainer == "brax":
        from jaxcal.learning.training import brax_ppo

        brax_ppo.train(config, out, print)
        print(
            f"saved {out}/checkpoint; measure it: python evaluate.py --checkpoint {out}"
        )
        return 0
    network = networks.build(config.network)
    shapes = jax.eval_shape(lambda: ppo.init(config.ppo, config.tasks[0], network))
    size = sum(leaf.size for leaf in jax.tree.leaves(shapes.params))
    env = config.tasks[0].environment
    print(
        f"preset {config.preset}: {config.network.kind} network, {size:,} parameters; "
        f"choose {env.num_selected} of {env.num_candidates}; "
        f"{config.ppo.num_episodes:,} episodes, seed {config.ppo.seed}, "
        f"on {devices.describe(mesh)}; run folder {out}"
    )
    print(f"configuration: {dataclasses.asdict(config)}")
    validation = None if arguments.no_validation else fixed_validation(config)
    print("compiling the training step (half a minute; seconds the next time) ...")
    print(
        "   update   episodes     /s   elapsed      left   reward"
        "   ratio to exact   optima hit",
        flush=True,
    )
    state = training.train(
        config,
        out,
        resume=arguments.resume,
        validation=validation,
        report=show,
        should_stop=stop.requested,
        num_devices=arguments.devices,
        teacher=teacher,
    )
    done = int(state.num_updates)
    if done < config.ppo.num_updates:
        print(
            f"stopped at update {done} of {config.ppo.num_updates} and saved; go on: "
            f"python train.py --resume --out {out}"
        )
        return 0
    print(f"saved {out}/checkpoint; measure it: python evaluate.py --checkpoint {out}")
    if arguments.export:
        checkpoint.export(out, arguments.export)
        print(f"exported the policy alone to {arguments.export}")
    return 0


class Stop:
    """Ctrl-C or SIGTERM asks the loop to save and stop; a second Ctrl-C is at once."""

    def __init__(self) -> None:
        self._asked = False
        for name in (signal.SIGINT, signal.SIGTERM):
            signal.signal(name, self._ask)

    def _ask(self, number: int, frame: Any) -> None:
        self._asked = True
        print("\nstopping after this update and saving ...", flush=True)
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def requested(self) -> bool:
        """Whether to stop."""
        return self._asked


def show(report: Any) -> None:
    """One line of progress."""
    metrics = report.metrics
    ratio, hits = metrics.get("ratio_to_exact"), metrics.get("hit_rate")
    reward = metrics.get("reward_mean")
    print(
        f"{report.update:9,d} {report.episodes:10,d} "
        f"{report.episodes_per_second:6,.0f} "
        f"{clock(report.seconds):>9} {clock(report.eta):>9} "
        + (f"{reward:8.4f} " if reward is not None else " imitate ")
        + (f"{ratio:16.4f} {hits:12.3f}" if ratio is not None else ""),
        flush=True,
    )


def clock(seconds: float) -> str:
    """h:mm:ss."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"


if __name__ == "__main__":
    sys.exit(main())
