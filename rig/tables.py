"""A TOML table that is read key by key and remembers what was wrong or unknown."""

from __future__ import annotations

import math
from typing import Any

__all__ = ["Table"]


class Table:
    """Typed, range-checked access; every fault goes to one shared list."""

    def __init__(self, data: dict[str, Any], path: str, faults: list[str]) -> None:
        self._data = data
        self._path = path
        self._faults = faults
        self._seen: set[str] = set()

    def fault(self, key: str, text: str) -> None:
        """Record that a key is wrong."""
        name = f"{self._path}.{key}" if self._path else key
        self._faults.append(f"{name}: {text}")

    def _get(self, key: str, default: Any, what: str) -> Any:
        self._seen.add(key)
        if key in self._data:
            return self._data[key]
        if default is None:
            self.fault(key, f"missing; {what} is required")
        return default

    def number(
        self, key: str, low: float, high: float, default: float | None = None
    ) -> float:
        """A finite number in [low, high]."""
        what = f"a number in [{low:g}, {high:g}]"
        value = self._get(key, default, what)
        if value is None:
            return low
        if type(value) not in (int, float) or not (
            math.isfinite(value) and low <= value <= high
        ):
            self.fault(key, f"must be {what}, got {value!r}")
            return low if default is None else default
        return float(value)

    def optional_number(self, key: str, low: float, high: float) -> float | None:
        """A number in [low, high], or None where the key is absent."""
        return self.number(key, low, high) if key in self._data else None

    def integer(self, key: str, low: int, high: int, default: int | None = None) -> int:
        """A whole number in [low, high]."""
        what = f"a whole number in [{low}, {high}]"
        value = self._get(key, default, what)
        if value is None:
            return low
        if type(value) is not int or not low <= value <= high:
            self.fault(key, f"must be {what}, got {value!r}")
            return low if default is None else default
        return value

    def boolean(self, key: str, default: bool) -> bool:
        """True or false."""
        value = self._get(key, default, "true or false")
        if type(value) is not bool:
            self.fault(key, f"must be true or false, got {value!r}")
            return default
        return value

    def text(self, key: str, default: str | None = None) -> str:
        """A text that is not empty."""
        value = self._get(key, default, "a text")
        if value is None:
            return ""
        if not isinstance(value, str) or (not value and default is None):
            self.fault(key, f"must be a text, got {value!r}")
            return default or ""
        return value

    def choice(
        self, key: str, known: tuple[str, ...], default: str | None = None
    ) -> str:
        """One of a few words."""
        what = f"one of {', '.join(known)}"
        value = self._get(key, default, what)
        if value is None:
            return known[0]
        if value not in known:
            self.fault(key, f"must be {what}, got {value!r}")
            return default or known[0]
        return str(value)

    def numbers(
        self, key: str, low: float, high: float, default: tuple[float, ...]
    ) -> Any:
        """As many numbers in [low, high] as the default has, as a tuple."""
        value = self._get(key, default, "a list of numbers")
        if not isinstance(value, (list, tuple)) or len(value) != len(default):
            self.fault(key, f"must list {len(default)} numbers, got {value!r}")
            return default
        if not all(type(v) in (int, float) and low <= v <= high for v in value):
            self.fault(key, f"numbers must be in [{low:g}, {high:g}], got {value!r}")
            return default
        return tuple(float(v) for v in value)

    def integers(
        self, key: str, count: int, low: int, high: int, default: tuple[int, ...]
    ) -> tuple[int, ...]:
        """``count`` whole numbers in [low, high]."""
        value = self._get(key, default, "a list of whole numbers")
        if value == default:
            return default
        if (
            not isinstance(value, list)
            or len(value) != count
            or not all(type(v) is int and low <= v <= high for v in value)
        ):
            self.fault(key, f"must list {count} of [{low}, {high}], got {value!r}")
            return default
        return tuple(value)

    def table(self, key: str, required: bool = True) -> Table:
        """A sub-table; an empty one where it may be absent."""
        self._seen.add(key)
        value = self._data.get(key, {})
        if not isinstance(value, dict):
            self.fault(key, f"must be a table, got {value!r}")
            value = {}
        elif required and key not in self._data:
            self.fault(key, f"missing; a [{key}] table is required")
        name = f"{self._path}.{key}" if self._path else key
        quiet = required and key not in self._data
        return Table(value, name, [] if quiet else self._faults)

    def tables(self, key: str) -> list[Table]:
        """The tables of a list ``[[key]]``."""
        self._seen.add(key)
        value = self._data.get(key, [])
        if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
            self.fault(key, f"must be [[{key}]] tables")
            return []
        return [
            Table(v, f"{key}.{v.get('name', number)}", self._faults)
            for number, v in enumerate(value)
        ]

    def end(self) -> None:
        """Report keys nobody asked for: a misspelt limit must not pass in silence."""
        for key in sorted(set(self._data) - self._seen):
            known = ", ".join(sorted(self._seen))
            self.fault(key, f"unknown key; known here: {known}")
