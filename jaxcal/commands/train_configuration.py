"""What ``train`` is given and begins with: flags, from the fields of configurations, a
configuration, the user's own postures."""

from __future__ import annotations

import dataclasses
import pathlib
import textwrap
from collections.abc import Collection, Iterable, Mapping, Sequence
from inspect import signature
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from jaxcal.adaptive.policy.config import PPO, PolicyConfig
from jaxcal.arguments import Parser, outdated, typed_line, values_of
from jaxcal.checks import nearest
from jaxcal.commands.tables import holds_sets, read_pool
from jaxcal.extras import needs
from jaxcal.files import require_writable_folder
from jaxcal.learning.config import StreamsConfig, settings_of
from jaxcal.learning.environments.task import GivenCandidates
from jaxcal.learning.runtime import processes
from jaxcal.learning.training import presets
from jaxcal.learning.training.presets import TrainConfig

_EPILOG = """\
presets for postures:
{presets}

tasks of sequential measurement:
{tasks}
  FILE.py   your own: a file that defines ENTRY (docs/adaptive.md)

what to try first:
  {program}                        the compact policy, half a minute on one core
  {program} --episodes 20000 --out runs/brief   quicker, to try things
  {program} --num-selected 6 --out runs/six     another number of postures
  {program} --candidates mine.csv --out runs/mine   your own machine's postures
  then --imitation 0.5 --with initial_trust=4 initial_actor=0.05, which helps most
  when more than n + 1 postures are chosen. Other settings rarely need a change:
  --help all.

more examples:
  {program} --task knee            choose each measurement from the last results
  {program} --seeds 8 --out runs/seeds   eight runs side by side: mean, spread, best
  {program} --resume --out runs/compact      resume a run
  {program} --resume --episodes 200000 --out runs/compact   and extend it
  {program} --preset general --export checkpoints/default.npz   the shipped policy
  {program} --trainer brax --episodes 50000  the same task, brax's own PPO
  srun {program}                             all tasks of a SLURM job step

A run folder holds metrics.csv and checkpoint/. Evaluate it with
  {evaluate} --checkpoint runs/compact
Ctrl-C saves and stops; --resume then continues bit for bit (on the same CPU).
All devices of all processes share each update: docs/scaling.md."""

TASK_PARTS = (StreamsConfig, PolicyConfig)
# Settings that have a flag; the others are given by --with.
FLAGS = {"seed", "seeds", "learning_rate", "width", "episodes", "updates", "kind"} | {
    *("num_selected", "num_candidates", "num_inputs", "imitation")
}
_NAMES = {"num_episodes": "episodes", "num_updates": "updates", "num_seeds": "seeds"}


@dataclasses.dataclass
class TrainOptions:
    """What is trained and where it is kept."""

    RARE: ClassVar[Any] = {"no_validation", "devices"}

    preset: Annotated[str | None, "for postures, see below [compact]", "NAME"] = None
    task: Annotated[str | None, "of sequential measurement, see below", "NAME"] = None
    with_: Annotated[
        tuple[str, ...],
        "options of the task, and settings: --help all lists these",
        "NAME=VALUE",
    ] = ()
    out: Annotated[str | None, "run folder [runs/PRESET or runs/TASK]", "DIR"] = None
    resume: Annotated[bool, "resume from the run folder's checkpoint"] = False
    candidates: Annotated[
        str | None,
        "train on your own postures: a table (.csv) of postures, from which every "
        "episode draws --num-candidates, or a dataset (.csv or .npz) of candidate sets",
        "FILE",
    ] = None
    trainer: Annotated[
        Literal["jaxcal", "brax"], "jaxcal's own PPO, or brax's on the same environment"
    ] = "jaxcal"
    export: Annotated[
        str | None, "also write the finished policy to one file, NAME.npz", "FILE"
    ] = None
    no_validation: Annotated[
        bool, "do not measure the gap to the proven optimum during training"
    ] = False
    devices: Annotated[int | None, "devices of each process [all]"] = None
    # What the other flags set: field of a configuration to value.
    values: dict[str, Any] = dataclasses.field(default_factory=dict, init=False)

    @property
    def preset_name(self) -> str:
        """The preset that was given; else the smallest."""
        return self.preset or "compact"


