"""``python train.py`` and ``jaxcal train``: parse, train, say how it goes.

One command trains what selects postures (``--preset``) and what picks the next
measurement of a task (``--task``); they differ in what is read from the flags.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import functools
import math
import pathlib
import pprint
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from jaxcal.arguments import refused, told, typed_line
from jaxcal.extras import MissingExtraError, needs
from jaxcal.files import require_writable_folder
from jaxcal.learning.runtime import cache, processes

if TYPE_CHECKING:
    from jaxcal.adaptive.policy.config import PolicyConfig
    from jaxcal.adaptive.rules import StateRule
    from jaxcal.adaptive.tasks.registry import Entry
    from jaxcal.commands.train_arguments import TrainOptions
    from jaxcal.learning.environments.task import GivenCandidates
    from jaxcal.learning.training.presets import TrainConfig
    from jaxcal.learning.training.run import Report


Stop = Callable[[], bool]

# Columns of progress: the reward of an update, and what is measured on fixed sets.
_POSTURES = ("reward", "ratio to exact", "optima hit")
_TASK = ("reward", "nats", "less the rule's")


def main(argv: Sequence[str] | None = None, prog: str = "jaxcal train") -> int:
    """Run.

    Returns:
        0 when trained or stopped on request, 1 where the training diverged, 2 when
        something given was wrong, 3 where another process of the job was lost.
    """
    words = list(sys.argv[1:] if argv is None else argv)

    def alone() -> int:  # this process may be one of several
        cache.keep_compiled_programs()
        try:
            with needs("policy", "training"):
                from jaxcal.commands.train_arguments import read
            with told():
                return _run(read(prog, words), prog)
        except (ValueError, OSError, MissingExtraError) as error:
            return refused(prog, error)

    advice = "what is saved stays: start every process again with --resume"
    return processes.run_job(prog, words, alone, advice)


def _run(arguments: TrainOptions, prog: str) -> int:
    """Train, say how it went; of several processes the first speaks for all."""
    from jaxcal.commands.train_arguments import preset_of

    named = pathlib.Path(arguments.task or preset_of(arguments)).stem
    out = pathlib.Path(arguments.out or f"runs/{named}")
    if arguments.resume and not arguments.task:
        arguments.task = _task_held(out)
    if arguments.export and not arguments.export.endswith(".npz"):
        raise ValueError(f"--export must be a file NAME.npz, got {arguments.export}")
    configuration = _task_configuration if arguments.task else _configuration
    configure = functools.partial(configuration, arguments, out)
    config: Any = None
    later = arguments.task, arguments.resume, arguments.sweep, "jax" in sys.modules
    if not any((*later, arguments.values.get("num_seeds"))):
        config = configure()  # what is wrong is said before JAX is loaded
    from jaxcal.learning.runtime import devices

    if (runs := _num_runs(arguments, out)) > 1:
        devices.a_device_for_each_core(runs)
    config = devices.on_first(configure) if config is None else config
    with _stop_on_signals() as stop:
        if arguments.trainer == "brax":
            from jaxcal.learning.training import brax_ppo

            brax_ppo.train(config, out, lambda line: print(line, flush=True))
            done = config.ppo.num_updates
        else:
            from jaxcal.learning.training.run import DivergedError

            try:
                done = _train(config, arguments, out, stop)
            except DivergedError as error:
                refused(prog, error)
                return 1
    if not devices.is_first():
        return 0
    task = f" --task {arguments.task}" if arguments.task else ""
    if done < config.ppo.num_updates:
        print(
            f"stopped at update {done} of {config.ppo.num_updates} and saved; go on: "
            f"{typed_line(prog)}{task} --resume --out {out}"
        )
        return 0
    print(
        f"saved {out}/checkpoint; measure it: "
        f"{typed_line(prog.replace('train', 'evaluate'))}{task} --checkpoint {out}"
    )
    if arguments.export:
        _export(out, arguments.export, of_task=bool(arguments.task))
    return 0


def _export(run: pathlib.Path, path: str, of_task: bool) -> None:
    """Write the weights of a run's policy alone, without what a training needs."""
    from jaxcal.adaptive.policy import training
    from jaxcal.learning.runtime import weights
    from jaxcal.learning.training import checkpoint

    load: Callable[..., Any] = training.load if of_task else checkpoint.load
    weights.write(path, load(run).weights)
    print(f"exported the policy alone to {path}")


