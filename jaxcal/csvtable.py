"""Old place of ``jaxcal.tables``, kept for one release."""

import warnings

from jaxcal.tables import *  # noqa: F403  # all of its names
from jaxcal.tables import Table as CsvTable  # noqa: F401  # its old name

warnings.warn("jaxcal.csvtable is jaxcal.tables now", DeprecationWarning, stacklevel=2)
