"""Train a posture-selection policy: ``python train.py``; ``--help`` lists the rest.

``jaxcal train`` is the same; ``jaxcal/commands/train.py`` holds it.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Train and save; the exit code."""
    from jaxcal.commands import train

    return train.main(arguments, prog="train.py")


if __name__ == "__main__":
    sys.exit(main())