def flag_of(name: str) -> str:
    """The flag that sets a field."""
    if name in _BY_WITH:
        return f"--with {name}"
    return "--" + _NAMES.get(name, name).rstrip("_").replace("_", "-")


def _settings(*parts: Any) -> dict[str, tuple[dataclasses.Field[Any], Any]]:
    """By name: the fields of configurations that a command shows, and their values."""
    return {
        f.name: (f, getattr(part, f.name)) for part in parts for f in settings_of(part)
    }


def _flags(title: str, settings: Iterable[tuple[dataclasses.Field[Any], Any]]) -> type:
    """A dataclass of the settings that have a flag, None where one is not given, as
    ``Parser.of`` reads."""
    shown: dict[Any, str] = {int: "N", float: "X", str: "NAME", bool: ""}
    kinds = {kind.__name__: kind for kind in shown}
    fields = []
    for field, value in settings:
        if _NAMES.get(field.name, field.name) not in FLAGS:
            continue
        single = kinds[str(field.type)]
        kind: Any = single | None
        said = Annotated[kind, f"{field.metadata['help']} [{value}]", shown[single]]
        default = dataclasses.field(default=None)
        fields.append((_NAMES.get(field.name, field.name), said, default))
    about = "in brackets: the value of compact"
    names = {"TITLE": title, "ABOUT": about}
    return dataclasses.make_dataclass("Settings", fields, namespace=names)


_RUN = presets.load("compact")
_POSTURES = _settings(_RUN, _RUN.ppo, _RUN.network, _RUN.tasks[0].environment)
_TASKS = _settings(PPO, PolicyConfig)
_ONE = [field for name, field in _POSTURES.items() if name not in _TASKS]
_OTHER = [field for name, field in _TASKS.items() if name not in _POSTURES]
_BOTH = [field for name, field in _POSTURES.items() if name in _TASKS]
_BY_WITH = {
    name: setting
    for name, setting in (_TASKS | _POSTURES).items()
    if _NAMES.get(name, name) not in FLAGS
}
Shared = _flags("for postures and tasks", _BOTH)
OfPostures = _flags("for postures, in presets of one task", _ONE)
OfTasks = _flags("of tasks", _OTHER)


def asked(
    options: TrainOptions,
    job: processes.Job,
    shared: Shared,  # type: ignore[valid-type]  # made of the configurations
    postures: OfPostures,  # type: ignore[valid-type]
    tasks: OfTasks,  # type: ignore[valid-type]
) -> TrainOptions:
    """The options, with the settings that were given; the flags of ``train``."""
    fields = {flag: name for name, flag in _NAMES.items()}
    for part in (shared, postures, tasks):
        options.values |= {
            fields.get(name, name): value
            for name, value in vars(part).items()
            if value is not None
        }
    return options


def read(prog: str, argv: Sequence[str]) -> TrainOptions:
    """The command line; ``prog`` is what was typed, "train.py" or "jaxcal train"."""
    more = None
    if {"-h", "--help"} & set(argv):  # else tasks are not loaded, nor JAX with them
        from jaxcal.adaptive.tasks import registry

        more = _EPILOG.format(
            program=typed_line(prog),
            evaluate=typed_line(prog.replace("train", "evaluate")),
            presets=_abouts(presets),
            tasks=_abouts(registry),
        )
        more += _help_of_with() if argv[-1] == "all" else ""
    parser = Parser(
        prog=prog,
        usage="%(prog)s [--preset NAME | --task NAME] [--out DIR] [flags below]",
        description=textwrap.fill(
            "Train a policy and save it with everything it needs. The policy selects "
            "postures, or with --task picks the next measurement. Without flags: our "
            "network on geometric features. --preset paper: the paper's network on the "
            "210 numbers of its observation. --preset observation: our network on "
            "these numbers, by PPO alone.",
            86,
        ),
        epilog=more,
    ).of(asked)
    words, settings = _without_old(prog, argv)
    options = asked(**values_of(parser.parse_args(words)))
    options.with_ = (*options.with_, *settings)
    return options


