"""``jaxcal COMMAND``: parse, run, and report an error in one line."""

from __future__ import annotations

import importlib.metadata
import importlib.resources
import inspect
import os
import platform
import re
import sys
import warnings
from pathlib import Path
from typing import Annotated, Literal

from jaxcal.arguments import Parser, exit_code, outdated, told, values_of
from jaxcal.checks import aligned
from jaxcal.commands.tables import write_json
from jaxcal.extras import install
from jaxcal.files import require_kept, require_writable_folder, write_text

_HERE = {  # command: one line of help, and the module with its flags and function
    "select": ("choose the few rows of a table that are worth measuring", "questions"),
    "plan": ("number of measurements that a wanted accuracy needs", "questions"),
    "postures": ("the postures of an arm to measure, in order", "postures"),
    "identify": (
        "fit y = A u + b, or a model, to measurements and save the calibration",
        "calibrations",
    ),
    "check": (
        "test with a few new readings whether a calibration still holds",
        "calibrations",
    ),
    "predict": ("outputs of a calibrated machine for given commands", "calibrations"),
    "command": ("commands that reach given outputs", "calibrations"),
    "example": ("files to try the commands with", "program"),
    "doctor": ("versions and devices, for a bug report", "program"),
}
_WHOLE = {  # commands that parse their own arguments
    "train": ("train a policy (train.py)", "train"),
    "evaluate": ("compare methods with the proven optimum (evaluate.py)", "evaluate"),
}
COMMANDS = (*_HERE, *_WHOLE)
_OTHERS = ("all", "bench", "dev", "docs")  # extras that name others, or are not used
_EPILOG = """\
examples:
  jaxcal select candidates.csv -k 4                 the four rows to measure
  jaxcal select candidates.csv -k 6 --csv > plan.csv
  jaxcal select candidates.csv -k 30 --model arm.urdf --noise 0.0001
  jaxcal postures arm.urdf -k 12 --picture plan.png
  jaxcal identify measured.csv --out calibration.json
  jaxcal command calibration.json targets.csv --limits=-20,20
  jaxcal COMMAND --help                             options of one command

Tables are CSV, with or without a header; - is standard input."""

# table: three axes in degrees, noise 0.05; the best six of fifty rows were measured.
# arm: four joints and a tracker, degrees and metres; links are 1 mm off (1 sigma).
_TO_TYPE = {
    "table": """\
jaxcal select candidates.csv -k 6
jaxcal identify measured.csv --out calibration.json
jaxcal command calibration.json targets.csv --limits=-20,20""",
    "arm": """\
jaxcal select poses.csv -k 12 --model arm.urdf --noise 0.0001
jaxcal identify measured.csv --model arm.urdf --noise 0.0001 --out arm.json
jaxcal predict arm.json poses.csv""",
    "device": "jaxcal-rig simulate calibrate --config rig.toml",
}


def run(argv: list[str] | None = None) -> int:
    """Run one command: the exit code is 0, 1 where a calibration is not good, 2 where
    something given was wrong, 130 after Ctrl-C."""
    words = [*(sys.argv[1:] if argv is None else argv)]
    if words and words[0] in _WHOLE:
        module = importlib.import_module(f"jaxcal.commands.{words[0]}")
        return int(module.main(words[1:], prog=f"jaxcal {words[0]}"))
    if words[:1] == ["score"]:
        outdated("jaxcal", "score", "select --score")
        words[0] = "select"
    arguments = _parser(words).parse_args(words)
    program = f"jaxcal {arguments.command}"

    def command() -> int:
        with told(at_end=True), warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = lambda warning, *_: print(
                f"{program}: warning:",
                "; ".join(str(warning).splitlines()),
                file=sys.stderr,
            )
            require_kept(vars(arguments))
            code = arguments.function(**values_of(arguments))
        sys.stdout.flush()
        return int(code or 0)

    return exit_code(command, program)


def _parser(given: list[str]) -> Parser:
    parser = Parser(
        prog="jaxcal",
        description="Choose the few measurements worth making, and calibrate.",
        epilog=_EPILOG,
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, (line, _) in (_HERE | _WHOLE).items():
        about = line[0].upper() + line[1:] + "."
        command = commands.add_parser(name, help=line, description=about)
        if name in given and name in _HERE:  # only the one that runs is imported
            module = importlib.import_module(f"jaxcal.commands.{_HERE[name][1]}")
            function = getattr(module, name)
            told = inspect.getdoc(function) or ""
            command.of(function).epilog = told.partition("\n\n")[2]
    return parser


def doctor(*, json: Annotated[bool, "print JSON"] = False) -> None:
    """Print versions and devices. This changes nothing and opens no port."""
    versions = {
        "python": f"{platform.python_version()} ({sys.executable})",
        "platform": platform.platform(),
        "cores": str(os.cpu_count()),
        "jaxcal": _version("jaxcal", "a checkout that is not installed"),
    }
    for package, extra in _required().items():
        more = f": {install(extra)}" if extra else ""
        versions[package] = _version(package, f"not installed{more}")
    versions["devices"] = _devices()
    cache = "JAX_COMPILATION_CACHE_DIR"
    versions[cache] = os.environ.get(cache, "not set")
    if json:
        write_json("", versions)
        return
    print("\n".join(aligned([*versions.items()], "<")))


def _required() -> dict[str, str]:
    """Packages, and the smallest extra that brings each; "" of those always there."""
    of_extra: dict[str, list[str]] = {}
    for line in importlib.metadata.requires("jaxcal") or []:
        asked = re.match(r"([\w.-]+)(?:.*extra == ['\"](\w+)['\"])?", line)
        if asked and asked[2] not in _OTHERS and asked[1] != "jaxcal":
            of_extra.setdefault(asked[2] or "", []).append(asked[1])
    extras: dict[str, str] = {}
    for extra in sorted(of_extra, key=lambda name: (name != "", len(of_extra[name]))):
        for package in of_extra[extra]:
            extras.setdefault(package, extra)
    return extras


def _version(package: str, missing: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return missing


def _devices() -> str:
    try:
        import jax
    except ImportError:
        return "none: JAX is not installed"
    try:
        return ", ".join(f"{d.id} {d.platform} {d.device_kind}" for d in jax.devices())
    except RuntimeError as error:
        return " ".join(str(error).split())


def example(
    kind: Annotated[Literal["table", "arm", "device"], "what is calibrated"],
    *,
    folder: Annotated[Path, "where the files go"] = Path(),
) -> None:
    """Write small files to try the commands with, and print those commands.

    The readings come from a simulated machine with known errors. Existing files are not
    replaced.
    """
    if kind == "device":
        device = importlib.resources.files("rig").joinpath("examples", "simulate.toml")
        files = {"rig.toml": device.read_text()}
    else:
        shipped = importlib.resources.files("jaxcal.commands").joinpath("examples")
        kinds = shipped.joinpath(kind).iterdir()
        files = {file.name: file.read_text() for file in kinds}
    for name in files:
        if (folder / name).exists():
            raise ValueError(f"{folder / name} exists; choose another --folder")
    require_writable_folder(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        write_text(folder / name, text)
    print(f"wrote {', '.join(sorted(files))}; now type")
    print(_TO_TYPE[kind])
