"""The base of every table read from a file, and its faults in words.

The field of a key, its type, default, bounds and meaning, checks the value, words the
fault, and fills the reference. Modules of tables leave out ``from __future__ import
annotations``: pydantic would compile every annotation again at each start.
"""

from __future__ import annotations

import difflib
import json
import pathlib
import tomllib
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import pydantic
from pydantic_core import PydanticCustomError


class Section(pydantic.BaseModel):
    """A table of a file: frozen, unknown keys are faults, no silent conversions."""

    model_config = pydantic.ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False
    )
    _text: str = pydantic.PrivateAttr("")
    _folder: pathlib.Path = pydantic.PrivateAttr(pathlib.Path())

    @property
    def text(self) -> str:
        """The TOML it came from, where it is the whole of a file."""
        return self._text

    @property
    def folder(self) -> pathlib.Path:
        """The folder that paths in the file are relative to."""
        return self._folder

    def broken_rules(self) -> Iterator[str]:
        """``key: fault`` of every rule about more than one key that is not kept."""
        return iter(())

    @pydantic.model_validator(mode="after")
    def _keep_the_rules(self) -> Section:
        if faults := list(self.broken_rules()):
            raise PydanticCustomError("rules", "{faults}", {"faults": faults})
        return self


def key(
    about: str,
    default: Any = ...,
    low: float | None = None,
    high: float | None = None,
    *,
    by: Any = None,
    advanced: bool = False,
    **more: Any,
) -> Any:
    """A key of a file: what it means, its default (``...``: required) and bounds; where
    ``by`` makes the default from the keys before it, ``default`` is that in words."""
    extra: dict[str, Any] = {"advanced": True} if advanced else {}
    if by is not None:
        more["default_factory"] = by
        extra["default"] = default
    else:
        more["default"] = default
    more["json_schema_extra"] = extra or None
    return pydantic.Field(description=about, ge=low, le=high, **more)


def advanced(*args: Any, **more: Any) -> Any:
    """A ``key`` that hardly any device needs; only the reference lists it."""
    return key(*args, advanced=True, **more)


class ConfigError(ValueError):
    """A file is not usable; ``faults`` lists all that is wrong."""

    def __init__(self, source: str, faults: list[str]) -> None:
        self.source = source
        self.faults = faults
        lines = [f"{source}: {len(faults)} faults", *faults]
        one = f"{source}: {''.join(faults)}"
        super().__init__("\n  - ".join(lines) if len(faults) > 1 else one)


def read_text(path: str | pathlib.Path) -> str:
    """Text of a file; ConfigError where it cannot be read."""
    try:
        return pathlib.Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(str(path), [f"cannot be read: {reason}"]) from None


Model = TypeVar("Model", bound=Section)


def parse(
    model: type[Model],
    text: str,
    source: str,
    context: Any = None,
    more: Callable[[Any], Iterable[str]] = lambda data: (),
) -> Model:
    """A TOML text as a model; ConfigError has every fault as ``section.key: rule,
    value``, and those that ``more`` finds in what was parsed."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(source, [f"not valid TOML: {error}"]) from None
    faults = list(more(data))
    try:
        # Of JSON pydantic takes lists for tuples; nothing else is converted.
        plain = json.dumps(data, default=lambda date: [str(date)])  # no key takes one
        result = model.model_validate_json(plain, context=context)
    except pydantic.ValidationError as error:
        schema = model.model_json_schema()
        listed = error.errors(include_url=False)
        faults = [text for e in listed for text in _texts(e, data, schema)] + faults
    if faults:
        raise ConfigError(source, faults)
    result._text = text
    return result


def resolved(described: dict[str, Any], root: dict[str, Any]) -> dict[str, Any]:
    """A JSON schema without reference and without the choice of null."""
    for choice in described.get("anyOf", ()):
        if choice.get("type") != "null":
            return resolved(choice, root)
    if "$ref" in described:
        return root["$defs"][described["$ref"].rpartition("/")[2]]
    return described


def rule(described: dict[str, Any], root: dict[str, Any]) -> str:
    """What a value must be, in words, from its JSON schema."""
    described = resolved(described, root)
    choices = described.get(
        "enum", [described["const"]] if "const" in described else []
    )
    if choices:
        words = [str(word) for word in choices]
        return " or ".join(words) if len(words) < 3 else "one of " + ", ".join(words)
    kind = described.get("type")
    if kind == "array":
        item = described.get("items") or described["prefixItems"][0]
        count, most = described.get("minItems", ""), described.get("maxItems")
        number = f"{count} to {most}" if most else "items"
        number = str(count) if count and count == most else number
        return f"a list of {number}, each {rule(item, root)}"
    if kind in ("integer", "number"):
        noun = "a whole number" if kind == "integer" else "a number"
        if "minimum" not in described:
            return noun
        low, high = described["minimum"], described["maximum"]
        return f"{noun} in [{low}, {high}]"
    if "pattern" in described:
        return "a name of small letters, digits and _, a letter first"
    return {"boolean": "true or false", "string": "a text"}.get(str(kind), "a table")


def _texts(error: Any, value: Any, root: dict[str, Any]) -> list[str]:
    """Faults of one pydantic error; axes are called by their names."""
    kind, path, here, keys = error["type"], "", root, []
    if kind == "default_factory_not_called":
        return []  # it is made from a key that is at fault itself
    for part in error["loc"]:
        table = resolved(here, root)
        name = str(part)
        if isinstance(value, dict) and value.get("kind") == "translation":
            name = name.replace("_deg", "_mm")  # as it is written of such an axis
        try:
            value = value[part]
        except (KeyError, IndexError, TypeError):
            value = None
        if isinstance(part, int):
            called = value.get("name") if isinstance(value, dict) else None
            path += f".{called}" if isinstance(called, str) else f"[{part}]"
            here = table.get("items") or table["prefixItems"][part]
        else:
            path += f".{name}" if path else name
            keys = sorted(table.get("properties", ()))
            others = table.get("additionalProperties") or {}
            here = table.get("properties", {}).get(part, others)
    if kind == "rules":
        return [f"{path}.{fault}".lstrip(".") for fault in error["ctx"]["faults"]]
    if kind == "value_error":
        inner = error["ctx"]["error"]
        if isinstance(inner, ConfigError):  # of a file that this one names
            return [f"{path}: {inner.source}: {fault}" for fault in inner.faults]
        return [f"{path}: {inner}"]
    if kind == "extra_forbidden":
        near = difflib.get_close_matches(error["loc"][-1], keys, 1)
        hint = f"did you mean {near[0]}? " if near else ""
        return [f"{path}: unknown key; {hint}known here: {', '.join(keys)}"]
    needed = rule(here, root)
    if kind == "missing":
        return [f"{path}: missing; {needed} is required"]
    return [f"{path}: must be {needed}, got {repr(error['input'])[:80]}"]
