"""``python train.py`` and ``jaxcal train``: parse, train, say how it goes.

What is trained selects postures, or with ``--task`` picks the next measurement.
"""

from __future__ import annotations

import contextlib
import datetime
import functools
import math
import pathlib
import pprint
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal.arguments import refused, told, typed_line
from jaxcal.checks import aligned
from jaxcal.commands.train_configuration import (
    TrainOptions,
    of_postures,
    of_task,
    read,
)
from jaxcal.extras import MissingExtraError, needs
from jaxcal.learning.runtime import processes

if TYPE_CHECKING:
    from jaxcal.learning.training.postures import Validation
    from jaxcal.learning.training.presets import TrainConfig
    from jaxcal.learning.training.run import Report


Stop = Callable[[], bool]

# Columns of progress: the reward of an update, and what is measured on fixed sets.
_POSTURES = ("reward", "ratio to exact", "optima hit")
_TASK = ("reward", "nats", "less the rule's")
_VALIDATED = 500  # sets that a training run is measured on


def main(argv: Sequence[str] | None = None, prog: str = "jaxcal train") -> int:
    """Train: 0 when trained or stopped on request, 1 where the training diverged, 2
    when something given was wrong, 3 where another process of the job was lost."""
    words = list(sys.argv[1:] if argv is None else argv)

    def alone() -> int:  # this process may be one of several
        processes.keep_compiled_programs()
        try:
            with needs("policy", "training"):
                arguments = read(prog, words)
            with told():
                return _run(arguments, prog)
        except (ValueError, OSError, MissingExtraError) as error:
            return refused(prog, error)

    advice = "saved checkpoints are kept: start every process again with --resume"
    return processes.run_job(prog, words, alone, advice)


def _run(arguments: TrainOptions, prog: str) -> int:
    """Train, say how it went; of several processes the first speaks for all."""
    named = pathlib.Path(arguments.task or arguments.preset_name).stem
    out = pathlib.Path(arguments.out or f"runs/{named}")
    if arguments.resume and not arguments.task:
        with needs("policy", "training"):
            arguments.task = _task_held(out)
    if arguments.export and not arguments.export.endswith(".npz"):
        raise ValueError(f"--export takes a file NAME.npz, got {arguments.export}")
    made_by = of_task if arguments.task else of_postures
    configure: Any = functools.partial(made_by, arguments, out)
    jax, config = sys.modules.get("jax"), None
    seeds = arguments.values.get("num_seeds") or 1
    with needs("policy", "training"):
        if arguments.task and seeds > 1:  # before a rule of the task is tuned
            from jaxcal.learning.runtime import devices

            devices.a_device_for_each_core(seeds)
        if jax is None or not jax.distributed.is_initialized():
            config = configure()  # what is wrong is said before JAX is loaded
        from jaxcal.learning.runtime import devices

    if (seeds := getattr(config, "num_seeds", seeds)) > 1:
        devices.a_device_for_each_core(seeds)
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
            f"stopped at update {done} of {config.ppo.num_updates} and saved. To "
            f"continue: {typed_line(prog)}{task} --resume --out {out}"
        )
        return 0
    print(
        f"saved {out}/checkpoint. To evaluate: "
        f"{typed_line(prog.replace('train', 'evaluate'))}{task} --checkpoint {out}"
    )
    if arguments.export:
        from jaxcal.adaptive.policy import training
        from jaxcal.learning.runtime import weights
        from jaxcal.learning.training import checkpoint

        load: Callable[..., Any] = training.load if arguments.task else checkpoint.load
        weights.write(arguments.export, load(out).weights)
        print(f"exported the policy to {arguments.export}")
    return 0


def _train(config: Any, arguments: TrainOptions, out: pathlib.Path, stop: Stop) -> int:
    from jaxcal.learning.runtime import devices

    trainer: Any
    more: dict[str, Any] = {}
    first = devices.is_first()
    if arguments.task:
        from jaxcal.adaptive.policy import training as trainer

        schema, columns = trainer.SCHEMA, _TASK
        introduction = f"task {config.task}, seed {config.seed}; run folder {out}"
    else:
        from jaxcal.learning.training import checkpoint
        from jaxcal.learning.training import postures as trainer

        rows = config.ppo.rows_per_minibatch
        mesh = devices.make_mesh(rows, arguments.devices, config.num_seeds)
        schema, columns = checkpoint.SCHEMA, _POSTURES
        introduction = _introduction(config, out, devices.describe(mesh))
        more = {"teacher": _teacher}
    if first:
        print(f"{introduction}\nconfiguration:")
        pprint.pp(config.as_meta(), width=88, compact=True)
        if not (arguments.task or arguments.no_validation):
            more["validation"] = _fixed_validation(config)
        reward, *measured = columns
        heads = f"{reward:>8} " + " ".join(f"{name:>16}" for name in measured)
        print(
            "compiling the training step (some 15 s; a few seconds where this "
            "machine has compiled it before) ...\n"
            f"   update {config.ppo.unit:>10}     /s   elapsed      left {heads}",
            flush=True,
        )
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
    """The task that a run is of; None of postures, or where there is no run. A task
    that cannot be loaded, a file that has moved, say, is refused."""
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
            f"{out} is a run of task {task}: {error}. Give its file: --task FILE"
        ) from error
    return task


