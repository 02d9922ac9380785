"""Features of the commands from a formula such as ``1 + x + x:y + sin(2*pi*x/30)``.

formulaic splits a formula into terms (``x*y`` is ``x + y + x:y``, ``0 +`` leaves out
the constant). The factors are evaluated here, because formulaic would run them as
Python: only arithmetic, numbers, pi, e, the functions below and categories are read.

``C(x, levels=['a', 'b', 'c'])`` is a category: a feature for each level, without the
first where the term without the category is in the formula too (treatment coding).
"""

from __future__ import annotations

import ast
import contextlib
import itertools
import operator
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.extras import needs

Numbers = NDArray[Any]
Factor = Callable[[Mapping[str, Numbers]], Any]  # values of the inputs by name
Levels = tuple[float, ...] | tuple[str, ...]  # of a category

_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
# All analytic but for abs, so that a complex step gives their derivative.
_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "I": lambda x: x,
    "abs": lambda x: np.where(np.real(x) < 0.0, -x, x),
    **{
        name: getattr(np, name)
        for name in (
            *("sin", "cos", "tan", "arcsin", "arccos", "arctan", "sinh", "cosh"),
            *("tanh", "exp", "log", "log10", "sqrt"),
        )
    },
}
_CONSTANTS = {"pi": np.pi, "e": np.e}


def parse(formula: str) -> tuple[dict[str, list[Factor]], set[str], dict[str, Levels]]:
    """Term -> its factors, in the order of the formula; the names that they use; and
    the levels of those that are categories."""
    with needs("models", "a formula"):
        from formulaic import Formula
        from formulaic.errors import FormulaicError
        from formulaic.parser import DefaultFormulaParser

    try:
        terms = list(Formula(formula, _ordering="none"))
        factors = [
            (str(term), [factor.expr for factor in term.factors]) for term in terms
        ]
    except (FormulaicError, AttributeError, SyntaxError) as error:
        # A formula of two sides has no terms; a message is plain in its first line.
        why = str(error).splitlines()[0] if isinstance(error, FormulaicError) else ""
        raise ValueError(
            f"features must be the right-hand side of a formula, got {formula!r}"
            + (f": {why}" if why else "")
        ) from error
    _require_powers([DefaultFormulaParser().get_ast(formula)])
    used: set[str] = set()
    categories: dict[str, Levels] = {}
    whole = {frozenset(parts) for _, parts in factors}
    terms_of: dict[str, list[Factor]] = {}
    for term, parts in factors:
        columns: list[list[tuple[str, Factor]]] = []
        coded = False
        for part in parts:
            name, levels = _category(part)
            coded = coded or bool(levels)
            if not levels:
                columns.append([(part, _compile(part, used))])
                continue
            if categories.setdefault(name, levels) != levels:
                raise ValueError(f"features: C({name}) has two lists of levels")
            rest = frozenset(parts) - {part} or frozenset("1")
            columns.append(_indicators(name, levels)[rest in whole :])
            whole |= {rest} if len(parts) == 1 else set()  # the levels' sum
        for chosen in itertools.product(*columns):
            label = ":".join(label for label, _ in chosen)
            terms_of[label if coded else term] = [factor for _, factor in chosen]
    for name, levels in categories.items():
        if name in used and isinstance(levels[0], str):
            raise ValueError(
                f"features: the levels of {name} are words, so it must be used as "
                f"C({name}, levels=...) alone"
            )
    return terms_of, used | {*categories}, categories