def _without_old(prog: str, argv: Sequence[str]) -> tuple[list[str], tuple[str, ...]]:
    """The words without the flags of 0.2 that are settings of ``--with`` now, and
    these."""
    words: list[str] = []
    settings: list[str] = []
    rest = iter(argv)
    for word in rest:
        flag, equals, value = word.partition("=")
        name = flag.removeprefix("--").replace("-", "_")
        yes = name in _BY_WITH
        name = name if yes else name.removeprefix("no_")
        switch = name in _BY_WITH and _BY_WITH[name][0].type == "bool"
        if not flag.startswith("--") or name not in _BY_WITH or not (yes or switch):
            words.append(word)
            continue
        value = str(yes).lower() if switch else value if equals else next(rest, "")
        settings.append(f"{name}={value}")
        outdated(prog, flag, f"--with {settings[-1]}")
    return words, tuple(settings)


def _help_of_with() -> str:
    """The settings of ``--with`` in lines."""
    lines = ["", "", "settings, --with NAME=VALUE, in brackets the value of compact:"]
    for name, (field, value) in _BY_WITH.items():
        said = f"  {name:24} {field.metadata['help']} [{value}]"
        lines += textwrap.wrap(said, 86, subsequent_indent=" " * 27)
    return "\n".join(lines)


def _value_of(name: str, text: str) -> Any:
    """The value of a setting of ``--with``."""
    kind = str(_BY_WITH[name][0].type)
    if kind == "bool":
        if text.lower() not in ("true", "false"):
            raise ValueError(f"--with {name} must be true or false, got {text!r}")
        return text.lower() == "true"
    try:
        return {"int": int, "float": float, "str": str}[kind](text)
    except ValueError:
        what = "a whole number" if kind == "int" else "a number"
        raise ValueError(f"--with {name} must be {what}, got {text!r}") from None


def given_settings(
    arguments: TrainOptions, options: Collection[str] | None
) -> tuple[dict[str, Any], list[str]]:
    """The fields of a configuration that were given: name to value; one that the task,
    or the preset, does not read is refused. And what else ``--with`` names, of a task
    with these ``options``, None for postures."""
    task, values, others = options is not None, dict(arguments.values), []
    for text in arguments.with_:
        name, equals, value = text.partition("=")
        name = name.replace("-", "_")
        if equals and name in _BY_WITH and name not in (options or ()):
            values[name] = _value_of(name, value)
        elif task:
            others.append(text)
        else:
            like = nearest(name, _POSTURES)
            more = f"; did you mean {flag_of(like)}?" if like else ""
            raise ValueError(
                "--with must be NAME=VALUE with a NAME that --help all lists, "
                f"got {text!r}{more}"
            )
    flags, read = values, _TASKS if task else _POSTURES
    refused = ("preset", "candidates", "no_validation") if task else ()
    unread = {*flags} - {*read} | {name for name in refused if getattr(arguments, name)}
    if task and arguments.trainer != "jaxcal":
        unread.add("trainer")
    if unread:
        who = f"--task {arguments.task}" if task else f"preset {arguments.preset_name}"
        it = "it" if len(unread) == 1 else "them"
        names = ", ".join(sorted(map(flag_of, unread)))
        raise ValueError(f"{who} does not use {names}: leave {it} out")
    return flags, others


def _abouts(known: Any) -> str:
    """The lines on presets, or tasks, that the module or registry knows."""
    lines = []
    for name in known.names():
        about = f"  {name:9} {known.load(name).about}"
        lines += textwrap.wrap(about, 86, subsequent_indent=" " * 12)
    return "\n".join(lines)


# -- configurations --------------------------------------------------------------------


