"""Train a posture-selection policy: ``python train.py``; ``--help`` lists the rest.

``jaxcal train`` is the same; ``jaxcal/commands/train.py`` holds it.
"""

import sys

from jaxcal.commands.train import main

if __name__ == "__main__":
    sys.exit(main(prog="train.py"))
