"""The reference pages that are generated: commands from parsers, keys from schemas."""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import pathlib
from collections.abc import Callable
from typing import Any

ROOT = pathlib.Path(__file__).parents[2]


def commands() -> str:
    """Every command of ``jaxcal`` and ``jaxcal-rig`` with its help."""
    from jaxcal.commands import main
    from jaxcal.commands.program import COMMANDS
    from rig.commands import make_parser

    lines = ["# Commands", "", "What `--help` prints, from the parsers.", ""]
    for title, argv in (
        *((f"jaxcal {name}", [name, "--help"]) for name in COMMANDS),
        ("jaxcal evaluate --task", ["evaluate", "--task", "knee", "--help"]),
    ):
        lines += _shown(title, _help(main, argv))
    (chosen,) = (
        action
        for action in make_parser()._actions
        if isinstance(action, argparse._SubParsersAction)
    )
    for name, parser in chosen.choices.items():
        lines += _shown(f"jaxcal-rig {name}", parser.format_help())
    return "\n".join(lines)


def configuration() -> str:
    """Keys of rig.toml and of register maps, fields and presets of training."""
    from rig.config.config import RigConfig
    from rig.config.maps import RegisterMap

    return "\n".join(
        [
            "# Configuration",
            "",
            "From the schemas that check the files.",
            "",
            "## rig.toml",
            "",
            "`jaxcal-rig setup` writes it; [Calibrate a device](../rig.md).",
            "",
            "`axes.*` are the `[[axes]]` tables, 1 to 6. A device has `[imu]` or",
            "`[readings]`.",
            "",
            table(RigConfig, advanced=False),
            "",
            "### Advanced",
            "",
            "Deadlines, slacks and what hardly any device needs.",
            "",
            table(RigConfig, advanced=True),
            "",
            "## Register maps",
            "",
            "Tables and keys of a map file; predicates of the status word list the",
            "bits that must be 1 (`set`) or 0 (`clear`).",
            "",
            table(RegisterMap, nested=False),
            "",
            "## Presets of training",
            "",
            "`jaxcal train --preset NAME`; a flag of the same name changes a field.",
            "",
            _presets(),
            "",
        ]
    )


def table(model: Any, nested: bool = True, advanced: bool = False) -> str:
    """Keys of a schema: value, default, meaning; those that are advanced, or not."""
    from rig.config.schema import resolved, rule

    root = model.model_json_schema()
    rows = ["| key | value | default | meaning |", "|---|---|---|---|"]

    def add(keys: dict[str, Any], prefix: str) -> None:
        for name, described in keys["properties"].items():
            inner = resolved(described, root)
            if inner.get("type") == "array" and name == "axes":
                inner = resolved(inner["items"], root)
                name = "axes.*"
            if nested and "properties" in inner:
                add(inner, f"{prefix}{name}.")
                continue
            if described.get("advanced", False) != advanced:
                continue
            default = "required"
            if "default" in described or name not in keys.get("required", ()):
                default = _text(described.get("default"))
            cells = (rule(described, root), default, described.get("description", ""))
            rows.append(f"| `{prefix}{name}` | " + " | ".join(cells) + " |")

    add(root, "")
    return "\n".join(rows)


def _text(default: Any) -> str:
    if default in (None, "") or isinstance(default, dict):
        return "none"
    return str(default).lower() if isinstance(default, bool) else str(default)


def _presets() -> str:
    from jaxcal.learning.config import settings_of
    from jaxcal.learning.training import presets

    known = {name: presets.load(name) for name in presets.names()}
    rows = [
        f"| field | meaning | {' | '.join(known)} |",
        "|---" * (2 + len(known)) + "|",
    ]
    for part, kind in presets.PARTS.items():
        for field in settings_of(kind):
            name, text = field.name, field.metadata["help"]
            cells = []
            for config in known.values():
                parts = [getattr(config, part, config)]  # "run" is the whole
                if part == "environment":
                    parts = [task.environment for task in config.tasks]
                held = sorted({str(getattr(each, name, "")) for each in parts})
                cells.append(", ".join(held))
            rows.append(f"| `{name}` | {text} | {' | '.join(cells)} |")
    return "\n".join(rows)


def _help(main: Callable[..., Any], argv: list[str]) -> str:
    out = io.StringIO()
    os.environ["COLUMNS"] = "80"  # fits beside the two menus at 1280 pixels
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main(argv)
    return out.getvalue()


def _shown(title: str, text: str) -> list[str]:
    text = text.rstrip().replace(".venv/bin/", "")  # where the site is built
    block = ['<div class="help" markdown>', "", "```text", text, "```", "", "</div>"]
    return [f"## {title}", "", *block, ""]
