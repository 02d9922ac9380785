"""Rooms of the code, their lines and the arrows between them, from the imports.

``python docs/tools/rooms.py`` prints the table of docs/architecture.md. A room is a
package of ``jaxcal`` or of the top level; the small modules of ``jaxcal`` are one,
``base``. An arrow is an import, of a function's body and of a type too.
"""

from __future__ import annotations

import ast
import pathlib
from collections.abc import Iterator

ROOT = pathlib.Path(__file__).parents[2]
PACKAGES = ("jaxcal", "rig", "rig_workbench")


def room_of(module: str) -> str:
    """The room of a module by its dotted name."""
    package, _, rest = module.partition(".")
    if package != "jaxcal":
        return package
    first = rest.partition(".")[0]
    if first in ("__init__", "__main__"):  # doors, from which everything is called
        return "commands"
    return (
        first
        if first and (ROOT / "jaxcal" / first / "__init__.py").is_file()
        else "base"
    )


def sources() -> Iterator[tuple[str, str]]:
    """Room and text of every file of the product."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).glob("**/*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            yield room_of(".".join(parts)), path.read_text(encoding="utf-8")
    for path in (ROOT / "train.py", ROOT / "evaluate.py"):
        yield "commands", path.read_text(encoding="utf-8")


def lines_of_rooms() -> dict[str, int]:
    """Lines of Python in each room."""
    lines: dict[str, int] = {}
    for room, text in sources():
        lines[room] = lines.get(room, 0) + len(text.splitlines())
    return lines


def at_run_time(tree: ast.AST) -> Iterator[ast.AST]:
    """The nodes of a module but for those that only a type checker reads."""
    for node in ast.iter_child_nodes(tree):
        test = getattr(node, "test", None) if isinstance(node, ast.If) else None
        if getattr(test, "id", None) != "TYPE_CHECKING":
            yield node
            yield from at_run_time(node)


def arrows() -> dict[str, set[str]]:
    """For each room those that it imports when it runs."""
    found: dict[str, set[str]] = {}
    for room, text in sources():
        ahead = found.setdefault(room, set())
        for node in at_run_time(ast.parse(text)):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            for name in names:
                if name.partition(".")[0] in PACKAGES and room_of(name) != room:
                    ahead.add(room_of(name))
    return found


def floors(ahead: dict[str, set[str]]) -> dict[str, int]:
    """The floor of each room, 1 where it imports none.

    Raises:
        RecursionError: rooms import each other in a circle.
    """

    def floor(room: str) -> int:
        return 1 + max(map(floor, ahead.get(room, ())), default=0)

    return {room: floor(room) for room in ahead}


def table() -> str:
    """The table of docs/architecture.md."""
    lines, ahead = lines_of_rooms(), arrows()
    floor = floors(ahead)
    rows = ["| floor | room | lines | imports |", "|---|---|---|---|"]
    for room in sorted(lines, key=lambda name: (-floor[name], name)):
        imports = ", ".join(sorted(ahead[room] - {"base"}))
        rows.append(f"| {floor[room]} | {room} | {lines[room]:,} | {imports} |")
    count = sum(len(rooms) for rooms in ahead.values())
    return "\n".join(
        [
            *rows,
            "",
            f"{len(lines)} rooms, {count} arrows, {max(floor.values())} floors, "
            f"{sum(lines.values()):,} lines.",
        ]
    )


if __name__ == "__main__":
    print(table())
