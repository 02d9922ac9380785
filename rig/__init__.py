"""rig: jaxcal on hardware. Drives over Modbus, a phone's IMU, one safe session.

What moves, measures and stops; ``rig_workbench`` beside it commissions, simulates,
shows and reports, and is found by entry points. The package imports jaxcal and is never
imported by it. Importing it loads neither JAX nor matplotlib; the motion loop and the
stop path never touch either.
"""

from __future__ import annotations

import os
import sys

if sys.argv[1:2] == ["stop"]:  # nothing may keep it from the drives
    os.environ["JAXCAL_KERNELS_UNCHECKED"] = "1"  # it calls none

import jaxcal  # noqa: F401  # which finds modules of the rig that have moved

__all__: list[str] = []
