"""``python -m jaxcal``: the console command without its entry point."""

import sys

from jaxcal.commands import main

sys.exit(main())
