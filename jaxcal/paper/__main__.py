"""``python -m jaxcal.paper``: the paper's figures, tables and claims."""

import sys

from jaxcal.paper.reproduce import main

if __name__ == "__main__":
    sys.exit(main())
