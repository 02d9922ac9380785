"""What a program has loaded at its end, seen in a new process."""

import subprocess
import sys

LOADED = r"""
import sys
{body}
print("\n\x1e" + "\n".join(sorted(sys.modules)))
"""


def modules_of(body: str, folder) -> set[str]:
    """Names of the modules that a program has loaded at its end."""
    done = subprocess.run(
        [sys.executable, "-c", LOADED.format(body=body)],
        cwd=folder,
        capture_output=True,
        text=True,
        check=True,
    )
    return set(done.stdout.rpartition("\n\x1e")[2].split())


def required_apart(names: set[str], forbidden) -> list[str]:
    return sorted(
        name
        for name in names
        for room in forbidden
        if name == room or name.startswith(f"{room}.")
    )