def _train(config: Any, arguments: TrainOptions, out: pathlib.Path, stop: Stop) -> int:
    """Updates made."""
    import numpy as np

    from jaxcal.learning.runtime import devices

    trainer: Any
    more: dict[str, Any] = {}
    first = devices.is_first()
    validates = first and not (arguments.task or arguments.no_validation)
    if arguments.task:
        from jaxcal.adaptive.policy import training as trainer

        schema, unit, columns = trainer.SCHEMA, "decisions", _TASK
        introduction = f"task {config.task}, seed {config.seed}; run folder {out}"
    else:
        from jaxcal.commands.train_solvers import fixed_validation, teacher
        from jaxcal.learning.training import checkpoint
        from jaxcal.learning.training import postures as trainer

        rows = config.ppo.rows_per_minibatch
        mesh = devices.make_mesh(rows, arguments.devices, config.num_runs)
        schema, unit, columns = checkpoint.SCHEMA, "episodes", _POSTURES
        introduction = _introduction(config, out, devices.describe(mesh))
        more = {"validation": None, "teacher": teacher}
    if first:
        print(f"{introduction}\nconfiguration:")
        print(
            pprint.pformat(config.as_meta(), width=88, compact=True, sort_dicts=False)
        )
        if validates:
            more["validation"] = fixed_validation(config)
        _begin_table(unit, columns)
    state = trainer.train(
        config,
        out,
        resume=arguments.resume,
        report=lambda report: _show(report, trainer.MEASURED),
        should_stop=stop,
        num_devices=arguments.devices,
        **more,
    )
    if first:
        _compare_runs(out, config, trainer.MEASURED, schema)
    return int(np.max(state.num_updates))


def _task_held(out: pathlib.Path) -> str | None:
    """The task that a run is of; None of postures, or where there is no run.

    Raises:
        ValueError: the task cannot be loaded, a file that has moved, say.
    """
    from jaxcal.adaptive.policy.training import SCHEMA
    from jaxcal.adaptive.tasks import registry
    from jaxcal.learning.training import checkpoint

    try:
        task = str(checkpoint.read_meta(out, SCHEMA)[1]["task"])
    except checkpoint.CheckpointError:
        return None
    try:
        registry.load(task)
    except ValueError as error:
        raise ValueError(
            f"{out} is a run of task {task}: {error}; say where it is by --task FILE"
        ) from error
    return task


def _num_runs(arguments: TrainOptions, out: pathlib.Path) -> int:
    """How many runs begin or go on together; what is wrong is refused later."""
    from jaxcal.learning.config import runs_of

    seeds = arguments.values.get("num_seeds") or 1
    sweep: Sequence[Any] = arguments.sweep
    if arguments.resume:
        from jaxcal.adaptive.policy.training import SCHEMA
        from jaxcal.learning.training import checkpoint

        schema = SCHEMA if arguments.task else checkpoint.SCHEMA
        with contextlib.suppress(checkpoint.CheckpointError):
            meta = checkpoint.read_meta(out, schema)[1]
            seeds, sweep = meta["num_seeds"], meta.get("sweep", ())
    return len(runs_of(0, seeds, sweep))


# -- what to train ---------------------------------------------------------------------


def _configuration(arguments: TrainOptions, out: pathlib.Path) -> TrainConfig:
    """Configuration of postures: from the flags, or from the run to go on with."""
    from jaxcal.commands.train_arguments import (
        candidates_of,
        given_flags,
        preset_of,
        trained_on,
    )
    from jaxcal.learning.training import presets

    flags = given_flags(arguments, task=False)
    path = arguments.candidates
    candidates = candidates_of(path) if path else None
    config = presets.load(preset_of(arguments))
    if arguments.trainer == "brax":
        config = _for_brax(config, arguments, flags)
    if arguments.resume:
        budget = _budget(flags)
        _refuse_with_resume(flags | _swept(arguments), out)
        return _prolonged(_configuration_of(out, candidates), budget)
    _refuse_to_overwrite(out)
    if candidates is None:
        config = presets.with_values(config, flags)
    else:
        config = trained_on(config, candidates, flags)
    config = dataclasses.replace(config, sweep=tuple(arguments.sweep))
    if config.num_runs > 1 and arguments.no_validation:
        raise ValueError(
            "--seeds and --sweep need the validation by which the best is known: leave "
            "--no-validation out"
        )
    require_writable_folder(out)
    return config


