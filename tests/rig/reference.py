"""The reference tables of docs/rig.md, made from the schemas.

``python tests/rig/reference.py docs/rig.md`` writes them between their marks.
"""

from __future__ import annotations

import pathlib
import sys
from typing import Any

from rig.config.config import RigConfig
from rig.config.maps import RegisterMap
from rig.config.schema import Section, resolved, rule

__all__ = ["configuration_table", "register_map_table"]


def configuration_table() -> str:
    """Every key of rig.toml: value, default, meaning."""
    return _table(RigConfig)


def register_map_table() -> str:
    """Every table and key of a register map."""
    return _table(RegisterMap, nested=False)


def _table(model: type[Section], nested: bool = True) -> str:
    root = model.model_json_schema()
    rows = ["| key | value | default | meaning |", "|---|---|---|---|"]

    def add(table: dict[str, Any], prefix: str) -> None:
        for name, described in table["properties"].items():
            inner = resolved(described, root)
            if inner.get("type") == "array" and name == "axes":
                inner = resolved(inner["prefixItems"][0], root)
                name = "axes.*"
            if nested and "properties" in inner:
                add(inner, f"{prefix}{name}.")
                continue
            default = "required"
            if "default" in described or name not in table.get("required", ()):
                default = _text(described.get("default"))
            cells = (rule(described, root), default, described.get("description", ""))
            rows.append(f"| `{prefix}{name}` | " + " | ".join(cells) + " |")

    add(root, "")
    return "\n".join(rows)


def _text(default: Any) -> str:
    if default in (None, "") or isinstance(default, dict):
        return "none"
    return str(default).lower() if isinstance(default, bool) else str(default)


def main(path: str) -> int:
    """Write both tables into a page, between their marks."""
    page = pathlib.Path(path)
    text = page.read_text(encoding="utf-8")
    tables = {"configuration": configuration_table(), "map": register_map_table()}
    for name, table in tables.items():
        begin, end = f"<!-- {name} table -->\n", f"\n<!-- end of {name} table -->"
        head, _, rest = text.partition(begin)
        text = head + begin + table + end + rest.partition(end)[2]
    page.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