def of_postures(arguments: TrainOptions, out: pathlib.Path) -> TrainConfig:
    """Configuration of postures: from the flags, or from the run to go on with."""
    flags, _ = given_settings(arguments, None)
    path = arguments.candidates
    candidates = candidates_of(path) if path else None
    config = presets.load(arguments.preset_name)
    if arguments.trainer == "brax":
        config = _for_brax(config, arguments, flags)
    if arguments.resume:
        config = _configuration_of(out, candidates)
        return _prolonged(config, flags, out)
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
    flags, others = given_settings(arguments, signature(entry.make).parameters)
    if arguments.resume:
        config = PolicyConfig.from_meta(checkpoint.read_meta(out, training.SCHEMA)[1])
        held, given_task = map(pathlib.Path, (config.task, arguments.task))
        moved = held.suffix == ".py" and held.name == given_task.name
        if held != given_task and not moved:
            raise ValueError(f"--task must be {config.task}, the task of {out}")
        config = dataclasses.replace(config, task=arguments.task)
        named = {"with": others} if others else {}  # options of the task
        return _prolonged(config, flags | named, out)
    _refuse_to_overwrite(out)
    options = registry.options_from(entry, others)
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


def _prolonged(config: Any, flags: Mapping[str, Any], out: pathlib.Path) -> Any:
    """A run to go on with, where asked to a larger budget; what it imitates stays what
    it was. Other flags are refused beside ``--resume``."""
    if unread := {*flags} - {"num_episodes", "num_updates"}:
        raise ValueError(
            f"--resume takes its configuration from {out}; leave out "
            + ", ".join(sorted(map(flag_of, unread)))
        )
    for name, value in flags.items():
        if value < (held := getattr(config.ppo, name)):
            raise ValueError(
                f"{flag_of(name)} must be at least {held}, what the run already has, "
                f"got {value}"
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


# -- the user's own postures -----------------------------------------------------------


def candidates_of(path: str) -> GivenCandidates:
    """The user's own, each axis mapped to [0, 1] over the whole file: the best postures
    do not depend on the unit; float32 and the paper's network do."""
    from jaxcal.evaluation.dataset import load_dataset

    if holds_sets(path):
        dataset = load_dataset(path)
        values, available = dataset.candidates, dataset.available
    else:
        rows, mask = read_pool(path)
        values, available = rows[None], None if mask is None else mask[None]
    used = values if available is None else values[available]
    used = used.reshape(-1, used.shape[-1])
    low, high = used.min(axis=0), used.max(axis=0)
    for axis in np.flatnonzero(~(low < high)):  # also where a cell is empty
        raise ValueError(
            f"{path}: input {axis + 1} must hold numbers that differ, got "
            f"{low[axis]:g} to {high[axis]:g}: leave its column out"
        )
    return GivenCandidates(
        name=pathlib.Path(path).name,
        values=((values - low) / (high - low)).astype(np.float32),
        available=available,
    )


def trained_on(
    config: TrainConfig, candidates: GivenCandidates, given: dict[str, Any]
) -> TrainConfig:
    """A preset of one task, on the user's candidates."""
    assert candidates.values is not None  # it was just read
    num_sets, m, n = candidates.values.shape
    if len(config.tasks) > 1:
        raise ValueError(
            "--candidates needs a preset of one task, such as compact; "
            f"{config.preset} has {len(config.tasks)}"
        )
    sizes = {"num_inputs": n, "num_outputs": n, "num_selected": n + 1}
    fixed = {"num_inputs": n} | ({"num_candidates": m} if num_sets > 1 else {})
    for name, value in fixed.items():
        if given.get(name, value) != value:
            raise ValueError(
                f"{flag_of(name)} must be {value}, as in {candidates.name}, got "
                f"{given[name]}: leave it out"
            )
    config = presets.with_values(config, sizes | fixed | given)
    candidates.source(config.tasks[0].environment)  # refuses a pool that is too small
    task = dataclasses.replace(config.tasks[0], given=candidates)
    return dataclasses.replace(config, tasks=(task,))