def _configuration_of(
    out: pathlib.Path, candidates: GivenCandidates | None
) -> TrainConfig:
    """The configuration of a run to go on with, on the same candidates."""
    from jaxcal.learning.training import checkpoint
    from jaxcal.learning.training.presets import TrainConfig

    config = TrainConfig.from_meta(checkpoint.read_meta(out)[1])
    held = config.tasks[0].given
    if held != candidates:  # they are compared by their digest
        what = f"{held.name} (SHA-256 {held.sha256[:12]})" if held else "no file"
        rule = "give the same file" if held else "leave it out"
        raise ValueError(f"--candidates: the run was trained on {what}; {rule}")
    if candidates is not None:
        task = dataclasses.replace(config.tasks[0], given=candidates)
        config = dataclasses.replace(config, tasks=(task,))
    return config


def _for_brax(
    config: TrainConfig, arguments: TrainOptions, given: dict[str, Any]
) -> TrainConfig:
    """A preset as brax trains it; what brax does not read is refused."""
    import jax

    from jaxcal.commands.train_arguments import flag_of

    with needs("study", "--trainer brax"):
        from jaxcal.learning.training import brax_ppo

    refused = {"resume": arguments.resume, "sweep": arguments.sweep}
    for name, value in (refused | given).items():
        if value and name in ("resume", "sweep", "num_seeds"):
            raise ValueError(f"{flag_of(name)} works with --trainer jaxcal only")
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


def _task_configuration(arguments: TrainOptions, out: pathlib.Path) -> PolicyConfig:
    """Configuration of a task: from the flags, or from the run to go on with."""
    from jaxcal.adaptive.policy import training
    from jaxcal.adaptive.policy.config import PolicyConfig
    from jaxcal.adaptive.tasks import registry
    from jaxcal.commands.train_arguments import TASK_PARTS, given_flags
    from jaxcal.learning.config import settings_of
    from jaxcal.learning.training import checkpoint

    assert arguments.task is not None  # it is what this function is for
    entry = registry.load(arguments.task)
    flags = given_flags(arguments, task=True)
    if arguments.resume:
        more = {"with": arguments.with_} if arguments.with_ else {}
        budget = _budget(flags)
        _refuse_with_resume(flags | more | _swept(arguments), out)
        _, meta = checkpoint.read_meta(out, training.SCHEMA)
        config = PolicyConfig.from_meta(meta)
        held, given_task = map(pathlib.Path, (config.task, arguments.task))
        moved = held.suffix == ".py" and held.name == given_task.name
        if held != given_task and not moved:
            raise ValueError(f"--task must be {config.task}, that of {out}")
        return _prolonged(dataclasses.replace(config, task=arguments.task), budget)
    _refuse_to_overwrite(out)
    options = entry.train_on
    if arguments.with_:
        options = (registry.options_from(entry, arguments.with_),)
    ppo, policy = (
        {
            f.name: flags[f.name]
            for f in settings_of(TASK_PARTS[part])
            if f.name in flags
        }
        for part in ("ppo", "policy")
    )
    require_writable_folder(out)
    base = entry.rules.get("state") or _tuned(entry, options[0])
    config = PolicyConfig(task=arguments.task, base=base, options=options, **policy)
    changed = dataclasses.replace(config.ppo, **ppo)
    return dataclasses.replace(config, ppo=changed, sweep=tuple(arguments.sweep))


def _tuned(entry: Entry, options: Mapping[str, Any]) -> StateRule:
    """The base rule of a task that ships none: tuned before the training."""
    from jaxcal.adaptive.rules import StateRule
    from jaxcal.adaptive.tuning import tune

    print("tuning the rule that the policy begins as ...", flush=True)
    return tune(entry.make(**options), StateRule(), episodes=1024, seed=1)


def _swept(arguments: TrainOptions) -> dict[str, Any]:
    return {"sweep": arguments.sweep} if arguments.sweep else {}


def _budget(flags: dict[str, Any]) -> dict[str, int]:
    """What a run may be prolonged to, taken out of the flags."""
    names = [name for name in ("num_episodes", "num_updates") if name in flags]
    return {name: flags.pop(name) for name in names}


def _prolonged(config: Any, budget: Mapping[str, int]) -> Any:
    """A run to go on with to a larger budget; what it imitates stays what it was."""
    from jaxcal.commands.train_arguments import flag_of

    for name, value in budget.items():
        if value <= (held := getattr(config.ppo, name)):
            raise ValueError(
                f"{flag_of(name)} must be more than the run's {held}, got {value}"
            )
    imitated = getattr(config, "num_imitated", 0)
    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, **budget))
    if imitated:
        share = imitated / config.ppo.num_updates
        config = dataclasses.replace(config, imitation=share)
    return config


