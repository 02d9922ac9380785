"""House style that no linter knows: sentences and names that stand alone."""

from __future__ import annotations

import ast
import pathlib
import re
from collections.abc import Iterator

ROOT = pathlib.Path(__file__).parents[1]
LEANING = re.compile(
    r'"""((?:The same|The rest|As|Of|Likewise|Same|Such|It|Its|They|Their|That|Those)'
    r"\b.*)"
)
WORDS = {"each", "found", "known"}
# What is left of a budget, and what is a thing's own, have names in these rooms.
ROOMS = {
    *("adaptive", "calibration", "commands", "evaluation", "information", "learning"),
    *("models", "rig", "selection"),
}
MORE = {room: {"left", "own"} for room in ROOMS}
# Where a file may bind one, which parsing tells.
PRONOUN = re.compile(
    r"(?m)^ *[\w, (]*\b(each|found|known|left|own)\b(, \w+)*( [+|]?=|:| in) "
    r"|\bfor [\w, (]*\beach\b"
)
LONG = 10  # lines, beyond which a pronoun must be held in the head

Function = ast.FunctionDef | ast.AsyncFunctionDef


def sources(package: str) -> Iterator[tuple[str, str]]:
    for path in ROOT.glob(f"{package}/**/*.py"):
        yield path.relative_to(ROOT).as_posix(), path.read_text()


def test_a_docstring_needs_no_neighbour() -> None:
    """Its first words say what comes out, also in an index and in ``help()``."""
    leaning = [
        f"{name}: {sentence}"
        for package in ("jaxcal", "rig*", "benchmarks", "examples")
        for name, text in sources(package)
        for sentence in LEANING.findall(text)
    ]
    assert not leaning


def banned_in(name: str) -> set[str]:
    package, room = name.split("/")[:2]
    return WORDS | MORE.get("rig" if package.startswith("rig") else room, set())


def bound(function: Function) -> Iterator[str]:
    """Names that a function binds for longer than one comprehension, and ``each``."""
    short = {
        id(target)
        for node in ast.walk(function)
        if isinstance(node, ast.comprehension)
        for target in ast.walk(node.target)
    }
    for node in ast.walk(function):
        if isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            if id(node) not in short or node.id == "each":
                yield node.id


def unpaired(function: Function) -> set[str]:
    """Names that a function binds, without the left one of a left and a right."""
    names = set(bound(function))
    return names - {"left"} if "right" in names else names


def test_a_variable_is_what_it_holds() -> None:
    """In a function of more than ten lines no variable is a pronoun."""
    riddles = [
        f"{name}:{node.lineno} {node.name}: {', '.join(words)}"
        for name, text in (*sources("jaxcal"), *sources("rig*"))
        if PRONOUN.search(text)
        for node in ast.walk(ast.parse(text))
        if isinstance(node, Function) and node.end_lineno - node.lineno >= LONG
        if (words := sorted(banned_in(name).intersection(unpaired(node))))
    ]
    assert not riddles
