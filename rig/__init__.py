"""rig: jaxcal on hardware. Drives over Modbus, a phone's IMU, one safe session.

The package imports jaxcal and is never imported by it. Importing it loads neither JAX
nor matplotlib; the motion loop and the stop path never touch either.
"""

from __future__ import annotations

__all__: list[str] = []