def _refuse_with_resume(given: Mapping[str, Any], out: pathlib.Path) -> None:
    from jaxcal.commands.train_arguments import flag_of

    if given:
        raise ValueError(
            f"--resume takes its configuration from {out}; leave out "
            + ", ".join(sorted(map(flag_of, given)))
        )


def _refuse_to_overwrite(out: pathlib.Path) -> None:
    steps = out / "checkpoint"
    if steps.is_dir() and any(steps.iterdir()):
        raise ValueError(
            f"--out {out} already holds a run: go on with --resume, or name another, "
            f"--out {out}_2 say"
        )


# -- what is said ----------------------------------------------------------------------


def _introduction(config: TrainConfig, out: pathlib.Path, devices: str) -> str:
    """What will be trained, in one line."""
    import jax

    shapes = jax.eval_shape(config.learners[0].init, jax.random.key(0))
    size = sum(leaf.size for leaf in jax.tree.leaves(shapes))
    task, seed = config.tasks[0], f"seed {config.seed}"
    if config.num_seeds > 1:
        seed = f"seeds {config.seed} to {config.seed + config.num_seeds - 1}"
    for name, values in config.sweep:
        seed += f", {name} " + " ".join(f"{value:g}" for value in values)
    env = task.environment
    origin = f" from {task.given.name}" if task.given else ""
    return (
        f"preset {config.preset}: {config.network.kind} network, {size:,} parameters; "
        f"choose {env.num_selected} of {env.num_candidates}{origin}; "
        f"{config.ppo.num_episodes:,} episodes, {seed}, on {devices}; run folder {out}"
    )


@contextlib.contextmanager
def _stop_on_signals() -> Iterator[Stop]:
    """Whether Ctrl-C or SIGTERM asked to save and stop; a second Ctrl-C is at once."""
    asked: list[int] = []

    def ask(number: int, frame: Any) -> None:
        asked.append(number)
        print("\nstopping after this update and saving ...", flush=True)
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = {n: signal.signal(n, ask) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _begin_table(unit: str, columns: tuple[str, str, str]) -> None:
    reward, first, second = columns
    print(
        "compiling the training step (some 15 s; a few seconds where this "
        "machine has compiled it before) ...\n"
        f"   update {unit:>10}     /s   elapsed      left {reward:>8} {first:>16} "
        f"{second:>16}",
        flush=True,
    )


def _show(report: Report, measured: tuple[str, ...]) -> None:
    """One line of progress; of several seeds the mean and the standard deviation."""
    metrics, reward = report.metrics, report.metrics.get("reward_mean")
    cells = []
    for name in measured:
        if name in metrics:
            spread = report.spread[name]
            cell = f"{metrics[name]:.4f}" + (f" +- {spread:.4f}" if spread else "")
            cells.append(f"{cell:>16}")
    print(
        f"{report.update:9,d} {report.played:10,d} {report.per_second:6,.0f} "
        f"{_clock(report.seconds):>9} {_clock(report.eta):>9} "
        + (" imitate " if reward is None else f"{_or_dash(reward, '.4f'):>8} ")
        + " ".join(cells)
        + f"  {report.skipped} updates skipped, not finite" * bool(report.skipped),
        flush=True,
    )


def _or_dash(value: float, form: str) -> str:
    """A number; a dash where no session ended, so that there is none."""
    return "-" if math.isnan(value) else format(value, form)


def _compare_runs(
    out: pathlib.Path, config: Any, measured: tuple[str, ...], schema: str
) -> None:
    """What every seed reached with every swept value, where they were several."""
    import numpy as np

    from jaxcal.learning.training import checkpoint

    if config.num_runs == 1:
        return
    progress = checkpoint.read_meta(out, schema)[1]["progress"]
    values = np.array([[seed[name] for name in measured] for seed in progress["seeds"]])
    if not len(values):
        return
    runs = config.runs
    names, best = runs[0], progress["best"]
    wide = {name: max(len(name), 9) for name in names}
    print(
        " ".join(f"{n:>{wide[n]}}" for n in names)
        + "".join(f"{n:>17}" for n in measured)
    )
    for number, (run, row) in enumerate(zip(runs, values, strict=True)):
        print(
            " ".join(f"{run[n]:{wide[n]}g}" for n in names)
            + "".join(f"{x:17.4f}" for x in row)
            + ("  best" if number == best else "")
        )
    if config.sweep:
        return
    for name, row in (("mean", values.mean(0)), ("spread", values.std(0, ddof=1))):
        print(f"{name:>9}" + "".join(f"{x:17.4f}" for x in row))


def _clock(seconds: float) -> str:
    """h:mm:ss."""
    return str(datetime.timedelta(seconds=round(seconds)))
