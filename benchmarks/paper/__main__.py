"""``python -m benchmarks.paper``: the paper's figures, tables and claims."""

import sys

from benchmarks.paper.reproduce import main

if __name__ == "__main__":
    sys.exit(main())
