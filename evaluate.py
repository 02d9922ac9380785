"""How close each way of choosing postures comes to the proven optimum.

``python evaluate.py``; ``--help`` lists the rest. ``jaxcal evaluate`` is the same.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate, print, write; the exit code."""
    from jaxcal.evaluation import command
    from jaxcal.paper.datasets.catalogue import CATALOGUE

    return command.main(arguments, CATALOGUE)


if __name__ == "__main__":
    sys.exit(main())