def _introduction(config: TrainConfig, out: pathlib.Path, devices: str) -> str:
    import jax

    shapes = jax.eval_shape(config.learners[0].init, jax.random.key(0))
    size = sum(leaf.size for leaf in jax.tree.leaves(shapes))
    task, seed = config.tasks[0], f"seed {config.seed}"
    if config.num_seeds > 1:
        seed = f"seeds {config.seed} to {config.seed + config.num_seeds - 1}"
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


def _show(report: Report, measured: tuple[str, ...]) -> None:
    """One line of progress; of several seeds the mean and the standard deviation."""
    metrics, reward = report.metrics, " imitate"
    if (mean := metrics.get("reward_mean")) is not None:
        reward = "-" if math.isnan(mean) else f"{mean:.4f}"  # -: no session ended
    cells = []
    for name in measured:
        if name in metrics:
            spread = report.spread[name]
            cell = f"{metrics[name]:.4f}" + (f" +- {spread:.4f}" if spread else "")
            cells.append(f"{cell:>16}")
    print(
        f"{report.update:9,d} {report.played:10,d} {report.per_second:6,.0f} "
        f"{_clock(report.seconds):>9} {_clock(report.eta):>9} {reward:>8} "
        + " ".join(cells)
        + f"  {report.skipped} updates skipped (not finite)" * bool(report.skipped),
        flush=True,
    )


def _compare_runs(
    out: pathlib.Path, config: Any, measured: tuple[str, ...], schema: str
) -> None:
    """What every seed reached, where they were several."""
    import numpy as np

    from jaxcal.learning.training import checkpoint

    if config.num_seeds == 1:
        return
    progress = checkpoint.read_meta(out, schema)[1]["progress"]
    values = np.array([[seed[name] for name in measured] for seed in progress["seeds"]])
    if not len(values):
        return
    heads = [*map(str, range(config.seed, config.seed + len(values))), "mean", "spread"]
    values = np.stack([*values, values.mean(0), values.std(0, ddof=1)])
    table = [["seed", *measured, ""]]
    for number, (head, row) in enumerate(zip(heads, values, strict=True)):
        best = "best" * (number == progress["best"])
        table.append([head, *(f"{x:.4f}" for x in row), best])
    print("\n".join(aligned(table)))


def _clock(seconds: float) -> str:
    return str(datetime.timedelta(seconds=round(seconds)))


def _fixed_validation(config: TrainConfig) -> Validation:
    """500 uniform sets, never trained on, that depend on M and n of the first task
    only, or draws of the user's candidates; and their optima."""
    import jax

    from jaxcal.learning.training.postures import Validation
    from jaxcal.selection import exact_batch

    task = config.tasks[0]
    env = task.environment
    if task.given is not None:
        states = jax.vmap(task.reset)(
            jax.random.split(jax.random.key(20261121), _VALIDATED)
        )
        sets = np.asarray(states.candidates, np.float64)
        free = np.asarray(states.available)
    else:
        rng = np.random.default_rng([20261121, env.num_candidates, env.num_inputs])
        sets = rng.uniform(size=(_VALIDATED, env.num_candidates, env.num_inputs))
        free = np.ones(sets.shape[:2], bool)
    best = exact_batch(sets, env.num_selected, available=free, num_outputs=1).log_det
    return Validation(sets, np.asarray(best), env.num_outputs, free)


def _teacher(
    candidates: np.ndarray, available: np.ndarray, given: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """A ``postures.Teacher``: the proven optimum where k is the number of regressors;
    above it what Fedorov exchange finds, almost always that, in a time that does not
    depend on the shape of the candidates."""
    from jaxcal.selection import exact_batch, exchange_batch

    required = given if given.shape[1] else None
    solve = exact_batch if k == candidates.shape[2] + 1 else exchange_batch
    solved = solve(candidates, k, available=available, required=required, num_outputs=1)
    return solved.indices, solved.log_det
