"""``python train.py`` and ``jaxcal train``: parse, train, say how it goes."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import pathlib
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal.arguments import refused
from jaxcal.commands.runs import clock, names_task, stop_on_signals
from jaxcal.commands.tables import read_table
from jaxcal.extras import MissingExtraError, needs
from jaxcal.files import require_writable_folder
from jaxcal.learning.runtime import processes

if TYPE_CHECKING:
    from jaxcal.learning.environments.task import GivenCandidates
    from jaxcal.learning.training.config import TrainConfig
    from jaxcal.learning.training.loop import Report

__all__ = ["main"]


def main(argv: Sequence[str] | None = None, prog: str = "jaxcal train") -> int:
    """Run.

    Returns:
        0 when trained or stopped on request, 2 when something given was wrong, 3 where
        another process of the job was lost.
    """
    given = list(sys.argv[1:] if argv is None else argv)
    if names_task(given):
        from jaxcal.commands import train_task

        return train_task.main(given, prog)

    def alone() -> int:  # this process may be one of several
        try:
            with needs("policy", prog):
                from jaxcal.commands.train_arguments import parser
            return _run(parser(prog).parse_args(given))
        except (ValueError, OSError, MissingExtraError) as error:
            return refused(prog, error)

    advice = "what is saved stays: start every process again with --resume"
    return processes.run_job(prog, given, alone, advice)


def _run(arguments: argparse.Namespace) -> int:
    """Train, say how it went; of several processes the first speaks for all."""
    from jaxcal.learning.runtime import cache, devices
    from jaxcal.learning.training import checkpoint, run
    from jaxcal.selection.teacher import fixed_validation, teacher

    cache.keep_compiled_programs()
    out = pathlib.Path(arguments.out or f"runs/{arguments.preset}")
    config = devices.on_first(lambda: _configuration(arguments, out))
    stop = stop_on_signals()
    if arguments.trainer == "brax":
        from jaxcal.learning.training import brax_ppo

        brax_ppo.train(config, out, lambda line: print(line, flush=True))
        done = config.ppo.num_updates
    else:
        mesh = devices.make_mesh(arguments.devices)
        devices.require_divisible(config.ppo.sets_per_minibatch, mesh)
        validation = None
        if devices.is_first():
            _introduce(config, out, devices.describe(mesh))
            if not arguments.no_validation:
                validation = fixed_validation(config)
            print(
                "compiling the training step (about half a minute; a few seconds "
                "where this machine has compiled it before) ...\n"
                "   update   episodes     /s   elapsed      left   reward"
                "   ratio to exact   optima hit",
                flush=True,
            )
        state = run.train(
            config,
            out,
            resume=arguments.resume,
            validation=validation,
            report=_show,
            should_stop=stop,
            num_devices=arguments.devices,
            teacher=teacher,
        )
        done = int(state.num_updates)
    if not devices.is_first():
        return 0
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


def _configuration(arguments: argparse.Namespace, out: pathlib.Path) -> TrainConfig:
    """What to train, from the flags or from the run to go on with."""
    from jaxcal.commands.train_arguments import values_of
    from jaxcal.learning.training import checkpoint, presets
    from jaxcal.learning.training.config import TrainConfig

    given = values_of(arguments)
    candidates = _candidates(arguments.candidates) if arguments.candidates else None
    steps = out / "checkpoint"
    if not arguments.resume and steps.is_dir() and any(steps.iterdir()):
        raise ValueError(
            f"--out {out} already holds a run: go on with --resume, or name another"
        )
    config = presets.load(arguments.preset)
    if arguments.trainer == "brax":
        config = _for_brax(config, arguments, given)
    if arguments.resume:
        if given:
            raise ValueError(
                f"--resume takes its configuration from {out}; leave out "
                + ", ".join("--" + name.replace("_", "-") for name in sorted(given))
            )
        config = TrainConfig.from_meta(checkpoint.load(out).meta)
        held = config.tasks[0].given
        if held != candidates:  # they are compared by their digest
            what = f"{held.name} (SHA-256 {held.sha256[:12]})" if held else "no file"
            rule = "give the same file" if held else "leave it out"
            raise ValueError(f"--candidates: the run was trained on {what}; {rule}")
        config = _with_candidates(config, candidates)
    elif candidates is None:
        config = presets.with_values(config, given)
    else:
        config = _trained_on(config, candidates, given)
    require_writable_folder(out)
    return config


def _with_candidates(
    config: TrainConfig, candidates: GivenCandidates | None
) -> TrainConfig:
    if candidates is None:
        return config
    task = dataclasses.replace(config.tasks[0], given=candidates)
    return dataclasses.replace(config, tasks=(task,))


def _candidates(path: str) -> GivenCandidates:
    """The user's own candidates, each axis mapped to [0, 1] over the whole file.

    The best postures do not depend on the unit; float32 and the paper's network do.
    """
    from jaxcal.evaluation.dataset_files import load_dataset
    from jaxcal.learning.environments.task import GivenCandidates

    if _holds_sets(path):
        dataset = load_dataset(path)
        values, available = dataset.candidates, dataset.available
    else:
        table = read_table(path)
        values, mask = table.columns(table.inputs(None))[None], table.available()
        available = None if mask is None else mask[None]
    used = values if available is None else values[available]
    used = used.reshape(-1, used.shape[-1])
    low, high = used.min(axis=0), used.max(axis=0)
    for axis in np.flatnonzero(~(low < high)):  # also where a cell is empty
        raise ValueError(
            f"{path}: every column must hold numbers that differ, got {low[axis]:g} to "
            f"{high[axis]:g} in input {axis + 1}: leave it out"
        )
    return GivenCandidates(
        name=pathlib.Path(path).name,
        sha256=hashlib.sha256(pathlib.Path(path).read_bytes()).hexdigest(),
        values=((values - low) / (high - low)).astype(np.float32),
        available=available,
    )


def _holds_sets(path: str) -> bool:
    """Whether a file holds episodes of candidates, in the format of datasets."""
    if path.lower().endswith(".npz"):
        with np.load(path, allow_pickle=False) as archive:
            return "candidates" in archive and archive["candidates"].ndim == 3
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        return "episode" in [cell.strip() for cell in file.readline().split(",")]


def _trained_on(
    config: TrainConfig, candidates: GivenCandidates, given: dict[str, Any]
) -> TrainConfig:
    """A preset of one task, on the user's candidates."""
    from jaxcal.learning.training import presets

    assert candidates.values is not None  # it was just read
    num_sets, m, n = candidates.values.shape
    if len(config.tasks) > 1:
        raise ValueError(
            f"--candidates goes with a preset of one task, such as compact; "
            f"{config.preset} has {len(config.tasks)}"
        )
    sizes = {"num_inputs": n, "num_outputs": n, "num_selected": n + 1}
    fixed = {"num_inputs": n} | ({"num_candidates": m} if num_sets > 1 else {})
    for name, value in fixed.items():
        if given.get(name, value) != value:
            raise ValueError(
                f"--{name.replace('_', '-')} must be {value}, as in "
                f"{candidates.name}, got {given[name]}: leave it out"
            )
    config = presets.with_values(config, sizes | fixed | given)
    candidates.source(config.tasks[0].environment)  # refuses a pool that is too small
    return _with_candidates(config, candidates)


