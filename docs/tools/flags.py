"""Flags that ``COMMAND --help all`` lists, of every command.

    python docs/tools/flags.py

A step of commissioning (``setup home``) is a command; old names, which work until 0.4,
are not listed by any help.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys

FLAG = re.compile(r"^  (?:-\w[ \w]*, )?(--[\w-]+)", re.MULTILINE)
LISTED = re.compile(r"positional arguments:\n  COMMAND.*\n((?:    .*\n)+)")
STEPS = re.compile(r"^single steps: (.*)$", re.MULTILINE)


def shown(words: list[str]) -> str:
    """What a command's help prints."""
    command = [sys.executable, "-m", *words, "--help", "all"]
    environment = os.environ | {"COLUMNS": "200"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    return done.stdout


def count(words: list[str]) -> int:
    """Flags of a command and of those under it, each command's printed."""
    text = shown(words)
    if listed := LISTED.search(text):
        names = re.findall(r"^    (\w+)", listed[1], re.MULTILINE)
        return sum(count([*words, name]) for name in names)
    steps = STEPS.search(text)
    below = steps[1].split(", ") if steps else []
    flags = {*FLAG.findall(text)} - {"--help", "--version"}
    print(f"{len(flags):4}  {' '.join(words)}")
    return len(flags) + sum(count([*words, name]) for name in below)


if __name__ == "__main__":
    print(f"{count(['jaxcal']) + count(['rig']):4}  in all")
