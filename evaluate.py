"""How close each way of choosing postures comes to the proven optimum.

``python evaluate.py``; ``--help`` lists the rest. ``jaxcal evaluate`` is the same;
``jaxcal/commands/evaluate.py`` holds it.
"""

import sys

from jaxcal.commands.evaluate import main

if __name__ == "__main__":
    sys.exit(main(prog="evaluate.py"))