def _category(factor: str) -> tuple[str, Levels]:
    """The input of ``C(name, levels=[...])`` and its levels; "" and none of others."""
    if not re.match(r"C\s*\(", factor):
        return "", ()
    match ast.parse(factor.strip(), mode="eval").body:
        case ast.Call(
            args=[ast.Name(id=name)], keywords=[ast.keyword(arg="levels", value=given)]
        ) if isinstance(given, ast.List | ast.Tuple):
            with contextlib.suppress(ValueError):  # an expression
                levels = tuple(ast.literal_eval(given))
                words = all(isinstance(x, str) and x[:1].isalpha() for x in levels)
                numbers = all(type(level) in (int, float) for level in levels)
                if len({*levels}) == len(levels) > 1 and (words or numbers):
                    return name, levels
    raise ValueError(
        "features: a category must be an input and its levels, two or more numbers or "
        "words that begin with a letter, such as C(x, levels=['a', 'b', 'c']), got "
        f"{factor}"
    )


def _indicators(name: str, levels: Levels) -> list[tuple[str, Factor]]:
    """A feature for each level, with its label; levels of words are 0, 1, 2, ..."""

    def at(place: int, level: Any) -> Factor:
        value = place if isinstance(level, str) else level
        return lambda values: (np.real(values[name]) == value).astype(np.float64)

    return [(f"{name}[{level}]", at(i, level)) for i, level in enumerate(levels)]


def _require_powers(nodes: list[Any]) -> None:
    """A formula takes the product of a factor with itself for the factor: refused."""
    for node in nodes:
        parts: list[Any] = getattr(node, "args", [])
        nodes += parts
        if len(parts) < 2 or hasattr(parts[0], "args") or str(parts[0]).isdecimal():
            continue
        symbol, factor, other = node.operator.symbol, str(parts[0]), str(parts[1])
        raised = symbol in ("**", "^")
        if raised or (symbol in (":", "*") and factor == other):
            power = other if raised else "2"
            raise ValueError(
                f"features: a formula reads {factor}{symbol}{other} as {factor}; for a "
                f"power write I({factor}**{power})"
            )


def input_names(used: set[str]) -> tuple[str, ...]:
    """x, y, z or u1, u2, ... up to the last one that a formula uses."""
    if used and used <= set("xyz"):
        return tuple("xyz"[: 1 + max(map("xyz".index, used))])
    if used and all(re.fullmatch(r"u[1-9]\d*", name) for name in used):
        last = max(int(name[1:]) for name in used)
        return tuple(f"u{i + 1}" for i in range(last))
    raise ValueError(
        "inputs must be given (names of all commands in their order), unless a formula "
        "uses x, y, z or u1, u2, ...; this formula uses "
        f"{', '.join(sorted(used)) or 'none'}"
    )


def _compile(factor: str, used: set[str]) -> Factor:
    """``factor`` as a function of the inputs; adds the names that it uses."""
    try:
        tree = ast.parse(factor.strip(), mode="eval").body
    except SyntaxError as error:
        raise ValueError(f"features must hold expressions, got {factor!r}") from error

    def read(node: ast.AST) -> Factor:
        match node:
            case ast.Constant(value=int() | float() as number):
                constant = np.float64(number)
                return lambda values: constant
            case ast.Name(id=name):
                if name not in _CONSTANTS:
                    used.add(name)
                return lambda values: (
                    values[name] if name in values else _CONSTANTS[name]
                )
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
                apply, first, second = _OPERATORS[type(op)], read(left), read(right)
                return lambda values: apply(first(values), second(values))
            case ast.UnaryOp(op=op, operand=operand) if type(op) in _OPERATORS:
                apply, first = _OPERATORS[type(op)], read(operand)
                return lambda values: apply(first(values))
            case ast.Call(
                func=(
                    ast.Name(id=name)
                    | ast.Attribute(value=ast.Name(id="np"), attr=name)
                ),
                args=[argument],
                keywords=[],
            ) if name in _FUNCTIONS:
                apply, first = _FUNCTIONS[name], read(argument)
                return lambda values: apply(first(values))
        raise ValueError(
            "features may hold + - * / **, numbers, pi, e and "
            f"{', '.join(_FUNCTIONS)}, got {ast.unparse(node)!r} in {factor!r}"
        )

    return read(tree)
