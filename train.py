"""Train a posture-selection policy: ``python train.py``; ``--help`` lists the rest.

``jaxcal train`` is the same; ``jaxcal/commands/train.py`` holds it.
"""

import sys

from jaxcal.commands import train

if __name__ == "__main__":
    sys.exit(train.main(prog="train.py"))
