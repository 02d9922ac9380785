"""The reference pages that are generated: commands from parsers, keys from schemas."""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import io
import os
import pathlib
from collections.abc import Callable
from typing import Any

ROOT = pathlib.Path(__file__).parents[2]


def commands() -> str:
    """Every command of ``jaxcal`` and ``jaxcal-rig`` with its help."""
    from jaxcal.commands.main import COMMANDS, main
    from rig.arguments import make_parser

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
    path = ROOT / "tests" / "rig" / "reference.py"
    spec = importlib.util.spec_from_file_location("rig_reference", path)
    assert spec is not None and spec.loader is not None
    tables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tables)
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
            tables.configuration_table(),
            "",
            "## Register maps",
            "",
            tables.register_map_table(),
            "",
            "## Presets of training",
            "",
            "`jaxcal train --preset NAME`; a flag of the same name changes a field.",
            "",
            _presets(),
            "",
        ]
    )


def _presets() -> str:
    from jaxcal.learning.settings import settings_of
    from jaxcal.learning.training import presets

    known = {name: presets.load(name) for name in presets.names()}
    rows = [
        f"| field | meaning | {' | '.join(known)} |",
        "|---" * (2 + len(known)) + "|",
    ]
    for part, kind in presets.PARTS.items():
        for name, _, text in settings_of(kind):
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
    os.environ["COLUMNS"] = "88"
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main(argv)
    return out.getvalue()


def _shown(title: str, text: str) -> list[str]:
    return [f"## {title}", "", "```text", text.rstrip(), "```", ""]