def _for_brax(
    config: TrainConfig, arguments: argparse.Namespace, given: dict[str, Any]
) -> TrainConfig:
    """A preset as brax trains it; what brax does not read is refused."""
    import jax

    with needs("study", "--trainer brax"):
        from jaxcal.learning.training import brax_ppo

    if arguments.resume:
        raise ValueError("--resume works with --trainer jaxcal only")
    if jax.process_count() > 1:
        raise ValueError("--trainer brax works in a single process only")
    if len(config.tasks) > 1:
        raise ValueError(
            f"--trainer brax trains on one task, preset {config.preset} has "
            f"{len(config.tasks)}: use compact or paper"
        )
    unread = {"devices": arguments.devices, "no_validation": arguments.no_validation}
    brax_ppo.require_read([*given, *(name for name, value in unread.items() if value)])
    return brax_ppo.adapted(config)


def _introduce(config: TrainConfig, out: pathlib.Path, devices: str) -> None:
    """What will be trained, in one line and in every number."""
    import jax

    from jaxcal.learning.policies.build import build
    from jaxcal.learning.training import optimiser

    network, task = build(config.network), config.tasks[0]
    shapes = jax.eval_shape(lambda: optimiser.init(config.ppo, task, network))
    size = sum(leaf.size for leaf in jax.tree.leaves(shapes.params))
    env = task.environment
    print(
        f"preset {config.preset}: {config.network.kind} network, {size:,} parameters; "
        f"choose {env.num_selected} of {env.num_candidates}"
        + (f" from {task.given.name}" if task.given else "")
        + f"; {config.ppo.num_episodes:,} episodes, seed {config.ppo.seed}, "
        f"on {devices}; run folder {out}"
    )
    print(f"configuration: {config.as_meta()}")


def _show(report: Report) -> None:
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
