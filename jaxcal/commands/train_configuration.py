"""What ``train`` begins with: a configuration, sets to validate on, what to imitate."""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxcal.adaptive.policy.config import PolicyConfig
from jaxcal.commands.train_arguments import (
    TASK_PARTS,
    TrainOptions,
    candidates_of,
    flag_of,
    given_flags,
    trained_on,
)
from jaxcal.extras import needs
from jaxcal.files import require_writable_folder
from jaxcal.learning.config import settings_of
from jaxcal.learning.environments.task import GivenCandidates
from jaxcal.learning.training import presets
from jaxcal.learning.training.presets import TrainConfig
from jaxcal.selection import exact_batch, exchange_batch

if TYPE_CHECKING:
    from jaxcal.learning.training.postures import Validation

_VALIDATED = 500  # sets that a training run is measured on


def of_postures(arguments: TrainOptions, out: pathlib.Path) -> TrainConfig:
    """Configuration of postures: from the flags, or from the run to go on with."""
    flags = given_flags(arguments, task=False)
    path = arguments.candidates
    candidates = candidates_of(path) if path else None
    config = presets.load(arguments.preset_name)
    if arguments.trainer == "brax":
        config = _for_brax(config, arguments, flags)
    if arguments.resume:
        config = _configuration_of(out, candidates)
        return _prolonged(config, arguments, flags, out)
    _refuse_to_overwrite(out)
    if candidates is None:
        config = presets.with_values(config, flags)
    else:
        config = trained_on(config, candidates, flags)
    if config.num_seeds > 1 and arguments.no_validation:
        raise ValueError(
            "--seeds compares runs by validation: leave out --no-validation"
        )
    require_writable_folder(out)
    return config


def _configuration_of(
    out: pathlib.Path, candidates: GivenCandidates | None
) -> TrainConfig:
    from jaxcal.learning.training import checkpoint

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

    with needs("study", "--trainer brax"):
        from jaxcal.learning.training import brax_ppo

    if jax.process_count() > 1:
        raise ValueError("--trainer brax works in a single process only")
    if len(config.tasks) > 1:
        raise ValueError(
            f"--trainer brax trains on one task, preset {config.preset} has "
            f"{len(config.tasks)}: use compact or paper"
        )
    others = ("devices", "no_validation", "resume")
    names = {*given, *(name for name in others if getattr(arguments, name))}
    if unread := names - brax_ppo.READ:
        flags = ", ".join(sorted(map(flag_of, unread)))
        raise ValueError(f"--trainer brax does not use {flags}: leave it out")
    return brax_ppo.adapted(config)


def of_task(arguments: TrainOptions, out: pathlib.Path) -> PolicyConfig:
    """Configuration of a task: from the flags, or from the run to go on with."""
    from jaxcal.adaptive.policy import training
    from jaxcal.adaptive.rules import StateRule
    from jaxcal.adaptive.tasks import registry
    from jaxcal.adaptive.tuning import tune
    from jaxcal.learning.training import checkpoint

    assert arguments.task is not None  # it is what this function is for
    entry = registry.load(arguments.task)
    flags = given_flags(arguments, task=True)
    if arguments.resume:
        config = PolicyConfig.from_meta(checkpoint.read_meta(out, training.SCHEMA)[1])
        held, given_task = map(pathlib.Path, (config.task, arguments.task))
        moved = held.suffix == ".py" and held.name == given_task.name
        if held != given_task and not moved:
            raise ValueError(f"--task must be {config.task}, the task of {out}")
        config = dataclasses.replace(config, task=arguments.task)
        return _prolonged(config, arguments, flags, out)
    _refuse_to_overwrite(out)
    options = registry.options_from(entry, arguments.with_)
    ppo, policy = (
        {f.name: flags[f.name] for f in settings_of(part) if f.name in flags}
        for part in TASK_PARTS
    )
    require_writable_folder(out)
    base = entry.rules.get("state")
    if base is None:
        print("tuning the rule that the policy starts from ...", flush=True)
        base = tune(entry.make(**options), StateRule(), episodes=1024, seed=1)
    config = PolicyConfig(task=arguments.task, base=base, options=options, **policy)
    changed = dataclasses.replace(config.ppo, **ppo)
    return dataclasses.replace(config, ppo=changed)


def _prolonged(
    config: Any, arguments: TrainOptions, flags: Mapping[str, Any], out: pathlib.Path
) -> Any:
    """A run to go on with, where asked to a larger budget; what it imitates stays what
    it was. Other flags are refused beside ``--resume``."""
    given = {*flags, *(["with"] if arguments.with_ else [])}
    if unread := given - {"num_episodes", "num_updates"}:
        raise ValueError(
            f"--resume takes its configuration from {out}; leave out "
            + ", ".join(sorted(map(flag_of, unread)))
        )
    for name, value in flags.items():
        if value <= (held := getattr(config.ppo, name)):
            raise ValueError(
                f"{flag_of(name)} must be above {held}, what the run already has, got "
                f"{value}"
            )
    imitated = getattr(config, "num_imitated", 0)
    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, **flags))
    if imitated:
        share = imitated / config.ppo.num_updates
        config = dataclasses.replace(config, imitation=share)
    return config


def _refuse_to_overwrite(out: pathlib.Path) -> None:
    steps = out / "checkpoint"
    if steps.is_dir() and any(steps.iterdir()):
        raise ValueError(
            f"--out {out} already holds a run: pass --resume, or name another folder "
            f"such as {out}_2"
        )


def fixed_validation(config: TrainConfig) -> Validation:
    """500 uniform sets, never trained on, that depend on M and n of the first task
    only, or draws of the user's candidates; and their optima."""
    import jax

    from jaxcal.learning.training.postures import Validation

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


def teacher(
    candidates: np.ndarray, available: np.ndarray, given: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """A ``postures.Teacher``: the proven optimum where k is the number of regressors;
    above it what Fedorov exchange finds, almost always that, in a time that does not
    depend on the shape of the candidates."""
    required = given if given.shape[1] else None
    solve = exact_batch if k == candidates.shape[2] + 1 else exchange_batch
    solved = solve(candidates, k, available=available, required=required, num_outputs=1)
    return solved.indices, solved.log_det
