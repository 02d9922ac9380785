"""rig: jaxcal on hardware. Drives over Modbus, a phone's IMU, one safe session.

What moves, measures and stops; it finds ``rig_workbench`` by entry points, and jaxcal
never imports it. The motion loop and the stop path touch neither JAX nor matplotlib.
"""

from __future__ import annotations

import os
import sys
import types

STOPS = sys.argv[1:2] == ["stop"]  # nothing may keep it from the drives
if STOPS:
    os.environ["JAXCAL_KERNELS_UNCHECKED"] = "1"  # it calls none
try:
    import jaxcal  # noqa: F401  # which finds modules of the rig that have moved
except Exception:
    if not STOPS:
        raise
    sys.modules["jaxcal"] = beside = types.ModuleType("jaxcal")  # without its own code
    beside.__path__ = [os.path.join(os.path.dirname(__path__[0]), "jaxcal")]

__all__: list[str] = []
