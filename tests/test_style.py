"""House style that no linter knows: sentences and names that stand alone."""

from __future__ import annotations

import ast
import pathlib
import re
from collections.abc import Iterator

ROOT = pathlib.Path(__file__).parents[1]
LEANING = re.compile(r'"""((?:The same|As|Of|Likewise)\b.*)')
PRONOUN = re.compile(r"\b(each|found|known)\b(?:,| =|:| in | [+|&-]= )")
LONG = 10  # lines, beyond which a pronoun must be held in the head
# Rooms that are not there yet.
LATER = ("adaptive", "evaluation", "information", "learning", "selection")

Function = ast.FunctionDef | ast.AsyncFunctionDef


def sources(*packages: str) -> Iterator[tuple[str, str]]:
    for path in (path for name in packages for path in ROOT.glob(f"{name}/**/*.py")):
        name = path.relative_to(ROOT)
        if name.parts[1] not in LATER:
            yield str(name), path.read_text()


def test_a_docstring_needs_no_neighbour() -> None:
    """Its first words say what comes out, also in an index and in ``help()``."""
    leaning = [
        f"{name}: {sentence}"
        for name, text in sources("jaxcal", "rig")
        for sentence in LEANING.findall(text)
    ]
    assert not leaning


def bound(function: Function) -> Iterator[str]:
    """Names that a function binds for longer than one comprehension."""
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
            if id(node) not in short:
                yield node.id


def test_a_variable_is_what_it_holds() -> None:
    """In a function of more than ten lines no variable is a pronoun."""
    riddles = [
        f"{name}:{node.lineno} {node.name}: {', '.join(words)}"
        for name, text in sources("jaxcal")
        if PRONOUN.search(text)
        for node in ast.walk(ast.parse(text))
        if isinstance(node, Function) and node.end_lineno - node.lineno >= LONG
        if (words := sorted({"each", "found", "known"}.intersection(bound(node))))
    ]
    assert not riddles
