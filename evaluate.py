"""How close each way of choosing postures comes to the proven optimum.

``python evaluate.py``; ``--help`` lists the rest. ``jaxcal evaluate`` is the same;
``jaxcal/commands/evaluate.py`` holds it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate, print, write; the exit code."""
    from jaxcal.commands import evaluate

    return evaluate.main(arguments, prog="evaluate.py")


if __name__ == "__main__":
    sys.exit(main())
