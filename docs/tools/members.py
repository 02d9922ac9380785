"""What the API pages show beside what griffe reads: two habits of this code.

A method that a class takes from a module of its own (``check = check``, or
``report = late("module:report")``) is shown as a method, and the comment of a
dataclass's field is the field's documentation.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from typing import Any

import griffe


class Members(griffe.Extension):
    """Loaded by mkdocs.yml as an extension of mkdocstrings' Python handler."""

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Go through every class of a package that was read."""
        for thing in _everything(pkg):
            if thing.is_class:
                _complete(thing)


def _everything(parent: Any) -> Iterator[Any]:
    for member in list(parent.members.values()):
        if not member.is_alias:
            yield member
            yield from _everything(member)


def _complete(cls: Any) -> None:
    for name, member in list(cls.members.items()):
        if member.is_alias:
            continue
        if member.docstring is None and (text := _inherited(cls, name)):
            member.docstring = griffe.Docstring(text, parent=member)
        if not member.is_attribute:
            continue
        if function := _assigned(cls, member):
            cls.set_member(name, function)
        elif member.docstring is None and (text := field_comment(member)):
            member.docstring = griffe.Docstring(text, parent=member)


def _assigned(cls: Any, member: Any) -> Any:
    """The method that ``name = function`` or ``name = wrapper(function)`` makes."""
    value = member.value
    wrapped = isinstance(value, griffe.ExprCall)
    late = wrapped and str(value.function) == "late"
    if wrapped:
        value = value.arguments[0] if len(value.arguments) == 1 else None
        wrapped = not late
    if not (late or isinstance(value, griffe.ExprName)):
        return None
    try:
        if late:  # 'module:function'
            path = str(value).strip("'\"").replace(":", ".")
            found = cls.modules_collection[path]
        else:
            found = cls.module[value.name]
        found = found.final_target if found.is_alias else found
    except (KeyError, griffe.AliasResolutionError, griffe.CyclicAliasError):
        return None
    if not found.is_function or found.docstring is None:
        return None
    if wrapped:  # a property
        made = griffe.Attribute(member.name, annotation=found.returns, parent=cls)
        made.labels.add("property")
    else:
        rest = griffe.Parameters(*list(found.parameters)[1:])
        made = griffe.Function(
            member.name, parameters=rest, returns=found.returns, parent=cls
        )
    made.lineno, made.endlineno = member.lineno, member.endlineno
    made.docstring = griffe.Docstring(found.docstring.value, parent=made)
    return made


def _inherited(cls: Any, name: str) -> str:
    """The docstring of the method or property that one of this name overrides."""
    for base in cls.mro():
        member = base.members.get(name)
        if member is not None and member.docstring is not None:
            return str(member.docstring.value)
    return ""


def field_comment(member: Any) -> str:
    """What ``setting`` says of an attribute, or the comment beside or above it."""
    value = member.value
    if isinstance(value, griffe.ExprCall) and str(value.function) == "setting":
        *_, text = value.arguments
        return _sentence(ast.literal_eval(str(text)))
    lines = member.parent.module.lines_collection[member.filepath]
    last = lines[(member.endlineno or member.lineno) - 1]
    _, mark, beside = last.partition("  # ")
    if mark:
        return _sentence(beside)
    above: list[str] = []
    for line in reversed(lines[: member.lineno - 1]):
        if not line.strip().startswith("# ") or line.strip().startswith("# --"):
            break
        above.insert(0, line.strip()[2:])
    return _sentence(" ".join(above))


def _sentence(text: str) -> str:
    text = text.strip()
    return text and text[0].upper() + text[1:] + ("" if text.endswith(".") else ".")
